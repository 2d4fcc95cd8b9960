"""From policy units to physical units and back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax

WHEELS = {"two_wheeled": (0.22, 2.84), "two_wheeled_drift": (0.15, 1.5)}


def random_actions(seed: int) -> np.ndarray:
    """Policy actions [3000, 2] of every size, from hardly anything to a thousand."""
    generator = np.random.default_rng(seed)
    size = 10.0 ** generator.uniform(-3.0, 3.0, (3000, 1))
    return (size * generator.standard_normal((3000, 2))).astype(np.float32)


def physical(name: str, actions: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(envs_jax.make(name).to_physical)(jnp.asarray(actions)))


@pytest.mark.parametrize("name", envs_jax.names())
def test_every_action_becomes_a_possible_one(name: str) -> None:
    env = envs_jax.make(name)
    size = 10.0 ** np.random.default_rng(0).uniform(-3.0, 3.0, (500, 1))
    noise = np.random.default_rng(1).standard_normal((500, env.action_size))

    commands = physical(name, (size * noise).astype(np.float32))

    rounding = 1e-6 * np.maximum(np.abs(env.action_low), np.abs(env.action_high))
    assert np.all(commands >= np.array(env.action_low) - rounding)
    assert np.all(commands <= np.array(env.action_high) + rounding)


@pytest.mark.parametrize("name", envs_jax.names())
def test_possible_actions_survive_the_way_there_and_back(name: str) -> None:
    """Within half of the range, no environment bounds anything, and the two maps are inverse."""
    env = envs_jax.make(name)
    half = np.random.default_rng(2).uniform(-0.5, 0.5, (500, env.action_size))
    actions = jnp.asarray(half, jnp.float32)
    low, high = np.array(env.action_low), np.array(env.action_high)
    commands = jnp.asarray(low + (half + 1.0) / 2.0 * (high - low), jnp.float32)

    np.testing.assert_allclose(jax.vmap(env.to_physical)(actions), commands, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(env.to_policy)(commands), actions, atol=2e-6)


@pytest.mark.parametrize("name", envs_jax.names())
def test_the_ends_of_the_range(name: str) -> None:
    env = envs_jax.make(name)
    ones = np.ones(env.action_size)

    np.testing.assert_allclose(env.to_policy(jnp.array(env.action_low)), -ones, atol=1e-6)
    np.testing.assert_allclose(env.to_policy(jnp.array(env.action_high)), ones, atol=1e-6)


def test_to_policy_is_linear_beyond_the_bounds() -> None:
    """Recorded commands may exceed the bounds; they are not bounded a second time."""
    np.testing.assert_allclose(
        envs_jax.make("point2d").to_policy(jnp.array([0.2, -0.3])), [2.0, -3.0], rtol=1e-6
    )
    np.testing.assert_allclose(
        envs_jax.make("two_wheeled").to_policy(jnp.array([0.33, 4.26])), [2.0, 1.5], rtol=1e-6
    )


def test_point2d_projects_radially() -> None:
    actions = random_actions(3)
    wanted = 0.1 * actions.astype(np.float64)
    length = np.linalg.norm(wanted, axis=-1)

    moved = physical("point2d", actions)

    moved_length = np.linalg.norm(moved, axis=-1)
    np.testing.assert_allclose(moved_length, np.minimum(length, 0.1), rtol=1e-5, atol=1e-7)
    # The same direction: per-dimension clipping would turn it toward a diagonal.
    cross = wanted[:, 0] * moved[:, 1] - wanted[:, 1] * moved[:, 0]
    long = length > 1e-3
    assert np.abs(cross / (length * moved_length))[long].max() < 1e-4
    assert np.all(np.sum(wanted * moved, axis=-1)[long] > 0)
    assert 500 < np.sum(length > 0.1) < 2500


def test_point2d_worked_values() -> None:
    env = envs_jax.make("point2d")

    for action, displacement in [
        ([0.0, 0.0], [0.0, 0.0]),
        ([1.0, 0.0], [0.1, 0.0]),
        ([3.0, 4.0], [0.06, 0.08]),
        ([1.0, -1.0], [0.0707107, -0.0707107]),
        ([0.3, 0.4], [0.03, 0.04]),
    ]:
        np.testing.assert_allclose(env.to_physical(jnp.array(action)), displacement, atol=1e-7)


@pytest.mark.parametrize("name", list(WHEELS))
def test_wheels_bound_each_velocity(name: str) -> None:
    linear, angular = WHEELS[name]
    actions = random_actions(4)
    wanted = np.stack([(actions[:, 0] + 1.0) / 2.0 * linear, actions[:, 1] * angular], axis=-1)

    expected = np.stack(
        [np.clip(wanted[:, 0], 0.0, linear), np.clip(wanted[:, 1], -angular, angular)], axis=-1
    )

    np.testing.assert_allclose(physical(name, actions), expected, rtol=1e-5, atol=1e-6)
    assert np.sum(expected[:, 0] == 0.0) > 300
    assert np.sum(expected[:, 0] == linear) > 300
    assert np.sum(np.abs(expected[:, 1]) == angular) > 300


@pytest.mark.parametrize("name", list(WHEELS))
def test_wheels_worked_values(name: str) -> None:
    linear, angular = WHEELS[name]
    env = envs_jax.make(name)

    for action, velocities in [
        ([-1.0, 0.0], [0.0, 0.0]),
        ([0.0, 0.5], [linear / 2, angular / 2]),
        ([1.0, -1.0], [linear, -angular]),
        ([9.0, -9.0], [linear, -angular]),
        ([-9.0, 9.0], [0.0, angular]),
    ]:
        np.testing.assert_allclose(env.to_physical(jnp.array(action)), velocities, atol=1e-6)
