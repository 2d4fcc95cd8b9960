"""Brax's training wrappers take every environment as it is, and give right results."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import (
    AutoResetWrapper,
    EpisodeWrapper,
    EvalWrapper,
    VmapWrapper,
)

import envs_jax
from tests.envs.steering import DRIFT_GOAL, GOAL_NAMES

BATCH, LENGTH = 3, 4

every_environment = pytest.mark.parametrize("name", envs_jax.names())


def keys() -> jax.Array:
    """Brax reads the batch size off the shape of old-style keys, [B, 2]."""
    return jax.random.split(jax.random.PRNGKey(0), BATCH)


def actions(env: Any, steps: int) -> jax.Array:
    return jax.random.normal(jax.random.key(1), (steps, BATCH, env.action_size))


def unwrapped_steps(env: Any, steps: int) -> list[list[Any]]:
    """The states [steps][batch] of each member alone, without wrapper or vmap."""
    moves = actions(env, steps)
    members = [env.reset(key) for key in keys()]
    step = jax.jit(env.step)
    history = []
    for t in range(steps):
        members = [step(state, moves[t, i]) for i, state in enumerate(members)]
        history.append(members)
    return history


def obs_of(states: list[Any]) -> np.ndarray:
    return np.stack([np.asarray(state.obs) for state in states])


def reward_of(states: list[Any]) -> np.ndarray:
    return np.stack([np.asarray(state.reward) for state in states])


@every_environment
def test_vmap_wrapper(name: str) -> None:
    env = envs_jax.make(name, reward="dense")
    wrapped: Any = VmapWrapper(env)
    state, moves = wrapped.reset(keys()), actions(env, 2)
    assert wrapped.observation_size == env.observation_size
    assert wrapped.action_size == env.action_size

    for t, expected in enumerate(unwrapped_steps(env, 2)):
        state = wrapped.step(state, moves[t])
        np.testing.assert_allclose(state.obs, obs_of(expected), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(state.reward, reward_of(expected), rtol=1e-5, atol=1e-6)


@every_environment
def test_episode_wrapper_truncates_at_its_length(name: str) -> None:
    env = envs_jax.make(name, reward="dense")
    wrapped: Any = EpisodeWrapper(VmapWrapper(env), LENGTH, 1)
    state, moves = wrapped.reset(keys()), actions(env, LENGTH)
    step = jax.jit(wrapped.step)
    expected = unwrapped_steps(env, LENGTH)

    for t in range(LENGTH):
        state = step(state, moves[t])
        last = float(t == LENGTH - 1)
        np.testing.assert_array_equal(state.done, np.full(BATCH, last))
        np.testing.assert_array_equal(state.info["truncation"], np.full(BATCH, last))
        np.testing.assert_array_equal(state.info["steps"], np.full(BATCH, t + 1))
    np.testing.assert_allclose(state.obs, obs_of(expected[-1]), rtol=1e-5, atol=1e-6)
    total = np.sum([reward_of(states) for states in expected], axis=0)
    np.testing.assert_allclose(state.info["episode_metrics"]["sum_reward"], total, rtol=1e-5)


@every_environment
def test_episode_wrapper_repeats_actions(name: str) -> None:
    env = envs_jax.make(name, reward="dense")
    wrapped: Any = EpisodeWrapper(VmapWrapper(env), 100, 3)
    move = actions(env, 1)[0]

    after = wrapped.step(wrapped.reset(keys()), move)

    for i, key in enumerate(keys()):
        state, total = env.reset(key), 0.0
        for _ in range(3):
            state = env.step(state, move[i])
            total += float(state.reward)
        np.testing.assert_allclose(after.obs[i], state.obs, rtol=1e-5, atol=1e-6)
        assert float(after.reward[i]) == pytest.approx(total, rel=1e-5)


@every_environment
def test_auto_reset_wrapper_starts_the_next_episode(name: str) -> None:
    env = envs_jax.make(name, reward="dense")
    wrapped: Any = AutoResetWrapper(EpisodeWrapper(VmapWrapper(env), LENGTH, 1))
    first = wrapped.reset(keys())
    start = np.asarray(first.obs)
    moves = actions(env, LENGTH)
    step = jax.jit(wrapped.step)

    state = first
    for t in range(LENGTH):
        state = step(state, moves[t])

    np.testing.assert_array_equal(state.done, np.ones(BATCH))
    np.testing.assert_array_equal(state.obs, start)
    for now, then in zip(
        jax.tree.leaves(state.pipeline_state),
        jax.tree.leaves(state.info["first_pipeline_state"]),
        strict=True,
    ):
        np.testing.assert_array_equal(now, then)
    # The second episode with the same actions goes the same way as the first one.
    for t, expected in enumerate(unwrapped_steps(env, LENGTH - 1)):
        state = step(state, moves[t])
        np.testing.assert_array_equal(state.done, np.zeros(BATCH))
        np.testing.assert_array_equal(state.info["steps"], np.full(BATCH, t + 1))
        np.testing.assert_allclose(state.obs, obs_of(expected), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", GOAL_NAMES)
def test_auto_reset_wrapper_after_success(name: str) -> None:
    """One member stands at its goal: it alone ends, with the bonus, and it alone starts again."""
    env = envs_jax.make(name)
    wrapped: Any = AutoResetWrapper(EpisodeWrapper(VmapWrapper(env), 100, 1))
    state = wrapped.reset(keys())
    goal = DRIFT_GOAL if name == "two_wheeled_drift" else np.asarray(state.task.goal[1])
    physical = state.pipeline_state
    moved = physical[0].at[1, :2].set(jnp.asarray(goal, jnp.float32))
    state = state.replace(pipeline_state=type(physical)(moved, physical.t.at[1].set(30)))
    stay = jnp.zeros(2) if name == "point2d" else jnp.array([-1.0, 0.0])

    after = wrapped.step(state, jnp.tile(stay, (BATCH, 1)))

    np.testing.assert_array_equal(after.done, [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(after.reward, [0.0, 69.0, 0.0])
    np.testing.assert_array_equal(after.metrics["success"], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(after.info["truncation"], np.zeros(BATCH))
    np.testing.assert_array_equal(after.obs[1], np.zeros(env.observation_size))
    np.testing.assert_array_equal(after.pipeline_state.t, [1, 0, 1])


@every_environment
def test_eval_wrapper_counts_the_first_episode_only(name: str) -> None:
    env = envs_jax.make(name, reward="dense")
    episodes: Any = EpisodeWrapper(VmapWrapper(env), LENGTH, 1)
    wrapped: Any = EvalWrapper(AutoResetWrapper(episodes))
    state, moves = wrapped.reset(keys()), actions(env, LENGTH + 2)
    step = jax.jit(wrapped.step)

    for move in moves:
        state = step(state, move)

    result = state.info["eval_metrics"]
    total = np.sum([reward_of(states) for states in unwrapped_steps(env, LENGTH)], axis=0)
    np.testing.assert_allclose(result.episode_metrics["reward"], total, rtol=1e-5)
    np.testing.assert_array_equal(result.active_episodes, np.zeros(BATCH))
    np.testing.assert_array_equal(result.episode_steps, np.full(BATCH, float(LENGTH)))
    assert "success" in result.episode_metrics
