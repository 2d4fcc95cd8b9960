"""Paths of episodes in the plane, with goals, reward zones and demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from emrld_jax.runs.panels import BEFORE, Panel, save
from envs_jax import Env


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
    save(figure, path)


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
