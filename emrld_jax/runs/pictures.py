"""Pictures of a run, each as .png and .svg."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from emrld_jax.demos import DemoSet
from emrld_jax.runs.metrics import Record, last_stage
from envs_jax import Env

BEFORE, AFTER = "#8c8c8c", "#1f5fa8"


class Panel(NamedTuple):
    """Paths of some episodes of each of M tasks."""

    title: str
    demos: DemoSet
    obs: Any  # [M, P, T, O]
    mask: Any  # [M, P, T]


def learning_curve(records: Sequence[Record], title: str, path: Path) -> None:
    """Return and success, before and after adaptation, against meta-iterations."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    iterations = [record["iteration"] + 1 for record in records]
    last = last_stage(records[-1])
    for axes, name in zip(figure.subplots(1, 2), ("return", "success"), strict=True):
        for stage, color, label in ((0, BEFORE, "before"), (last, AFTER, "after")):
            values = [record[f"adapt/{name}_{stage}"] for record in records]
            axes.plot(iterations, values, color=color, label=f"{label} adaptation", linewidth=1.5)
        axes.set(xlabel="meta-iteration", ylabel=f"mean {name}, training tasks")
        axes.grid(alpha=0.3)
    axes.set_ylim(-0.03, 1.03)
    axes.legend(loc="best", frameon=False)
    figure.suptitle(title)
    _save(figure, path)


def adaptation_curve(stages: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Return and success with their intervals against adaptation steps."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    steps = [stage["adaptation_steps"] for stage in stages]
    for axes, name in zip(figure.subplots(1, 2), ("return", "success"), strict=True):
        low, high = np.array([stage[f"{name}_interval"] for stage in stages]).T
        axes.fill_between(steps, low, high, color=AFTER, alpha=0.2, linewidth=0)
        axes.plot(steps, [stage[name] for stage in stages], "o-", color=AFTER)
        axes.set(xlabel="adaptation steps", ylabel=f"mean {name}", xticks=steps)
        axes.grid(alpha=0.3)
    axes.set_ylim(-0.03, 1.03)
    figure.suptitle(f"{title} (band: 95 % interval)")
    _save(figure, path)


def is_planar(env: Env) -> bool:
    """Whether the environment moves in a plane toward a goal, so that paths can be drawn."""
    return env.observation_names[:2] == ("x", "y") and hasattr(env, "goal")


def trajectories(env: Env, panels: Sequence[Panel], title: str, path: Path) -> None:
    """Paths, goals, reward zones and demonstrations in the plane; two panels a row."""
    low, high = _view(env, panels)
    width, height = high - low
    rows = (len(panels) + 1) // 2
    figure = Figure(figsize=(10, rows * (4.6 * height / width + 0.7) + 0.4), layout="constrained")
    grid = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _draw(axes, env, panel)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    figure.suptitle(f"{title} (dashed: demonstrations)")
    _save(figure, path)


def _view(env: Any, panels: Sequence[Panel]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a box around goals and demonstrations: paths may leave it."""
    corners = []
    for panel in panels:
        corners += [np.asarray(jax.vmap(env.goal)(panel.demos.tasks)) + env.reward_radius]
        corners += [np.asarray(jax.vmap(env.goal)(panel.demos.tasks)) - env.reward_radius]
        corners += [np.asarray(panel.demos.demos.obs[..., :2]).reshape(-1, 2)]
    points = np.concatenate(corners)
    return points.min(axis=0) - 0.4, points.max(axis=0) + 0.4


def _draw(axes: Axes, env: Any, panel: Panel) -> None:
    goals = np.asarray(jax.vmap(env.goal)(panel.demos.tasks))
    shades = colormaps["turbo"](np.linspace(0.05, 0.95, len(goals)))
    shared = bool(np.allclose(goals, goals[0]))  # one zone for all, then in no task's color
    zones = [(goals[0], BEFORE)] if shared else list(zip(goals, shades, strict=True))
    for goal, color in zones:
        axes.add_patch(Circle(goal, env.reward_radius, color=color, alpha=0.2, linewidth=0))
        axes.plot(*goal, marker="*", color=color, markeredgecolor="black", markersize=6, zorder=3)
    demos = panel.demos.demos
    for task, shade in enumerate(shades):
        axes.plot(*_points(demos.obs[task], demos.mask[task]), "k--", linewidth=0.8, alpha=0.7)
        for obs, mask in zip(panel.obs[task], panel.mask[task], strict=True):
            # a dot at the end: some paths stay where they begin
            x, y = _path(obs, mask)
            axes.plot(x, y, color=shade, linewidth=1.0, alpha=0.8)
            axes.plot(x[-1], y[-1], ".", color=shade, markersize=4)
    axes.set(title=panel.title, xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.grid(alpha=0.2)


def _points(obs: Any, mask: Any) -> np.ndarray:
    """Where a demonstration's steps are: x and y, [2, N]."""
    return np.asarray(obs)[np.asarray(mask) > 0, :2].T


def _path(obs: Any, mask: Any) -> np.ndarray:
    """Where an episode went and ended: x and y, [2, N + 1]; [2, T] if it lasted to the horizon.

    A rollout goes on after an episode's end, so the next row is where its last action led.
    """
    return np.asarray(obs)[: int(np.sum(mask)) + 1, :2].T


def _save(figure: Figure, path: Path) -> None:
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=150)
