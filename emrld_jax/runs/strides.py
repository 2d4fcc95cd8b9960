"""Where runners were over time: x against seconds, a panel for each direction."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emrld_jax.runs.panels import AFTER, BEFORE, Panel, save
from envs_jax import Env

COLORS = {1.0: AFTER, -1.0: "#c0561f"}  # by direction


def is_runner(env: Env) -> bool:
    """Whether the environment's tasks are directions to run in along x."""
    return "torso_x" in env.observation_names and hasattr(env, "zone_distance")


def strides(env: Env, panels: Sequence[Panel], title: str, path: Path) -> None:
    """All episodes' x against time, with the part around the start that gives no reward."""
    figure = Figure(figsize=(10, 3.4 * ((len(panels) + 1) // 2) + 0.4), layout="constrained")
    grid = figure.subplots((len(panels) + 1) // 2, 2, squeeze=False, sharex=True, sharey=True)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _draw(axes, env, panel)
    figure.suptitle(f"{title} (dashed: demonstrations; gray: no reward)")
    save(figure, path)


def _draw(axes: Axes, env: Any, panel: Panel) -> None:
    axes.axhspan(-env.zone_distance, env.zone_distance, color=BEFORE, alpha=0.2, linewidth=0)
    for task, direction in enumerate(np.asarray(panel.demos.tasks.direction)):
        demos, color = panel.demos.demos, COLORS[float(direction)]
        axes.plot(*_way(env, demos.obs[task], demos.mask[task]), "k--", linewidth=0.8, zorder=3)
        for obs, mask in zip(panel.obs[task], panel.mask[task], strict=True):
            axes.plot(*_way(env, obs, mask), color=color, linewidth=0.7, alpha=0.5)
    for direction, words in ((1.0, "forward"), (-1.0, "backward")):
        axes.plot([], [], color=COLORS[direction], label=f"should run {words}")
    axes.set(title=panel.title, xlabel="time (s)", ylabel="way from the start (m)")
    axes.tick_params(labelbottom=True, labelleft=True)
    axes.legend(loc="upper left", frameon=False)
    axes.grid(alpha=0.2)


def _way(env: Any, obs: Any, mask: Any) -> tuple[np.ndarray, np.ndarray]:
    """Times in s, and how far from its start an episode then was, in m."""
    x = np.asarray(obs)[np.asarray(mask) > 0, env.observation_names.index("torso_x")]
    return env.dt * np.arange(len(x)), x - x[0]
