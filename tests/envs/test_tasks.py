"""Which tasks each environment trains on, holds out and samples."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from tests.envs.steering import GOAL_NAMES

GOALS = ("point2d", "two_wheeled")


def degrees(goals: Any) -> np.ndarray:
    return np.degrees(np.arctan2(np.asarray(goals)[..., 1], np.asarray(goals)[..., 0]))


def structure(tree: Any) -> Any:
    return jax.tree.structure(tree)


def sampled(name: str, number: int) -> Any:
    keys = jax.random.split(jax.random.key(5), number)
    return jax.vmap(envs_jax.make(name).sample_task)(keys)


@pytest.mark.parametrize(
    ("name", "train", "test"),
    [
        ("point2d", np.arange(0, 166, 15.0), np.arange(7.5, 173, 15.0)),
        ("two_wheeled", np.arange(0, 173, 7.5), np.arange(3.75, 177, 7.5)),
    ],
)
def test_goals_are_at_the_stated_angles(name: str, train: np.ndarray, test: np.ndarray) -> None:
    env = envs_jax.make(name)

    for tasks, angles in ((env.train_tasks(), train), (env.test_tasks(), test)):
        assert tasks.goal.shape == (len(angles), 2)
        np.testing.assert_allclose(degrees(tasks.goal), angles, atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(tasks.goal, axis=-1), 2.0, rtol=1e-6)


def test_goals_worked_values() -> None:
    point, wheels = envs_jax.make("point2d"), envs_jax.make("two_wheeled")

    np.testing.assert_allclose(
        point.train_tasks().goal[jnp.array([0, 4, 6, 11])],
        [[2.0, 0.0], [1.0, 3.0**0.5], [0.0, 2.0], [-1.931852, 0.517638]],
        atol=1e-6,
    )
    np.testing.assert_allclose(wheels.train_tasks().goal[6], [2.0**0.5, 2.0**0.5], atol=1e-6)
    np.testing.assert_allclose(wheels.test_tasks().goal[0], [1.995718, 0.130806], atol=1e-6)


def test_drifts_worked_values() -> None:
    """24 values over [-0.7, 0.7]; held out are the middles of its 24 parts, and -0.65."""
    env = envs_jax.make("two_wheeled_drift")
    train = np.asarray(env.train_tasks().residual_angular_velocity)
    test = np.asarray(env.test_tasks().residual_angular_velocity)

    np.testing.assert_allclose(train, [-0.7 + 1.4 / 23 * i for i in range(24)], atol=1e-6)
    assert test.shape == (25,)
    np.testing.assert_allclose(test[:3], [-0.6708333, -0.6125, -0.5541667], atol=1e-6)
    np.testing.assert_allclose(test[-2:], [0.6708333, -0.65], atol=1e-6)


@pytest.mark.parametrize("name", GOAL_NAMES)
def test_held_out_tasks_are_not_training_tasks(name: str) -> None:
    env = envs_jax.make(name)
    train, test = (
        np.concatenate([np.asarray(leaf).reshape(len(leaf), -1) for leaf in tasks], axis=1)
        for tasks in (env.train_tasks(), env.test_tasks())
    )

    gaps = np.linalg.norm(test[:, None] - train[None], axis=-1)

    # Goals interleave. Drifts only differ: 24 middles do not interleave with 24 values.
    assert gaps.min() > (0.1 if name in GOALS else 1e-3)


@pytest.mark.parametrize("name", GOALS)
def test_sampled_goals_are_uniform_over_the_half_circle(name: str) -> None:
    goals = np.asarray(sampled(name, 3000).goal)
    angles = degrees(goals)

    np.testing.assert_allclose(np.linalg.norm(goals, axis=-1), 2.0, rtol=1e-6)
    assert angles.min() >= 0.0
    assert angles.max() <= 180.0
    # 300 in each tenth, plus or minus five standard deviations of a binomial count.
    counts = np.histogram(angles, bins=10, range=(0.0, 180.0))[0]
    np.testing.assert_allclose(counts, 300, atol=5 * np.sqrt(3000 * 0.1 * 0.9))


def test_sampled_drifts_are_uniform_over_their_range() -> None:
    drifts = np.asarray(sampled("two_wheeled_drift", 3000).residual_angular_velocity)

    assert np.abs(drifts).max() <= 0.7
    counts = np.histogram(drifts, bins=10, range=(-0.7, 0.7))[0]
    np.testing.assert_allclose(counts, 300, atol=5 * np.sqrt(3000 * 0.1 * 0.9))


@pytest.mark.parametrize("name", envs_jax.names())
def test_sampling_depends_on_the_key_alone(name: str) -> None:
    env = envs_jax.make(name)
    key, other = jax.random.key(1), jax.random.key(2)

    same, again = env.sample_task(key), env.sample_task(key)

    np.testing.assert_array_equal(jax.tree.leaves(same), jax.tree.leaves(again))
    tasks = jax.tree.leaves(sampled(name, 16))
    assert any(len(np.unique(np.asarray(leaf), axis=0)) > 1 for leaf in tasks)
    assert structure(same) == structure(env.sample_task(other))


@pytest.mark.parametrize("name", envs_jax.names())
def test_reset_takes_the_given_task_or_samples_one(name: str) -> None:
    env = envs_jax.make(name)
    key = jax.random.key(1)
    task = jax.tree.map(lambda leaf: leaf[1], env.train_tasks())

    given = env.reset(key, task)
    tasks = jax.vmap(env.reset)(jax.random.split(key, 16)).task

    np.testing.assert_array_equal(jax.tree.leaves(given.task), jax.tree.leaves(task))
    assert structure(tasks) == structure(task)
    assert any(len(np.unique(np.asarray(leaf), axis=0)) > 1 for leaf in jax.tree.leaves(tasks))


@pytest.mark.parametrize("name", GOAL_NAMES)
def test_episodes_start_at_the_origin_at_rest(name: str) -> None:
    env = envs_jax.make(name)

    state = env.reset(jax.random.key(3))

    np.testing.assert_array_equal(state.obs, np.zeros(env.observation_size))
    assert (int(state.pipeline_state.t), float(state.reward), float(state.done)) == (0, 0.0, 0.0)
    distance = 5.0**0.5 if name == "two_wheeled_drift" else 2.0
    assert float(state.metrics["distance"]) == pytest.approx(distance, rel=1e-6)
    assert float(state.metrics["success"]) == 0.0
