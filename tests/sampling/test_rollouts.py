"""Episodes against environments stepped by hand, and gathered steps against NumPy indexing."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from emrld_jax.meta.inner import policy_gradient_loss
from emrld_jax.policy import Policy, gaussian_policy
from emrld_jax.sampling.advantages import advantages
from emrld_jax.sampling.rollouts import (
    collector,
    episode,
    episode_divergences,
    episode_returns,
    episode_successes,
    gather_living,
    living_steps,
    without_idle_steps,
)
from emrld_jax.types import Gaussian, Rollout, Trajectory
from envs_jax import Env
from envs_jax.goals import GoalTask

HORIZON = 8
POINT = envs_jax.make("point2d", horizon=HORIZON, reward_radius=0.15, goal_radius=0.06)
NEAR = GoalTask(jnp.array([0.3, 0.0]))  # m; three steps to the right


def small_policy(env: Env) -> tuple[Policy, Any]:
    policy = gaussian_policy(env.observation_size, env.action_size, hidden_sizes=(8,), std=0.8)
    return policy, policy.init(jax.random.key(1))


def straight() -> Policy:
    """Always moves to the right, without noise."""

    def apply(params: Any, obs: jax.Array) -> Gaussian:
        mean = jnp.broadcast_to(jnp.array([1.0, 0.0]), obs.shape)
        return Gaussian(mean, jnp.full_like(mean, -jnp.inf))

    return Policy(lambda key: (), apply)


def by_hand(env: Env, policy: Policy, params: Any, key: jax.Array, task: Any) -> Trajectory:
    """Steps the environment in a Python loop until it ends the episode."""
    reset_key, noise_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (env.horizon, env.action_size))
    state, rows = env.reset(reset_key, task), []
    for t in range(env.horizon):
        mean, log_std = policy.apply(params, state.obs)
        action = np.asarray(mean) + np.exp(np.asarray(log_std)) * np.asarray(noise[t])
        following = env.step(state, jnp.asarray(action))
        outcome = (following.metrics["success"], following.metrics["diverged"])
        z = np.asarray(noise[t])
        density = np.mean(-0.5 * z**2 - np.asarray(log_std) - 0.5 * np.log(2 * np.pi))
        step = (state.obs, action, following.reward, following.done, *outcome, 1.0, density)
        rows.append(step)
        state = following
        if following.done:
            break
    columns: list[Any] = [np.stack(column) for column in zip(*rows, strict=True)]
    return Trajectory(*columns)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    ("env", "task"),
    [
        (POINT, GoalTask(jnp.array([0.1, 0.1]))),
        (POINT, GoalTask(jnp.array([0.0, 2.0]))),
        (envs_jax.make("two_wheeled", horizon=HORIZON), GoalTask(jnp.array([0.4, 0.0]))),
    ],
    ids=["point2d near", "point2d far", "two_wheeled near"],
)
def test_an_episode_is_the_environment_stepped_by_hand(env: Env, task: Any, seed: int) -> None:
    policy, params = small_policy(env)
    key = jax.random.key(seed)
    result = episode(env, policy, params, key, task)
    expected = by_hand(env, policy, params, key, task)
    length = len(expected.mask)
    np.testing.assert_array_equal(result.mask, np.arange(env.horizon) < length)
    for name, value in expected._asdict().items():
        kept = getattr(result, name)[:length]
        np.testing.assert_allclose(kept, value, atol=1e-5, err_msg=name)


def test_some_of_these_episodes_end_early() -> None:
    """Otherwise the test above would say nothing about ends."""
    policy, params = small_policy(POINT)
    keys = jax.random.split(jax.random.key(0), 30)
    task = GoalTask(jnp.array([0.1, 0.1]))
    masks = jax.vmap(lambda k: episode(POINT, policy, params, k, task).mask)(keys)
    lengths = np.asarray(masks.sum(axis=1))
    assert lengths.min() < HORIZON
    assert lengths.max() == HORIZON


def test_a_straight_walk_to_the_goal_in_worked_numbers() -> None:
    result = episode(POINT, straight(), (), jax.random.key(0), NEAR)
    np.testing.assert_array_equal(result.mask, [1, 1, 1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(result.done[:3], [0, 0, 1])
    np.testing.assert_allclose(result.obs[:3], [[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]], atol=1e-6)
    # 0.2 m away: nothing; 0.1 m away: 1 - 0.1; at the goal in step 2: 8 - 2 - 1
    np.testing.assert_allclose(result.reward[:3], [0.0, 0.9, 5.0], atol=1e-6)
    np.testing.assert_allclose(episode_returns(result), 5.9, atol=1e-5)
    np.testing.assert_array_equal(episode_successes(result), 1.0)


def test_the_row_after_an_episodes_end_is_where_it_ended() -> None:
    """Pictures of paths rely on it."""
    walk = episode(POINT, straight(), (), jax.random.key(0), NEAR)
    np.testing.assert_allclose(walk.obs[:4, 0], [0.0, 0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_array_equal(walk.mask[:4], [1, 1, 1, 0])


def test_a_walk_past_no_goal_lasts_until_the_horizon_and_is_no_success() -> None:
    task = GoalTask(jnp.array([-1.0, 0.0]))
    result = episode(POINT, straight(), (), jax.random.key(0), task)
    np.testing.assert_array_equal(result.mask, np.ones(HORIZON))
    np.testing.assert_array_equal(episode_successes(result), 0.0)


def test_figures_of_episodes_count_only_what_exists() -> None:
    trajectory = Trajectory(
        obs=jnp.zeros((2, 3, 1)),
        action=jnp.zeros((2, 3, 1)),
        reward=jnp.array([[1.0, 2.0, 40.0], [1.0, 2.0, 3.0]]),
        done=jnp.zeros((2, 3)),
        success=jnp.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]),
        diverged=jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]),
        mask=jnp.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]]),
        log_prob=jnp.zeros((2, 3)),
    )
    np.testing.assert_array_equal(episode_returns(trajectory), [3.0, 6.0])
    np.testing.assert_array_equal(episode_successes(trajectory), [1.0, 0.0])
    np.testing.assert_array_equal(episode_divergences(trajectory), [0.0, 1.0])


def test_the_collector_gives_each_episode_its_own_key_and_its_advantages() -> None:
    policy, params = small_policy(POINT)
    key = jax.random.key(4)
    rollout = collector(POINT, policy, 3, 0.9, 0.8)(params, key, NEAR)
    for e, own in enumerate(jax.random.split(key, 3)):
        expected = episode(POINT, policy, params, own, NEAR)
        np.testing.assert_allclose(rollout.trajectory.action[e], expected.action, atol=1e-5)
    assert not np.allclose(rollout.trajectory.action[0], rollout.trajectory.action[1])
    expected_advantage = advantages(rollout.trajectory, 0.9, 0.8)
    np.testing.assert_allclose(rollout.advantage, expected_advantage, atol=1e-5)


def random_rollout(lengths: tuple[int, ...], horizon: int = 5) -> Rollout:
    rng = np.random.default_rng(0)
    shape = (len(lengths), horizon)
    mask = (np.arange(horizon) < np.array(lengths)[:, None]).astype(np.float32)
    obs, action = (jnp.asarray(rng.normal(size=(*shape, 2)), jnp.float32) for _ in range(2))
    reward, done, success, diverged, density, advantage = (
        jnp.asarray(rng.normal(size=shape), jnp.float32) for _ in range(6)
    )
    exists = jnp.asarray(mask)
    steps = Trajectory(obs, action, reward, done, success, diverged, exists, density)
    return Rollout(steps, advantage)


@pytest.mark.parametrize("every", [1, 2, 3])
@pytest.mark.parametrize("lengths", [(5, 2, 1, 4), (1, 1, 1, 1), (5, 5, 5, 5)])
def test_gathered_steps_are_numpys_boolean_selection(lengths: tuple[int, ...], every: int) -> None:
    rollout, living = random_rollout(lengths), sum(lengths)
    assert int(living_steps(rollout)) == living
    exists = np.asarray(rollout.trajectory.mask) > 0
    for room in (living, 20):
        size = -(-room // every)
        gathered = gather_living(rollout, size, every)
        kept = -(-living // every)
        np.testing.assert_array_equal(gathered.trajectory.mask, np.arange(size) < kept)
        pairs = zip(jax.tree.leaves(gathered), jax.tree.leaves(rollout), strict=True)
        for ours, original in pairs:
            assert ours.shape == (size, *original.shape[2:])
            np.testing.assert_array_equal(ours[:kept], np.asarray(original)[exists][::every])


def test_sums_over_gathered_steps_are_sums_over_all() -> None:
    rollout = random_rollout((5, 2, 1, 4))
    gathered = gather_living(rollout, 15)
    ours = jnp.sum(gathered.advantage * gathered.trajectory.mask)
    np.testing.assert_allclose(
        ours, jnp.sum(rollout.advantage * rollout.trajectory.mask), rtol=1e-5
    )


def test_steps_of_advantage_zero_change_no_policy_gradient() -> None:
    """Loss and gradient are those of all steps, whichever of them weigh nothing."""
    policy, params = small_policy(POINT)
    rollout = random_rollout((5, 2, 1, 4))
    idle = np.arange(rollout.advantage.size).reshape(rollout.advantage.shape) % 3 == 0
    rollout = rollout._replace(advantage=jnp.where(idle, 0.0, rollout.advantage))

    def gradient(rollout: Rollout) -> Any:
        return jax.value_and_grad(lambda p: policy_gradient_loss(policy, p, rollout))(params)

    fewer = without_idle_steps(rollout)
    assert 0 < jnp.sum(fewer.trajectory.mask) < jnp.sum(rollout.trajectory.mask)
    pairs = zip(*(jax.tree.leaves(gradient(r)) for r in (fewer, rollout)), strict=True)
    for ours, expected in pairs:
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-6)


def test_without_a_reward_no_step_stays() -> None:
    rollout = random_rollout((5, 2))
    nothing = without_idle_steps(rollout._replace(advantage=jnp.zeros_like(rollout.advantage)))
    assert not nothing.trajectory.mask.any()
    assert not nothing.advantage.any()


def test_living_steps_of_a_batch_of_tasks() -> None:
    pair = [random_rollout((5, 2)), random_rollout((1, 1))]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *pair)
    np.testing.assert_array_equal(living_steps(batch), [7, 2])
