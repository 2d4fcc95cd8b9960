"""Experts: what their networks see, and that a few updates teach them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from emrld_jax.demos import expert as module
from emrld_jax.demos.expert import (
    append_task,
    conditioned,
    expert,
    task_vector,
    value_inputs,
)
from emrld_jax.policy import MLP, Policy, gaussian_policy, mean_action
from emrld_jax.sampling.rollouts import episode
from envs_jax.goals import GoalTask
from envs_jax.two_wheeled_drift import DriftTask

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


@pytest.fixture
def small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "HIDDEN_SIZES", (16, 16))


@pytest.mark.usefixtures("small_networks")
def test_some_updates_raise_the_return_and_the_tasks_are_told_apart() -> None:
    """Goals left and right: only a policy that knows its task comes nearer to both."""
    env = envs_jax.make("point2d", reward="dense", horizon=20)
    tasks = GoalTask(2.0 * jnp.array([[1.0, 0.0], [-1.0, 0.0]]))
    one = expert(env, num_episodes=8, max_kl=0.04)
    state = one.init(jax.random.key(0))
    returns = []
    for i in range(30):
        state, metrics = one.update(state, jax.random.key(i), tasks)
        assert all(np.isfinite(value) for value in metrics.values())
        returns.append(float(metrics["expert/return"]))
        assert float(metrics["outer/kl"]) < 0.05
    # Standing still returns -40, going straight -19.
    first, last = np.mean(returns[:3]), np.mean(returns[-3:])
    assert last > first + 8
    best = jax.jit(
        jax.vmap(
            lambda task: episode(
                env, mean_action(conditioned(one.policy, task)), state.policy, KEY, task
            ).obs[-1]
        )
    )(tasks)
    assert float(best[0, 0]) > 0.2
    assert float(best[1, 0]) < -0.2


@pytest.mark.usefixtures("small_networks")
def test_an_update_is_a_function_of_its_arguments() -> None:
    env = envs_jax.make("point2d", reward="dense", horizon=8)
    one = expert(env, num_episodes=2, value_steps=2)
    state, tasks = one.init(KEY), GoalTask(jnp.array([[1.0, 0.0], [0.0, 1.0]]))
    first, again = (one.update(state, jax.random.key(3), tasks) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)


@pytest.mark.usefixtures("small_networks")
def test_the_value_network_learns_the_returns() -> None:
    """Many steps on the same tasks bring the values of the first observation to the returns."""
    env = envs_jax.make("point2d", reward="dense", horizon=8)
    tasks = GoalTask(jnp.array([[1.0, 0.0], [0.0, 3.0]]))
    one = expert(env, num_episodes=4, max_kl=1e-6, value_steps=100)
    state = one.init(KEY)
    for i in range(4):
        state, _ = one.update(state, jax.random.key(i), tasks)
    network = MLP((16, 16, 1), "tanh")
    for goal, distance in zip(tasks.goal, (1.0, 3.0), strict=True):
        inputs = value_inputs(jnp.zeros((1, 8, 2)), GoalTask(goal))[0, 0]
        output: Any = network.apply(state.value, inputs)
        value = 100.0 * float(output[0])
        # The policy hardly moves: about the distance for 8 steps, discounted by 0.99.
        expected = -distance * sum(0.99**t for t in range(8))
        assert abs(value - expected) < 0.4 * abs(expected)
