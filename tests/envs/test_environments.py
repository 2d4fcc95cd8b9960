"""What every environment owes its users, whatever it simulates: all names run through these."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax

every_environment = pytest.mark.parametrize("name", envs_jax.names())


def first_task(tasks: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], tasks)


def structure(tree: Any) -> Any:
    return jax.tree.structure(tree)


def shapes_and_types(tree: Any) -> list[tuple[Any, Any]]:
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


@every_environment
def test_description_is_complete(name: str) -> None:
    env = envs_jax.make(name)

    assert env.name == name
    assert len(env.observation_names) == len(env.observation_units) == env.observation_size
    assert len(env.action_names) == len(env.action_units) == env.action_size
    assert len(env.action_low) == len(env.action_high) == env.action_size
    assert np.all(np.array(env.action_low) < np.array(env.action_high))
    assert (env.horizon, env.reward) == (100, "sparse")
    assert env.dt > 0
    assert type(env).__doc__


@every_environment
def test_shapes_and_types(name: str) -> None:
    env = envs_jax.make(name)

    before = env.reset(jax.random.key(0))
    after = env.step(before, jnp.zeros(env.action_size))

    for state in (before, after):
        assert state.obs.shape == (env.observation_size,)
        assert state.reward.shape == state.done.shape == state.metrics["success"].shape == ()
        floats = [state.obs, state.reward, state.done, state.metrics, state.task]
        assert {leaf.dtype for leaf in jax.tree.leaves(floats)} == {np.dtype(np.float32)}
    assert structure(before) == structure(after)
    assert shapes_and_types(before) == shapes_and_types(after)
    assert env.to_physical(jnp.zeros(env.action_size)).dtype == jnp.float32
    assert env.to_policy(jnp.zeros(env.action_size)).dtype == jnp.float32
    tasks = [env.train_tasks(), env.test_tasks(), env.sample_task(jax.random.key(0))]
    assert {leaf.dtype for leaf in jax.tree.leaves(tasks)} == {np.dtype(np.float32)}


@every_environment
def test_reset_and_step_trace_once(name: str) -> None:
    """Whatever state comes in, from a reset, from a step or with another task."""
    env = envs_jax.make(name)
    traced = {"reset": 0, "step": 0}

    @jax.jit
    def reset(key: jax.Array, task: Any) -> Any:
        traced["reset"] += 1
        return env.reset(key, task)

    @jax.jit
    def step(state: Any, action: jax.Array) -> Any:
        traced["step"] += 1
        return env.step(state, action)

    key, action = jax.random.key(0), jnp.zeros(env.action_size)
    tasks = (first_task(env.train_tasks()), first_task(env.test_tasks()), env.sample_task(key))
    for task in tasks:
        step(step(env.reset(key, task), action), action)
        step(step(reset(key, task), action), 0.3 + action)

    assert traced == {"reset": 1, "step": 1}


@every_environment
def test_step_changes_nothing_that_it_was_given(name: str) -> None:
    env = envs_jax.make(name)
    before = env.reset(jax.random.key(0))
    copy = jax.tree.map(np.array, before)

    after = env.step(before, jnp.full(env.action_size, 0.5))

    for now, then in zip(jax.tree.leaves(before), jax.tree.leaves(copy), strict=True):
        np.testing.assert_array_equal(now, then)
    for now, then in zip(jax.tree.leaves(after.task), jax.tree.leaves(copy.task), strict=True):
        np.testing.assert_array_equal(now, then)


@every_environment
def test_step_keeps_what_others_wrote(name: str) -> None:
    """Wrappers keep figures of their own in metrics and info."""
    env = envs_jax.make(name)
    state = env.reset(jax.random.key(0))
    metrics = {**state.metrics, "extra": jnp.array(3.0)}
    state = replace(state, metrics=metrics, info={"wrapper": jnp.array(4.0)})

    after = env.step(state, jnp.zeros(env.action_size))

    assert set(after.metrics) == set(state.metrics)
    assert float(after.metrics["extra"]) == 3.0
    assert {key: float(value) for key, value in after.info.items()} == {"wrapper": 4.0}


@every_environment
def test_states_of_two_resets_share_nothing(name: str) -> None:
    """Wrappers write into info; the next episode must not see it."""
    env = envs_jax.make(name)
    state = env.reset(jax.random.key(0))
    state.info["mine"] = jnp.zeros(())
    state.metrics["mine"] = jnp.zeros(())

    again = env.reset(jax.random.key(0))

    assert "mine" not in again.info
    assert "mine" not in again.metrics


@every_environment
def test_a_batch_equals_its_members(name: str) -> None:
    env = envs_jax.make(name, reward="dense")
    keys = jax.random.split(jax.random.key(0), 3)
    actions = jax.random.normal(jax.random.key(1), (3, env.action_size))

    batch = jax.vmap(env.step)(jax.vmap(env.reset)(keys), actions)

    for i in range(3):
        one = env.step(env.reset(keys[i]), actions[i])
        np.testing.assert_allclose(batch.obs[i], one.obs, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(batch.reward[i], one.reward, rtol=1e-6, atol=1e-6)


@every_environment
def test_the_horizon_is_not_an_ending(name: str) -> None:
    """Truncation is the rollout's business: doing nothing in particular never ends an episode."""
    env = envs_jax.make(name, horizon=2)
    state = env.reset(jax.random.key(0), first_task(env.train_tasks()))

    for _ in range(4):
        state = env.step(state, jnp.zeros(env.action_size))
        assert float(state.done) == 0.0


@every_environment
def test_environments_are_values(name: str) -> None:
    """Equal and hashable by their parameters, so that they can be static arguments of jit."""
    env = envs_jax.make(name)

    assert env == envs_jax.make(name)
    assert hash(env) == hash(envs_jax.make(name))
    assert env != envs_jax.make(name, horizon=50)
    assert envs_jax.make(name, horizon=50).horizon == 50


def test_names() -> None:
    assert {"point2d", "two_wheeled", "two_wheeled_drift"} <= set(envs_jax.names())


def test_an_unknown_name_gets_a_suggestion() -> None:
    with pytest.raises(ValueError, match="'point_2d' is unknown; did you mean 'point2d'") as error:
        envs_jax.make("point_2d")
    for name in envs_jax.names():
        assert name in str(error.value)


def test_a_name_like_no_other_gets_the_list() -> None:
    with pytest.raises(ValueError, match=r"'xyz' is unknown \(there are: .*two_wheeled"):
        envs_jax.make("xyz")


@every_environment
def test_an_unknown_parameter_gets_a_suggestion(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} has no parameter 'horizont'; did you mean"):
        envs_jax.make(name, horizont=50)


@every_environment
@pytest.mark.parametrize(
    ("parameter", "value"), [("reward", "shaped"), ("horizon", 0), ("horizon", -3)]
)
def test_impossible_values_are_refused_by_name(name: str, parameter: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{parameter}={value!r}"):
        envs_jax.make(name, **{parameter: value})


@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        ("point2d", "goal_radius"),
        ("point2d", "reward_radius"),
        ("two_wheeled", "goal_half_width"),
        ("two_wheeled_drift", "reward_radius"),
    ],
)
@pytest.mark.parametrize("value", [0.0, -0.1, float("nan"), float("inf")])
def test_sizes_must_be_positive(name: str, parameter: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{parameter}={value}"):
        envs_jax.make(name, **{parameter: value})
