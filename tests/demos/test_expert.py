"""Experts: what their networks see, and that a few updates teach them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from emrld_jax.demos import expert as module
from emrld_jax.demos.expert import Expert, ExpertState, conditioned, expert
from emrld_jax.demos.value import append_task, task_vector, value_inputs
from emrld_jax.policy import MLP, Policy, gaussian_policy, mean_action
from emrld_jax.sampling.rollouts import episode
from envs_jax import Env
from envs_jax.goals import GoalTask
from envs_jax.two_wheeled_drift import DriftTask
from tests.conftest import compiled

KEY = jax.random.key(0)
GOAL = GoalTask(jnp.array([1.5, -2.0]))


def test_a_task_vector_holds_the_tasks_numbers() -> None:
    np.testing.assert_array_equal(task_vector(GOAL), [1.5, -2.0])
    np.testing.assert_array_equal(task_vector(DriftTask(jnp.array(0.25))), [0.25])


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_the_task_is_appended_to_every_observation(shape: tuple[int, ...]) -> None:
    obs = jnp.arange(3.0 * np.prod(shape)).reshape(*shape, 3)
    result = append_task(obs, GOAL)
    assert result.shape == (*shape, 5)
    np.testing.assert_array_equal(result[..., :3], obs)
    np.testing.assert_array_equal(result[..., 3:], np.broadcast_to([1.5, -2.0], (*shape, 2)))


def test_the_value_network_sees_the_task_and_the_part_of_the_time_that_has_passed() -> None:
    obs = jnp.arange(16.0).reshape(2, 4, 2)
    result = value_inputs(obs, GOAL)
    assert result.shape == (2, 4, 5)
    np.testing.assert_array_equal(result[..., :2], obs)
    np.testing.assert_array_equal(result[..., 2:4], np.broadcast_to([1.5, -2.0], (2, 4, 2)))
    np.testing.assert_allclose(result[..., 4], np.tile([0.0, 0.25, 0.5, 0.75], (2, 1)))


def test_the_policy_of_a_task_is_the_experts_with_the_task_appended() -> None:
    policy = gaussian_policy(4, 2, hidden_sizes=(8,))
    params, obs = policy.init(jax.random.key(0)), jnp.array([0.5, 0.1])
    result = conditioned(policy, GOAL).apply(params, obs)
    expected = policy.apply(params, jnp.array([0.5, 0.1, 1.5, -2.0]))
    np.testing.assert_array_equal(result.mean, expected.mean)


def test_the_mean_action_plays_the_same_episode_whatever_the_key() -> None:
    env = envs_jax.make("point2d", horizon=5)
    noisy = conditioned(gaussian_policy(4, 2, hidden_sizes=(8,)), GOAL)
    params = noisy.init(jax.random.key(0))

    def played(policy: Policy, seed: int) -> jax.Array:
        return episode(env, policy, params, jax.random.key(seed), GOAL).action

    first = played(mean_action(noisy), 0)
    np.testing.assert_array_equal(played(mean_action(noisy), 1), first)
    np.testing.assert_allclose(first[0], noisy.apply(params, jnp.zeros(2)).mean, rtol=1e-5)
    assert not np.allclose(played(noisy, 0), played(noisy, 1))


def small_expert(env: Env, **settings: Any) -> Expert:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "HIDDEN_SIZES", (16, 16))
        return expert(env, **settings)


def test_some_updates_raise_the_return_and_the_tasks_are_told_apart() -> None:
    """Goals left and right: only a policy that knows its task comes nearer to both."""
    env = envs_jax.make("point2d", reward="dense", horizon=20)
    tasks = GoalTask(2.0 * jnp.array([[1.0, 0.0], [-1.0, 0.0]]))
    one = small_expert(env, num_episodes=8, max_kl=0.04)
    state, returns = one.init(jax.random.key(2)), []
    for i in range(25):
        state, metrics = one.update(state, jax.random.key(200 + i), tasks)
        assert all(np.isfinite(value) for value in metrics.values())
        assert float(metrics["outer/kl"]) < 0.04
        returns.append(float(metrics["expert/return"]))
    # Standing still returns -40, going straight -19.
    assert np.mean(returns[-3:]) > np.mean(returns[:3]) + 8

    @jax.jit
    @jax.vmap
    def end(task: GoalTask) -> jax.Array:
        own = mean_action(conditioned(one.policy, task))
        return episode(env, own, state.policy, KEY, task).obs[-1]

    ends = end(tasks)
    assert compiled(one.update) == 1
    assert float(ends[0, 0]) > 0.3
    assert float(ends[1, 0]) < -0.3


def test_the_value_network_learns_the_returns_and_the_same_keys_give_the_same() -> None:
    """A policy that hardly moves returns about minus the distance of each of 8 steps."""
    env = envs_jax.make("point2d", reward="dense", horizon=8)
    tasks = GoalTask(jnp.array([[1.0, 0.0], [0.0, 3.0]]))
    one = small_expert(env, num_episodes=4, max_kl=1e-6, value_steps=100)

    def trained() -> ExpertState:
        state = one.init(KEY)
        for i in range(4):
            state, _ = one.update(state, jax.random.key(i), tasks)
        return state

    state = trained()
    jax.tree.map(np.testing.assert_array_equal, trained(), state)
    network = MLP((16, 16, 1), "tanh")
    for goal, distance in zip(tasks.goal, (1.0, 3.0), strict=True):
        inputs = value_inputs(jnp.zeros((1, 8, 2)), GoalTask(goal))[0, 0]
        output: Any = network.apply(state.value.params, inputs)
        value = float(output[0]) / (1 - 0.99)
        expected = -distance * sum(0.99**t for t in range(8))
        assert abs(value - expected) < 0.4 * abs(expected)
