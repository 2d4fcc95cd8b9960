"""Pictures of a run, each as .png and .svg."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from emrld_jax.algorithms import starts_plain
from emrld_jax.runs.metrics import Record, last_stage
from emrld_jax.runs.panels import AFTER, BEFORE, Panel, save
from emrld_jax.runs.plane import is_planar, trajectories
from emrld_jax.runs.strides import is_runner, strides
from envs_jax import Env

AFTERWARDS = "after adaptation"
SOME = 3  # paths of a task that are drawn: more hide each other


def learning_curve(records: Sequence[Record], algo: str, title: str, path: Path) -> None:
    """Return and success, before and after adaptation, against meta-iterations."""
    first = "before adaptation" if starts_plain(algo) else "after the warm start"
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    iterations = [record["iteration"] + 1 for record in records]
    last = last_stage(records[-1])
    for axes, name in zip(figure.subplots(1, 2), ("return", "success"), strict=True):
        for stage, color, label in [(0, BEFORE, first)] * (last > 0) + [(last, AFTER, AFTERWARDS)]:
            values = [record[f"adapt/{name}_{stage}"] for record in records]
            axes.plot(iterations, values, color=color, label=label, linewidth=1.5)
        axes.set(xlabel="meta-iteration", ylabel=f"mean {name}, training tasks")
        axes.grid(alpha=0.3)
    axes.set_ylim(-0.03, 1.03)
    axes.legend(loc="best", frameon=False)
    figure.suptitle(title)
    save(figure, path)


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
    save(figure, path)


def num_drawn(env: Env, episodes: int) -> int:
    """How many of a task's episodes are drawn."""
    return episodes if is_runner(env) else min(SOME, episodes)


def draw_episodes(env: Env, panels: Sequence[Panel], title: str, folder: Path) -> None:
    """Draws where episodes went, if it is known how for the environment."""
    if is_planar(env):
        trajectories(env, panels, title, folder / "trajectories")
    elif is_runner(env):
        strides(env, panels, title, folder / "strides")
