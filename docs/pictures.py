"""Draws the pictures of docs/concepts.md: `python -m docs.pictures`, from the repository's root."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

from emrld_jax import demos
from emrld_jax.demos import DemoFile
from emrld_jax.policy import gaussian_policy
from emrld_jax.sampling.rollouts import episode
from envs_jax.point2d import Point2D

IMAGES = Path(__file__).parent / "images"
COLORS = ("#1b7f79", "#d1603d", "#5b5ea6")  # one a task
INK, PALE = "#333333", "#9aa5a8"
Point = Sequence[float] | np.ndarray  # [2]
TASKS = (1, 5, 9)  # of the 12 training tasks


def main() -> None:
    """Writes all pictures."""
    mpl.rcParams.update({"font.size": 10, "svg.hashsalt": "emrld"})
    for name, figure in (
        ("concept_problem", problem()),
        ("concept_adaptation", adaptation()),
        ("concept_iteration", iteration()),
    ):
        figure.savefig(IMAGES / f"{name}.png", dpi=150, facecolor="white")
        print(IMAGES / f"{name}.png")


def problem() -> Figure:
    """Episodes of a policy that has learned nothing, and what demonstrations show instead."""
    figure = Figure(figsize=(10, 3.0), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    env = Point2D()
    _plane(panels[0], env, "a first policy: no reward is ever seen")
    for path in _untrained_paths(env):
        panels[0].plot(*path.T, color=PALE, lw=0.8)
    for axes, quality, title in (
        (panels[1], "optimal", "optimal demonstrations"),
        (panels[2], "suboptimal", "sub-optimal demonstrations"),
    ):
        _plane(axes, env, title)
        file = demos.load(demos.resolve(quality, env.name), env)
        for color, path in zip(COLORS, _demonstrated_paths(file), strict=True):
            axes.plot(*path.T, color=color, lw=1.5, marker=".", ms=4)
    panels[0].set_ylabel("y (m)")
    return figure


def _plane(axes: Axes, env: Point2D, title: str) -> None:
    """Where an episode starts, and three tasks' goals with the zones in which reward begins."""
    for color, goal in zip(COLORS, np.asarray(env.train_tasks().goal)[list(TASKS)], strict=True):
        axes.add_patch(Circle(goal, env.reward_radius, color=color, alpha=0.25, lw=0))
        axes.plot(*goal, marker="*", color=color, ms=9, ls="none")
    axes.plot(0, 0, marker="o", color=INK, ms=5)
    axes.set(title=title, xlabel="x (m)", aspect="equal", xlim=(-2.5, 2.5), ylim=(-1.2, 2.5))


def _untrained_paths(env: Point2D, count: int = 20) -> np.ndarray:
    """Positions of episodes [count, T, 2] of a first policy, which stands still but for noise."""
    policy = gaussian_policy(env.observation_size, env.action_size, start_at_zero=True)
    task = jax.tree.map(lambda x: x[0], env.train_tasks())
    params = policy.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), count)
    return np.asarray(jax.vmap(lambda key: episode(env, policy, params, key, task))(keys).obs)


def _demonstrated_paths(file: DemoFile) -> list[np.ndarray]:
    """Positions of the demonstrations of three tasks, [steps, 2] each."""
    train = file.train.demos
    lengths = np.asarray(jnp.sum(train.mask, axis=1), int)
    return [np.asarray(train.obs[i, : lengths[i]]) for i in TASKS]


def adaptation() -> Figure:
    """Parameters as points in the plane: inner steps on the left, the outer step on the right."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    panels = figure.subplots(1, 2)
    best = np.array([[2.2, 2.5], [4.2, 0.6], [2.4, -1.9]])  # where each task's best parameters lie
    old, new = np.array([-0.8, -1.0]), np.array([0.9, 0.2])
    _parameters(panels[0], best, old, "θ", reach=0.45)
    panels[0].set_title("inner steps: one on each task's own data")
    _parameters(panels[1], best, new, "new θ", reach=0.75)
    panels[1].plot(*old, "o", color=PALE, ms=8)
    _text(panels[1], old, (-0.1, 0.2), "θ", color=PALE, ha="right", va="bottom", fontsize=13)
    _arrow(panels[1], old, new, INK, width=2.2)
    panels[1].set_title("outer step: θ moves so that inner steps lead farther")
    return figure


def _parameters(axes: Axes, best: np.ndarray, start: np.ndarray, name: str, reach: float) -> None:
    for i, (color, goal) in enumerate(zip(COLORS, best, strict=True)):
        axes.plot(*goal, marker="*", color=color, ms=14, ls="none")
        adapted = start + reach * (goal - start)
        _arrow(axes, start, adapted, color, width=1.6)
        axes.plot(*adapted, "o", color=color, ms=5)
        _text(axes, adapted, (0.1, 0.12), f"θ$_{i + 1}$", color=color, va="bottom")
        _text(axes, goal, (0.2, 0.0), f"best for task {i + 1}", color=color, va="center")
    axes.plot(*start, "o", color=INK, ms=8)
    _text(axes, start, (-0.1, 0.2), name, ha="right", va="bottom", fontsize=13)
    axes.set(xlim=(-2, 6.6), ylim=(-2.6, 3.1), xticks=[], yticks=[])


def _text(axes: Axes, at: Point, offset: Point, text: str, **style: Any) -> None:
    axes.text(at[0] + offset[0], at[1] + offset[1], text, **style)


def _arrow(axes: Axes, start: Point, end: Point, color: str, width: float) -> None:
    style = {"arrowstyle": "-|>", "color": color, "lw": width, "shrinkA": 4, "shrinkB": 2}
    axes.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops=style)


def iteration() -> Figure:
    """What one meta-iteration does, from left to right, for M tasks at once."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(0, 100), ylim=(0, 38))
    axes.axis("off")
    frame = FancyBboxPatch((17, 9), 60, 26.5, boxstyle="round,pad=0.6", fc="none", ec=PALE)
    frame.set_linestyle("--")
    axes.add_patch(frame)
    axes.text(18, 34.2, "for each of M tasks", color=PALE, va="center")
    for x, y, text, color in (
        (7, 17, "θ\nmeta-\nparameters", INK),
        (26, 17, "collect\nE episodes", COLORS[0]),
        (46, 17, "inner step\nw_rl · policy gradient\n+ w_bc · demonstration", COLORS[1]),
        (46, 30, "demonstration\nof the task", COLORS[1]),
        (68, 17, "θ$_i$: collect\nE episodes", COLORS[0]),
        (89, 17, "outer step:\nTRPO on the\nadapted policies'\nepisodes", COLORS[2]),
    ):
        box = {"boxstyle": "round,pad=0.6", "fc": "white", "ec": color, "lw": 1.6}
        axes.text(x, y, text, ha="center", va="center", color=color, bbox=box)
    for start, end in (((12.5, 17), (20.8, 17)), ((31, 17), (36.2, 17)), ((55.8, 17), (62.8, 17))):
        _arrow(axes, start, end, INK, 1.4)
    _arrow(axes, (73, 17), (81.5, 17), INK, 1.4)
    _arrow(axes, (46, 27.5), (46, 20.5), INK, 1.4)
    axes.plot([89, 89, 7], [11, 3, 3], color=COLORS[2], lw=1.6)
    _arrow(axes, (7, 2.8), (7, 12.5), COLORS[2], 1.6)
    axes.text(48, 4.6, "a better θ", color=COLORS[2], ha="center", va="center")
    return figure


if __name__ == "__main__":
    main()
