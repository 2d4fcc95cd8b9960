"""The NumPy reward, success and ending of a robot's step are those of the environments."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from bridges.bundle import Zone
from bridges.environments import zone
from bridges.task import Outcome, distance_to_goal, outcome


def far_and_near(goal: Any, generator: np.random.Generator, size: int) -> np.ndarray:
    """Positions all over the arena and beyond, and many near the goal."""
    anywhere = generator.uniform(-2.9, 2.9, (size, 2))
    near = np.asarray(goal) + generator.normal(0, 0.3, (size, 2))
    nearer = np.asarray(goal) + generator.normal(0, 0.02, (size, 2))
    return np.concatenate([anywhere, near, nearer]).astype(np.float32)


@pytest.mark.parametrize("reward", ["sparse", "dense"])
@pytest.mark.parametrize("name", ["point2d", "two_wheeled", "two_wheeled_drift"])
def test_outcomes_are_the_environments(name: str, reward: str) -> None:
    env: Any = envs_jax.make(name, reward=reward, reward_radius=0.6)
    task = jax.tree.map(lambda x: x[5], env.train_tasks())
    positions = far_and_near(env.goal(task), np.random.default_rng(0), 500)
    times = np.arange(len(positions)) % env.horizon

    @jax.jit
    @jax.vmap
    def expected(position: jax.Array, t: jax.Array) -> Any:
        # a step that stays where it is: without speed, nothing but a heading changes
        obs = jnp.zeros(env.observation_size).at[:2].set(position)
        start = env.reset_to(obs, task)
        state = replace(start, pipeline_state=start.pipeline_state._replace(t=t))
        after = env.step(state, env.to_policy(jnp.zeros(2)))
        return after.obs[:2], after.reward, after.done, after.metrics["success"]

    # one 0 of a physical action may come out as 1e-9, so positions are those after the step
    found, rewards, dones, successes = expected(jnp.asarray(positions), jnp.asarray(times))
    rules = zone(env, task)
    assert rules is not None
    own = [
        outcome(rules, float(x), float(y), int(t))
        for (x, y), t in zip(np.asarray(found), times, strict=True)
    ]

    assert np.allclose([o.reward for o in own], rewards, rtol=0, atol=1e-6)
    assert np.array_equal([o.done for o in own], np.asarray(dones) > 0)
    assert np.array_equal([o.success for o in own], np.asarray(successes) > 0)
    assert 100 < sum(o.success for o in own) < 1400
    assert name == "point2d" or sum(o.done and not o.success for o in own) > 50


@pytest.mark.parametrize("name", ["two_wheeled", "two_wheeled_drift"])
def test_a_random_drive_is_worth_the_same_step_by_step(name: str) -> None:
    env: Any = envs_jax.make(name)
    task = jax.tree.map(lambda x: x[4], env.train_tasks())
    rules = zone(env, task)
    assert rules is not None
    step = jax.jit(env.step)
    state = env.reset(jax.random.key(0), task)
    generator = np.random.default_rng(1)
    for t in range(60):
        state = step(state, jnp.asarray(generator.normal(0.5, 0.5, 2), jnp.float32))
        own = outcome(rules, float(state.obs[0]), float(state.obs[1]), t)
        assert own.reward == pytest.approx(float(state.reward), abs=1e-6)
        assert own.done == bool(state.done)
        assert own.success == bool(state.metrics["success"])


def test_worked_outcomes() -> None:
    rules = Zone([2.0, 1.0], "sparse", 0.5, "square", 0.1, 2.5, 100)

    assert outcome(rules, 0.0, 0.0, 0) == Outcome(0.0, False, False)
    assert outcome(rules, 1.75, 1.0, 10) == Outcome(0.75, False, False)
    assert outcome(rules, 2.05, 0.95, 29) == Outcome(70.0, True, True)
    assert outcome(rules, -2.51, 0.0, 3) == Outcome(0.0, True, False)
    assert outcome(rules._replace(arena=None), -2.51, 0.0, 3) == Outcome(0.0, False, False)
    assert outcome(rules._replace(success="disc"), 2.08, 0.92, 29).success is False
    assert distance_to_goal(rules, 2.3, 1.4) == pytest.approx(0.5)
