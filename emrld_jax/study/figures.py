"""The paper's figures from finished runs, each as .png and .svg."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from emrld_jax.analysis.curves import curve
from emrld_jax.analysis.groups import Group, on_each_problem
from emrld_jax.analysis.scores import LAST, demonstrated
from emrld_jax.analysis.statistics import pointwise
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.episodes import FINAL, read_episodes
from emrld_jax.runs.panels import BEFORE, save

COLORS = {  # of others, "black"
    "emrld": "#1f5fa8",
    "emrld_ws": "#d1622b",
    "maml": "#6b6b6b",
    "meta_bc": "#3a8f4d",
    "gmps": "#8a4fb0",
    "promp": "#b08d00",
    "emaml": "#c23b6e",
    "reptile": "#208f94",
}
SHADES = ("#440154", "#3b528b", "#21918c", "#5ec962", "#c9b418")  # of values that rise
AXES = {"iterations": "meta-iterations", "env_steps": "environment steps", "seconds": "seconds"}
THRESHOLDS = 121  # of a profile
DRIFT = -1  # the held-out task of the robot experiment is the last one: -0.65 rad a step


class Line(NamedTuple):
    """A group as it is drawn."""

    group: Group
    label: str
    color: str


def draw_curves(groups: Sequence[Group], against: str, path: Path) -> None:
    """Return after adaptation: a row an environment, a column a set of demonstrations."""
    figure, panels = _problems(groups)
    for axes, title, lines in panels:
        _demonstrated(axes, [line.group for line in lines])
        _panel(axes, lines, title, against)
    save(figure, path)


def draw_profiles(groups: Sequence[Group], path: Path) -> None:
    """Shares of seeds and held-out tasks that return more than each value; panels as the curves'.

    A run's line is the share of its tasks, as after adaptation. Their mean is the performance
    profile over tasks (`analysis.statistics`), with intervals for which whole runs are drawn, since
    tasks of a run share one policy.
    """
    figure, panels = _problems(groups)
    for axes, title, lines in panels:
        found = [(line, runs) for line in lines if (runs := _per_task(line.group))]
        if not found:
            axes.set_title(f"{title}{': no held-out tasks' * bool(lines)}", fontsize=10)
            continue
        every = np.concatenate([run for _, runs in found for run in runs])
        low, high = every.min(), every.max()
        margin = 0.02 * (high - low) or 1.0  # below the lowest, so that lines begin with all
        above = np.linspace(low - margin, high + margin, THRESHOLDS)
        for line, runs in found:
            _profile(axes, line, runs, above)
        axes.set_title(title, fontsize=10)
        axes.set(xlabel="return after adaptation", ylabel="share above", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.25)
        _legend(axes)
    figure.suptitle("Share of seeds and held-out tasks that return more, after adaptation")
    save(figure, path)


def _profile(axes: Axes, line: Line, runs: Sequence[np.ndarray], above: np.ndarray) -> None:
    """One line with its interval; of each run the returns on its tasks."""
    each = np.array([(returns[:, None] > above).mean(axis=0) for returns in runs])
    found = pointwise(each, lambda shares: np.asarray(shares.mean(axis=-1)))
    axes.fill_between(above, found.low, found.high, color=line.color, alpha=0.15, linewidth=0)
    label = f"{line.label} ({len(runs)})"
    axes.plot(above, found.value, color=line.color, linewidth=1.8, label=label)


def _per_task(group: Group) -> list[np.ndarray]:
    """Returns on held-out tasks after adaptation, of those of a group's runs that have some."""
    tables = [stages[LAST] for run in group.runs if (stages := run.stages("test"))]
    return [np.array(table["return_per_task"]) for table in tables if "return_per_task" in table]


def _problems(groups: Sequence[Group]) -> tuple[Figure, list[tuple[Axes, str, list[Line]]]]:
    """A row an environment, a column a set of demonstrations: title and lines of each panel."""
    groups = on_each_problem(groups)
    envs = _in_order(group.environment for group in groups)
    demos = _in_order(group.demonstrations for group in groups)
    figure = Figure(figsize=(5.2 * len(demos), 3.2 * len(envs)), layout="constrained")
    grid = figure.subplots(len(envs), len(demos), squeeze=False)
    panels = []
    for axes, (env, quality) in zip(grid.flat, product(envs, demos), strict=True):
        own = by_algorithm([g for g in groups if g.problem == (env, quality)])
        lines = [Line(g, g.label, COLORS.get(g.algorithm, "black")) for g in own]
        panels.append((axes, f"{env}, {quality} demonstrations", lines))
    return figure, panels


def draw_lines(panels: Sequence[tuple[str, Sequence[Line]]], path: Path) -> None:
    """Return after adaptation against meta-iterations; two panels a row."""
    rows = (len(panels) + 1) // 2
    figure = Figure(figsize=(10.4, 3.4 * rows), layout="constrained")
    grid = figure.subplots(rows, 2, squeeze=False, sharey=True)
    for axes, (title, lines) in zip(grid.flat, panels, strict=False):
        _panel(axes, lines, title, "iterations")
    for axes in list(grid.flat)[len(panels) :]:
        axes.remove()
    save(figure, path)


def draw_trajectories(groups: Sequence[Group], path: Path) -> list[str]:
    """Where adapted policies go under the drift of the robot experiment, a panel an algorithm.

    Returns:
        Which runs are not in it, and why.
    """
    left_out: list[str] = []
    figure = Figure(figsize=(3.6 * len(groups), 3.6), layout="constrained")
    grid = figure.subplots(1, len(groups), squeeze=False, sharex=True, sharey=True)
    for axes, group in zip(grid.flat, groups, strict=True):
        for run in group.runs:
            try:
                about, kept = read_episodes(run.path / "episodes" / f"{FINAL}.npz")
            except ConfigError as error:
                left_out.append(f"left out of the trajectories: {error}")
                continue
            task = {name: x[DRIFT] for name, x in kept["test"]._asdict().items()}
            _trajectories(axes, task, float(about["zone"]))
        seeds = len(group.runs)
        axes.set(title=f"{group.label} ({seeds} seed{'s' * (seeds > 1)})", xlabel="x (m)")
        axes.set(aspect="equal", xlim=(-0.6, 2.7), ylim=(-1.1, 2.2))
        axes.grid(alpha=0.2)
    grid.flat[0].set_ylabel("y (m)")
    figure.suptitle(
        "Drift -0.65 rad a step. Gray: before adaptation; blue: after; dashed: the demonstration"
    )
    save(figure, path)
    return left_out


def _trajectories(axes: Axes, task: dict[str, Any], zone: float) -> None:
    x, y = (float(number) for number in task["aim"])
    axes.add_patch(Circle((x, y), zone, color=BEFORE, alpha=0.12, linewidth=0))
    axes.plot(x, y, marker="*", color="black", markersize=7, zorder=3)
    axes.plot(*np.asarray(task["demo"], float).T, "k--", linewidth=1.0, zorder=2)
    for stage, color in ((0, BEFORE), (-1, COLORS["emrld"])):
        for episode in np.asarray(task["path"], float)[stage]:
            axes.plot(*episode.T, color=color, linewidth=0.9, alpha=0.7)


def _panel(axes: Axes, lines: Sequence[Line], title: str, against: str) -> None:
    """Interquartile means with their intervals, and each seed's own curve, thin."""
    for line in lines:
        found = curve(line.group, against=against)
        seeds = len(found.seeds)
        axes.plot(found.x, found.each.T, color=line.color, linewidth=0.5, alpha=0.3)
        axes.fill_between(found.x, found.low, found.high, color=line.color, alpha=0.15, linewidth=0)
        axes.plot(
            found.x, found.value, color=line.color, linewidth=1.8, label=f"{line.label} ({seeds})"
        )
    axes.set_title(title, fontsize=10)
    axes.set(xlabel=AXES[against], ylabel="return after adaptation")
    axes.grid(alpha=0.25)
    if lines:
        _legend(axes)


def _legend(axes: Axes) -> None:
    axes.legend(
        title="line (seeds)",
        fontsize=7,
        title_fontsize=7,
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),  # beside the axes
    )


def _demonstrated(axes: Axes, groups: Sequence[Group]) -> None:
    """What the demonstrations return, as a dashed line."""
    own = [g for g in groups if g.runs[0].demonstrations == g.demonstrations]
    if own and (shown := demonstrated(own[0].runs[0], "train")) is not None:
        axes.axhline(shown, color="black", linestyle="--", linewidth=0.8, label="demonstrations")


def by_algorithm(groups: Sequence[Group]) -> list[Group]:
    """In the order of COLORS."""
    order = {name: k for k, name in enumerate(COLORS)}
    return sorted(groups, key=lambda group: order.get(group.algorithm, len(order)))


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def sensitivity_panels(groups: Sequence[Group]) -> list[tuple[str, list[Line]]]:
    """Fig. 2: for each algorithm and each weight, a line a value; the other weight is 1."""
    panels = []
    for algo in ("emrld", "emrld_ws"):
        for varied, fixed in (("w_rl", "w_bc"), ("w_bc", "w_rl")):
            own = [g for g in groups if g.algorithm == algo and _setting(g, fixed) == 1]
            own.sort(key=lambda group: _setting(group, varied))
            lines = [
                Line(g, f"{varied} {_setting(g, varied):g}", shade)
                for g, shade in zip(own, SHADES, strict=False)
            ]
            panels.append((f"{algo}, {fixed} = 1", lines))
    return panels


def ablation_panels(groups: Sequence[Group]) -> list[tuple[str, list[Line]]]:
    """Fig. 3: EMRLD whole, without demonstrations, without the policy gradient."""
    kinds = (
        ("both", COLORS["emrld"], lambda g: _setting(g, "w_rl") and _setting(g, "w_bc")),
        ("w_bc = 0", COLORS["maml"], lambda g: not _setting(g, "w_bc")),
        ("w_rl = 0", COLORS["meta_bc"], lambda g: not _setting(g, "w_rl")),
    )
    return [
        (
            f"{quality} demonstrations",
            [
                Line(group, label, color)
                for label, color, belongs in kinds
                for group in groups
                if group.demonstrations == quality and belongs(group)
            ],
        )
        for quality in _in_order(group.demonstrations for group in groups)
    ]


def _setting(group: Group, name: str) -> float:
    return float(group.runs[0].settings[name])
