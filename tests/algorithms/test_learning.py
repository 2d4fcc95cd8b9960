"""Every algorithm learns: a short run on Point2D with the dense reward."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

import envs_jax
from emrld_jax import algorithms
from emrld_jax.settings import AdaptSettings, MetaSettings, PolicySettings, Settings
from emrld_jax.types import Demos
from envs_jax.goals import GoalTask

ENV = envs_jax.make("point2d", reward="dense", horizon=20)
GOALS = GoalTask(jnp.array([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0]]))
SETTINGS = Settings(
    policy=PolicySettings(hidden_sizes=[32, 32], std=0.3),
    adapt=AdaptSettings(num_episodes=10, learning_rate=0.004, warm_start_rate=0.004),
    meta=MetaSettings(max_kl=0.05, backtrack_ratio=0.7),
)


def straight_lines() -> Demos:
    """At full speed to each goal, [3, 20, ..]."""
    actions = jnp.repeat(GOALS.goal[:, None] / 2.0, 20, axis=1)
    before = jnp.cumsum(0.1 * actions, axis=1) - 0.1 * actions
    return Demos(before, actions, jnp.ones((3, 20)))


@pytest.mark.parametrize("name", algorithms.names())
def test_the_return_after_adaptation_rises(name: str) -> None:
    learner, demos = algorithms.make(name, ENV, SETTINGS), straight_lines()
    state = learner.init(jax.random.key(0))
    returns = []
    for i in range(12):
        state, metrics = learner.update(state, jax.random.key(i), GOALS, demos)
        returns.append(float(metrics["adapt/return_1"]))
    # standing still gives -40, walking straight to the goal -21
    assert sum(returns[-3:]) / 3 > sum(returns[:3]) / 3 + 3
    assert bool(jnp.isfinite(metrics["outer/loss"]))
