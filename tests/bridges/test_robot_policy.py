"""The policy in NumPy against the trained network, the environments, and worked numbers."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from bridges.activations import ACTIVATIONS
from bridges.bundle import Bundle, Environment
from bridges.environments import (
    described,
    described_task,
    environment_of,
    task_of,
    zone,
)
from bridges.messages import BridgeError
from bridges.parameters import params_of, tensors_of
from bridges.policy import Policy
from emrld_jax import policy as jax_policy
from emrld_jax.policy import gaussian_policy
from envs_jax.point2d import Point2D
from tests.bridges.bundles import a_bundle

NUMBER = 10_000  # observations
SHAPES = [(2, (100, 100), 2), (3, (100, 100), 2), (20, (64, 32, 16), 6), (4, (), 1), (1, (1,), 3)]
KINDS = list(product(ACTIVATIONS, (False, True)))  # activation, squash


def observations(size: int, farthest: float = 3.0) -> np.ndarray:
    generator = np.random.default_rng(3)
    return generator.uniform(-farthest, farthest, (NUMBER, size)).astype(np.float32)


def trained(bundle: Bundle, obs: np.ndarray) -> np.ndarray:
    """The mean actions of the policy that was trained, in the precision that is on."""
    policy = gaussian_policy(
        len(bundle.observation.names),
        len(bundle.action.names),
        hidden_sizes=bundle.policy.hidden_sizes,
        activation=bundle.policy.activation,
        squash=bundle.policy.squash,
    )
    wanted = float if jax.config.read("jax_enable_x64") else jnp.float32
    params = jax.tree.map(lambda x: jnp.asarray(x, wanted), params_of(bundle, "policy"))
    return np.asarray(jax.jit(policy.apply)(params, jnp.asarray(obs, wanted)).mean)


def test_the_activations_are_those_that_are_trained() -> None:
    assert list(ACTIVATIONS) == list(jax_policy.ACTIVATIONS)


@pytest.mark.parametrize(
    ("shape", "activation", "squash"),
    [(SHAPES[2], *kind) for kind in KINDS] + [(shape, "tanh", False) for shape in SHAPES],
)
def test_it_computes_the_trained_networks_function(
    shape: tuple[int, tuple[int, ...], int], activation: str, squash: bool
) -> None:
    """In float64, where nothing but a different function makes a difference."""
    inputs, hidden_sizes, actions = shape
    bundle = a_bundle(inputs, actions, hidden_sizes, activation, squash)
    obs = observations(inputs, farthest=30.0)
    with jax.enable_x64(True):
        expected = trained(bundle, obs)

    result = Policy(bundle).mean(obs)

    assert expected.dtype == np.float64
    assert result.shape == (NUMBER, actions)
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "activation", "squash"),
    [(SHAPES[1], *kind) for kind in KINDS] + [(SHAPES[0], "tanh", False)],
)
def test_its_actions_are_the_trained_policys(
    shape: tuple[int, tuple[int, ...], int], activation: str, squash: bool
) -> None:
    """Within 1e-6 of policies as they are trained: float32, wide, bounds at -1 and 1."""
    bundle = a_bundle(shape[0], shape[2], shape[1], activation, squash)
    obs = observations(shape[0])
    expected = trained(bundle, obs)

    result = Policy(bundle).mean(obs)

    assert expected.dtype == np.float32
    assert 0.3 < np.abs(expected).max() < 10
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6)


def test_one_observation_is_a_row_of_many() -> None:
    policy, obs = Policy(a_bundle(hidden_sizes=(30, 30))), observations(3)[:20]

    many = policy.mean(obs)

    assert policy.mean(obs[0]).shape == (2,)
    np.testing.assert_allclose([policy.mean(one) for one in obs], many, atol=1e-14)
    np.testing.assert_allclose(policy.mean(obs.reshape(4, 5, 3)), many.reshape(4, 5, 2), atol=1e-14)
    np.testing.assert_allclose(policy.mean(obs[0].tolist()), many[0], atol=1e-14)


def test_a_network_by_hand() -> None:
    """relu(2 * 1.5 - 1) = 2 and relu(-1.5) = 0; 3 * 2 + 7 * 0 + 0.5 = 6.5."""
    tensors = {
        "policy/layer_0/kernel": np.array([[2.0, -1.0]]),
        "policy/layer_0/bias": np.array([-1.0, 0.0]),
        "policy/layer_1/kernel": np.array([[3.0], [7.0]]),
        "policy/layer_1/bias": np.array([0.5]),
    }
    bundle = a_bundle(1, 1, (2,), "relu")
    policy = Policy(replace(bundle, tensors={**bundle.tensors, **tensors}))

    assert policy.mean([1.5]) == pytest.approx([6.5], abs=1e-15)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_large_numbers_make_no_warning(activation: str) -> None:
    policy = Policy(a_bundle(activation=activation))

    assert np.isfinite(policy.mean([1e6, -1e6, 1e6])).all()


def test_samples_scatter_around_the_mean_by_the_standard_deviation() -> None:
    bundle = a_bundle()
    log_std = np.log(np.array([0.3, 0.7], np.float32))
    policy = Policy(replace(bundle, tensors={**bundle.tensors, "policy/log_std": log_std}))
    obs = np.tile([0.1, -0.2, 0.3], (NUMBER, 1))

    samples = policy.sample(obs, np.random.default_rng(0))

    np.testing.assert_allclose(policy.std, [0.3, 0.7], rtol=1e-6)
    np.testing.assert_allclose(samples.std(axis=0), [0.3, 0.7], rtol=0.03)
    np.testing.assert_allclose(samples.mean(axis=0), policy.mean(obs[0]), atol=0.03)
    one = policy.sample(obs[0], np.random.default_rng(0))
    np.testing.assert_allclose(one, samples[0])


@pytest.mark.parametrize(
    ("obs", "words"),
    [
        ([1.0, 2.0], r"must be \(x, y, theta\)"),
        (1.0, r"must be \(x, y, theta\)"),
        ([[1.0], [2.0], [3.0]], r"must be \(x, y, theta\)"),
        ([0.0, np.nan, 0.0], "must be finite"),
        ([0.0, 0.0, np.inf], "must be finite"),
    ],
)
def test_what_is_no_observation_is_refused(obs: Any, words: str) -> None:
    with pytest.raises(BridgeError, match=words):
        Policy(a_bundle()).mean(obs)


@pytest.mark.parametrize("name", envs_jax.names())
def test_actions_are_executed_as_the_environment_does(name: str) -> None:
    env = envs_jax.make(name)
    environment, observation, action = described(env)
    bundle = replace(
        a_bundle(env.observation_size, env.action_size),
        environment=environment,
        observation=observation,
        action=action,
    )
    generator = np.random.default_rng(0)
    actions = generator.uniform(-4, 4, (NUMBER, env.action_size)).astype(np.float32)
    actions[0], actions[1], actions[2] = 0.0, 1.0, -1.0
    expected = np.asarray(jax.jit(jax.vmap(env.to_physical))(jnp.asarray(actions)))

    result = Policy(bundle).to_physical(actions)

    assert action.bounding == ("norm" if name == "point2d" else "box")
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6)
    assert (np.abs(expected - np.asarray(env.to_physical(jnp.zeros(env.action_size)))) > 0).any()
    one = Policy(bundle).to_physical(list(actions[7]))
    np.testing.assert_allclose(one, result[7], rtol=1e-12)


def test_bounds_by_hand() -> None:
    """A step of (0.3, 0.4) m is 0.5 m long, five times too long; 0.15 m/s is the most."""
    point = Policy(a_bundle(2, 2, bounding="norm"))
    wheels = Policy(a_bundle())

    np.testing.assert_allclose(point.to_physical([3.0, 4.0]), [0.06, 0.08], atol=1e-15)
    np.testing.assert_allclose(point.to_physical([0.3, 0.4]), [0.03, 0.04], atol=1e-15)
    np.testing.assert_allclose(point.to_physical([0.0, 0.0]), [0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(wheels.to_physical([0.0, 0.5]), [0.075, 0.75], atol=1e-15)
    np.testing.assert_allclose(wheels.to_physical([-9.0, 9.0]), [0.0, 1.5], atol=1e-15)


def test_an_environment_that_bounds_otherwise_is_refused() -> None:
    class Stretched(Point2D):
        def to_physical(self, action: jax.Array) -> jax.Array:
            return 0.2 * jnp.tanh(action)

    with pytest.raises(BridgeError, match="another way than box or norm"):
        described(Stretched())


@pytest.mark.parametrize("name", envs_jax.names())
def test_environments_and_tasks_survive_a_bundle(name: str) -> None:
    env = envs_jax.make(name, horizon=37, reward="dense")
    tasks = env.test_tasks()
    for index in (0, -1):
        task = jax.tree.map(lambda x, i=index: x[i], tasks)
        bundle = replace(
            a_bundle(), environment=described(env)[0], task=described_task(task), zone=None
        )

        assert environment_of(bundle) == env
        again = task_of(bundle, env)
        assert type(again) is type(task)
        jax.tree.map(np.testing.assert_array_equal, again, task)


def test_numbers_of_tasks_are_short() -> None:
    tasks = envs_jax.make("two_wheeled_drift").test_tasks()

    last = jax.tree.map(lambda x: x[-1], tasks)
    assert described_task(last) == {"residual_angular_velocity": -0.65}


def test_other_environments_and_tasks_are_refused() -> None:
    env = envs_jax.make("point2d")
    with pytest.raises(BridgeError, match="'acrobot' is unknown"):
        environment_of(replace(a_bundle(), environment=Environment("acrobot", {})))
    with pytest.raises(BridgeError, match="none of point2d"):
        task_of(a_bundle(), env)


@pytest.mark.parametrize(
    ("name", "task", "expected"),
    [
        ("point2d", 0, ([2.0, 0.0], "sparse", 0.2, "disc", 0.02, None, 100)),
        ("two_wheeled", 0, ([2.0, 0.0], "sparse", 0.5, "square", 0.2, 2.5, 100)),
        ("two_wheeled_drift", 5, ([2.0, 1.0], "sparse", 0.5, "square", 0.1, 2.5, 100)),
    ],
)
def test_where_a_task_pays(name: str, task: int, expected: tuple) -> None:
    env = envs_jax.make(name)

    assert zone(env, jax.tree.map(lambda x: x[task], env.train_tasks())) == expected


def test_what_is_not_in_the_plane_has_no_zone() -> None:
    env = envs_jax.make("half_cheetah")

    assert zone(env, jax.tree.map(lambda x: x[0], env.train_tasks())) is None


@pytest.mark.parametrize("learn_std", [False, True])
def test_parameters_survive_a_bundle(learn_std: bool) -> None:
    policy = gaussian_policy(3, 2, hidden_sizes=(8,), std=0.3, learn_std=learn_std)
    params = policy.init(jax.random.key(0))
    log_std = policy.apply(params, jnp.zeros(3)).log_std
    bundle = a_bundle()
    tensors = {**bundle.tensors, **tensors_of(params, log_std, "meta")}
    bundle = replace(bundle, tensors=tensors, settings={"policy": {"learn_std": learn_std}})

    again = params_of(bundle, "meta")

    assert tensors.keys() == a_bundle().tensors.keys()
    assert ("log_std" in again) == learn_std
    jax.tree.map(np.testing.assert_array_equal, again, params)
    np.testing.assert_allclose(np.exp(tensors["meta/log_std"]), 0.3, rtol=1e-6)


def test_importing_it_brings_no_jax() -> None:
    code = "import sys, bridges.policy; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    )

    loaded = set(done.stdout.split())
    assert {"numpy", "bridges"} <= loaded
    heavy = {"jax", "jaxlib", "flax", "brax", "mujoco", "optax", "emrld_jax", "envs_jax", "hydra"}
    assert not loaded & heavy
