"""The Gaussian policy against formulas in NumPy and numerical integration."""

from __future__ import annotations

from collections.abc import Callable
from math import erf
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax.policy import (
    ACTIVATIONS,
    gaussian_policy,
    kl_divergence,
    log_prob,
    mean_action,
    sample,
    sample_log_prob,
)
from emrld_jax.types import Gaussian, Params

IN_NUMPY: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "silu": lambda x: x / (1 + np.exp(-x)),
    "elu": lambda x: np.where(x > 0, x, np.exp(np.minimum(x, 0.0)) - 1),
    "gelu": lambda x: x * 0.5 * (1 + np.vectorize(erf)(x / np.sqrt(2))),
}
GRID = np.linspace(-30.0, 30.0, 200_001)


def random_gaussian(seed: int, shape: tuple[int, ...]) -> Gaussian:
    rng = np.random.default_rng(seed)
    mean, log_std = rng.normal(size=shape), 0.5 * rng.normal(size=shape)
    return Gaussian(jnp.asarray(mean), jnp.asarray(log_std))


def density(x: np.ndarray, mean: Any, std: Any) -> np.ndarray:
    return np.exp(-0.5 * ((x - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi))


def test_log_prob_is_the_mean_over_dimensions_of_the_log_density() -> None:
    gaussian, action = random_gaussian(0, (4, 3)), random_gaussian(1, (4, 3)).mean
    mean, std = np.asarray(gaussian.mean, float), np.exp(np.asarray(gaussian.log_std, float))
    z = (np.asarray(action, float) - mean) / std
    expected = np.mean(-0.5 * z**2 - np.log(std) - 0.5 * np.log(2 * np.pi), axis=-1)
    result = log_prob(gaussian, action)
    assert result.shape == (4,)
    np.testing.assert_allclose(result, expected, rtol=1e-5)


def test_log_prob_of_a_sample_is_that_of_its_action() -> None:
    gaussian, noise = random_gaussian(0, (5, 3)), np.random.default_rng(2).normal(size=(5, 3))
    mean, std = np.asarray(gaussian.mean), np.exp(np.asarray(gaussian.log_std))
    expected = np.log(density(mean + std * noise, mean, std)).mean(axis=-1)
    np.testing.assert_allclose(sample_log_prob(gaussian, jnp.asarray(noise)), expected, rtol=1e-5)


def test_log_prob_of_worked_numbers() -> None:
    """One standard deviation off in one dimension, at the mean in the other, both of std 2."""
    gaussian = Gaussian(jnp.array([1.0, 5.0]), jnp.log(jnp.array([2.0, 2.0])))
    expected = -0.25 - np.log(2) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(log_prob(gaussian, jnp.array([3.0, 5.0])), expected, rtol=1e-6)


def test_density_integrates_to_one() -> None:
    gaussian = Gaussian(jnp.array([0.3]), jnp.array([-0.4]))
    values = jax.vmap(lambda x: log_prob(gaussian, x))(jnp.asarray(GRID[:, None], jnp.float32))
    total = np.trapezoid(np.exp(np.asarray(values, float)), GRID)
    np.testing.assert_allclose(total, 1.0, rtol=1e-4)


def test_kl_is_the_integral_in_each_dimension_averaged() -> None:
    new, old = random_gaussian(2, (3, 2)), random_gaussian(3, (3, 2))
    expected = np.zeros((3, 2))
    for i in np.ndindex(3, 2):
        (p, q) = (density(GRID, float(g.mean[i]), float(jnp.exp(g.log_std[i]))) for g in (new, old))
        inside = p > 1e-200
        expected[i] = np.trapezoid(
            np.where(inside, p * np.log(np.where(inside, p / np.maximum(q, 1e-300), 1.0)), 0.0),
            GRID,
        )
    np.testing.assert_allclose(kl_divergence(new, old), expected.mean(axis=-1), rtol=1e-4)


def test_kl_is_zero_to_itself_and_has_a_direction() -> None:
    new, old = random_gaussian(4, (5, 2)), random_gaussian(5, (5, 2))
    np.testing.assert_allclose(kl_divergence(new, new), np.zeros(5), atol=1e-7)
    assert not np.allclose(kl_divergence(new, old), kl_divergence(old, new))
    # a narrow one against a broad one: log(2) + (1/4 - 1)/2
    narrow, broad = (Gaussian(jnp.zeros(1), jnp.log(jnp.array([s]))) for s in (1.0, 2.0))
    np.testing.assert_allclose(kl_divergence(narrow, broad), np.log(2) - 0.375, rtol=1e-5)


def test_a_sample_is_the_mean_plus_noise_times_the_standard_deviation() -> None:
    gaussian = Gaussian(jnp.array([1.0, -1.0]), jnp.log(jnp.array([0.5, 2.0])))
    result = sample(gaussian, jnp.array([2.0, -1.0]))
    np.testing.assert_allclose(result, [2.0, -3.0], rtol=1e-6)


def test_the_mean_action_has_no_noise() -> None:
    policy = gaussian_policy(3, 2, hidden_sizes=(4,))
    params, obs = policy.init(jax.random.key(0)), jnp.ones((5, 3))
    quiet = mean_action(policy).apply(params, obs)
    np.testing.assert_array_equal(sample(quiet, jnp.full((5, 2), 3.0)), quiet.mean)
    np.testing.assert_array_equal(quiet.mean, policy.apply(params, obs).mean)


def test_weights_are_xavier_uniform_and_biases_zero() -> None:
    params = gaussian_policy(3, 2, hidden_sizes=(100, 80)).init(jax.random.key(0))["params"]
    sizes = [(3, 100), (100, 80), (80, 2)]
    assert len(params) == len(sizes)
    for i, (inputs, outputs) in enumerate(sizes):
        kernel, bias = np.asarray(params[f"layer_{i}"]["kernel"]), params[f"layer_{i}"]["bias"]
        assert kernel.shape == (inputs, outputs)
        bound = np.sqrt(6 / (inputs + outputs))
        assert 0.95 * bound < np.abs(kernel).max() <= bound
        # a uniform distribution's standard deviation
        np.testing.assert_allclose(kernel.std(), bound / np.sqrt(3), rtol=0.15)
        np.testing.assert_array_equal(bias, np.zeros(outputs))


def test_the_output_scale_is_a_factor_on_the_last_layers_weights_alone() -> None:
    plain, small = (
        gaussian_policy(3, 2, hidden_sizes=(8, 6), output_scale=scale).init(jax.random.key(0))
        for scale in (1.0, 0.01)
    )
    for i, factor in enumerate((1.0, 1.0, 0.01)):
        layer, scaled = (params["params"][f"layer_{i}"]["kernel"] for params in (plain, small))
        np.testing.assert_allclose(scaled, factor * layer, rtol=1e-5)


@pytest.mark.parametrize("hidden_sizes", [(8, 6), (8, 5), (7,), (1,)])
def test_a_policy_can_start_at_zero_and_leave_it(hidden_sizes: tuple[int, ...]) -> None:
    """The mean is 0 at every observation, the weights are as large as ever, and a step moves it."""
    plain, paired = (
        gaussian_policy(3, 2, hidden_sizes=hidden_sizes, start_at_zero=zero)
        for zero in (False, True)
    )
    params, before = paired.init(jax.random.key(0)), plain.init(jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (5, 3))
    np.testing.assert_allclose(paired.apply(params, obs).mean, jnp.zeros((5, 2)), atol=1e-7)
    last = len(hidden_sizes)
    kernels = [np.asarray(params["params"][f"layer_{i}"]["kernel"]) for i in range(last + 1)]
    half = hidden_sizes[-1] // 2
    first = np.asarray(before["params"][f"layer_{last}"]["kernel"])[:half]
    np.testing.assert_array_equal(kernels[-1][:half], first)
    np.testing.assert_array_equal(kernels[-1][hidden_sizes[-1] - half :], -first)
    units = np.asarray(before["params"][f"layer_{last - 1}"]["kernel"])[
        :, : hidden_sizes[-1] - half
    ]
    np.testing.assert_array_equal(kernels[-2][:, : hidden_sizes[-1] - half], units)
    np.testing.assert_array_equal(kernels[-2][:, hidden_sizes[-1] - half :], units[:, :half])

    def squared_error(params: Params) -> jax.Array:
        return jnp.sum((paired.apply(params, obs).mean - 1.0) ** 2)

    # of the sum of squares from 1 at a mean of 0: -2 times the last hidden units, summed
    gradient = jax.grad(squared_error)(params)["params"][f"layer_{last}"]["kernel"]
    hidden = np.asarray(obs)
    for kernel in kernels[:-1]:
        hidden = np.tanh(hidden @ kernel)
    expected = np.repeat(-2 * hidden.sum(axis=0)[:, None], 2, axis=1)
    assert np.abs(expected).min() > 0.01
    np.testing.assert_allclose(gradient, expected, rtol=1e-4)


def test_starting_at_zero_needs_a_hidden_layer() -> None:
    with pytest.raises(ValueError, match="hidden_sizes"):
        gaussian_policy(3, 2, hidden_sizes=(), start_at_zero=True)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_mean_is_the_networks_formula(activation: str) -> None:
    policy = gaussian_policy(3, 2, hidden_sizes=(8, 6), activation=activation)
    params = policy.init(jax.random.key(1))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: x + 0.3 * rng.normal(size=x.shape).astype(np.float32), params)
    obs = rng.normal(size=(5, 3)).astype(np.float32)
    x = obs.astype(float)
    for i in range(3):
        layer = {k: np.asarray(v, float) for k, v in params["params"][f"layer_{i}"].items()}
        x = x @ layer["kernel"] + layer["bias"]
        x = IN_NUMPY[activation](x) if i < 2 else x
    tolerance = 2e-3 if activation == "gelu" else 1e-5  # flax's gelu is an approximation
    np.testing.assert_allclose(policy.apply(params, jnp.asarray(obs)).mean, x, atol=tolerance)


def test_squashed_observations_are_their_arcsinh() -> None:
    plain, squashed = (gaussian_policy(3, 2, hidden_sizes=(4,), squash=s) for s in (False, True))
    params = plain.init(jax.random.key(0))
    obs = jnp.array([0.01, -20.0, 3.0])
    same = np.log(np.asarray(obs) + np.sqrt(np.asarray(obs) ** 2 + 1))
    expected = plain.apply(params, jnp.asarray(same)).mean
    np.testing.assert_allclose(squashed.apply(params, obs).mean, expected, rtol=1e-5, atol=1e-6)


def test_a_fixed_standard_deviation_is_no_parameter() -> None:
    policy = gaussian_policy(2, 3, hidden_sizes=(4,), std=0.25)
    params = policy.init(jax.random.key(0))
    assert set(params) == {"params"}
    log_std = policy.apply(params, jnp.zeros((5, 2))).log_std
    np.testing.assert_allclose(log_std, np.full((5, 3), np.log(0.25)), rtol=1e-6)


def test_a_learned_standard_deviation_is_a_parameter() -> None:
    policy = gaussian_policy(2, 3, hidden_sizes=(4,), std=0.25, learn_std=True)
    params = policy.init(jax.random.key(0))
    np.testing.assert_allclose(params["log_std"], np.full(3, np.log(0.25)), rtol=1e-6)
    changed = {**params, "log_std": jnp.array([0.0, 1.0, 2.0])}
    log_std = policy.apply(changed, jnp.zeros((5, 2))).log_std
    np.testing.assert_array_equal(log_std, np.tile([0.0, 1.0, 2.0], (5, 1)))


def test_both_kinds_have_the_same_network() -> None:
    fixed, learned = (gaussian_policy(2, 1, learn_std=learn) for learn in (False, True))
    key = jax.random.key(3)
    jax.tree.map(
        np.testing.assert_array_equal, fixed.init(key)["params"], learned.init(key)["params"]
    )
