"""Every algorithm learns: a short run on Point2D with the dense reward."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

import envs_jax
from emrld_jax import algorithms
from emrld_jax.runs.metrics import last_stage
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
ITERATIONS = {"gmps": 60}  # where others need 12
# of those that follow gradients, and need another inner rate: (outer rate, inner rate, steps)
RATES = {
    "meta_bc": (0.003, 0.02, 1),
    "gmps": (0.01, 0.1, 1),
    "promp": (0.01, 0.02, 1),
    "reptile": (1.0, 0.05, 3),
}


def settings_of(name: str) -> Settings:
    if name not in RATES:
        return SETTINGS
    outer, inner, steps = RATES[name]
    adapt = replace(SETTINGS.adapt, learning_rate=inner, num_steps=steps)
    return replace(SETTINGS, adapt=adapt, meta=replace(SETTINGS.meta, learning_rate=outer))


def straight_lines() -> Demos:
    """At full speed to each goal, [3, 20, ..]."""
    actions = jnp.repeat(GOALS.goal[:, None] / 2.0, 20, axis=1)
    before = jnp.cumsum(0.1 * actions, axis=1) - 0.1 * actions
    return Demos(before, actions, jnp.ones((3, 20)))


@pytest.mark.parametrize("name", algorithms.names())
def test_the_return_after_adaptation_rises(name: str) -> None:
    learner, demos = algorithms.make(name, ENV, settings_of(name)), straight_lines()
    state = learner.init(jax.random.key(0))
    returns = []
    for i in range(ITERATIONS.get(name, 12)):
        state, metrics = learner.update(state, jax.random.key(i), GOALS, demos)
        returns.append(float(metrics[f"adapt/return_{last_stage(metrics)}"]))
    # standing still gives -40, walking straight to the goal -21
    assert sum(returns[-3:]) / 3 > sum(returns[:3]) / 3 + 3
    assert bool(jnp.isfinite(metrics["outer/loss"]))
