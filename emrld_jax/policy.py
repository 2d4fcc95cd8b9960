"""The Gaussian policy: an MLP gives the mean, the standard deviation is fixed or learned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from flax import linen as nn

from emrld_jax.precision import of_products
from emrld_jax.types import Gaussian, Params

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": jnp.tanh,
    "relu": nn.relu,
    "silu": nn.silu,
    "elu": nn.elu,
    "gelu": nn.gelu,
}


class MLP(nn.Module):
    """Dense layers with Xavier-uniform weights and zero biases; the last one is linear.

    [.., O] -> [.., sizes[-1]]. `output_scale` multiplies the last layer's initial weights. With
    `start_at_zero`, the initial output is 0 for every x, but its gradient is not: the last hidden
    units come in equal pairs, which the last layer subtracts from each other.
    """

    sizes: Sequence[int]
    activation: str
    output_scale: float = 1.0
    start_at_zero: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        last = len(self.sizes) - 1
        for i, size in enumerate(self.sizes):
            # variance scaling, fan average, uniform is Xavier's rule; the scale is of the variance
            scale = self.output_scale**2 if i == last else 1.0
            weights = nn.initializers.variance_scaling(scale, "fan_avg", "uniform")
            if self.start_at_zero and i == last - 1:
                weights = mirrored(weights, axis=1, sign=1.0)
            elif self.start_at_zero and i == last:
                weights = mirrored(weights, axis=0, sign=-1.0)
            layer = nn.Dense(size, precision=of_products(), kernel_init=weights, name=f"layer_{i}")
            x = layer(x)
            if i < last:
                x = ACTIVATIONS[self.activation](x)
        return x


def mirrored(
    initializer: nn.initializers.Initializer, axis: int, sign: float
) -> nn.initializers.Initializer:
    """An initializer whose second half along the axis repeats the first, times a sign of 1 or -1.

    What is in the middle of an odd number stays, or for a sign of -1 is 0.
    """

    def initialize(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> jax.Array:
        kernel = initializer(key, shape, dtype)
        half = shape[axis] // 2
        first = jax.lax.slice_in_dim(kernel, 0, half, axis=axis)
        middle = jax.lax.slice_in_dim(kernel, half, shape[axis] - half, axis=axis)
        return jnp.concatenate([first, 0.5 * (1 + sign) * middle, sign * first], axis)

    return initialize


class Policy(NamedTuple):
    """A Gaussian policy as pure functions."""

    init: Callable[[jax.Array], Params]  # (key)
    apply: Callable[[Params, jax.Array], Gaussian]  # (params, obs [.., O])


def gaussian_policy(
    observation_size: int,
    action_size: int,
    *,
    hidden_sizes: Sequence[int] = (100, 100),
    activation: str = "tanh",
    std: float = 0.5,
    output_scale: float = 1.0,
    start_at_zero: bool = False,
    squash: bool = False,
    learn_std: bool = False,
) -> Policy:
    """A Gaussian policy whose mean is an MLP of the observation (supplement, section C).

    Args:
        std: standard deviation of every action dimension, in policy units.
        output_scale: factor on the last layer's initial weights.
        start_at_zero: make the initial mean 0 at every observation; needs a hidden layer.
        squash: the network sees arcsinh of the observation, which leaves small numbers as they are
            and keeps large ones, such as joints' velocities, from saturating its units.
        learn_std: make the logarithm of the standard deviation a parameter, starting from `std`;
            otherwise it is constant, as in the paper.

    Raises:
        ValueError: start_at_zero without a hidden layer.
    """
    if start_at_zero and not hidden_sizes:
        raise ValueError("start_at_zero needs a hidden layer, but hidden_sizes is empty")
    network = MLP((*hidden_sizes, action_size), activation, output_scale, start_at_zero)
    # with a dtype: weakly typed parameters would compile everything twice
    initial = jnp.full(action_size, jnp.log(std), dtype=float)

    def init(key: jax.Array) -> Params:
        params: dict[str, Any] = dict(network.init(key, jnp.zeros(observation_size)))
        return {**params, "log_std": initial} if learn_std else params

    def apply(params: Params, obs: jax.Array) -> Gaussian:
        inputs = jnp.arcsinh(obs) if squash else obs
        mean = cast(jax.Array, network.apply({"params": params["params"]}, inputs))
        log_std = params["log_std"] if learn_std else initial
        return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))

    return Policy(init, apply)


def mean_action(policy: Policy) -> Policy:
    """The same policy without its noise."""

    def apply(params: Params, obs: jax.Array) -> Gaussian:
        mean = policy.apply(params, obs).mean
        return Gaussian(mean, jnp.full_like(mean, -jnp.inf))

    return Policy(policy.init, apply)


def sample(gaussian: Gaussian, noise: jax.Array) -> jax.Array:
    """The action that standard normal `noise` [.., A] makes."""
    return gaussian.mean + jnp.exp(gaussian.log_std) * noise


def log_prob(gaussian: Gaussian, action: jax.Array) -> jax.Array:
    """Log-density of `action` [.., A], as the mean over action dimensions: [..].

    The mean (rather than the sum) is what the paper's learning rates were chosen for.
    """
    z = (action - gaussian.mean) * jnp.exp(-gaussian.log_std)
    density = -0.5 * z**2 - gaussian.log_std - 0.5 * jnp.log(2 * jnp.pi)
    return jnp.mean(density, axis=-1)


def sample_log_prob(gaussian: Gaussian, noise: jax.Array) -> jax.Array:
    """`log_prob` of the action that `sample` makes of this noise, [.., A] -> [..]."""
    density = -0.5 * noise**2 - gaussian.log_std - 0.5 * jnp.log(2 * jnp.pi)
    return jnp.mean(density, axis=-1)


def kl_divergence(new: Gaussian, old: Gaussian) -> jax.Array:
    """KL(new || old), as the mean over action dimensions: [..]."""
    log_ratio = old.log_std - new.log_std
    shift = (new.mean - old.mean) * jnp.exp(-old.log_std)
    per_dimension = log_ratio + 0.5 * (jnp.exp(-2 * log_ratio) + shift**2 - 1.0)
    return jnp.mean(per_dimension, axis=-1)


def total_variation(p: Gaussian, q: Gaussian) -> jax.Array:
    """D_TV(p, q) of the whole action, 0 to 1: [..]. An upper bound where deviations differ.

    With one standard deviation each it is that of two normal distributions on the line through the
    means, at their distance in standard deviations: erf(distance / (2 sqrt 2)). Deviations that
    differ add what Pinsker's inequality allows, sqrt(KL / 2), after the means have moved.
    """
    distance = jnp.linalg.norm((q.mean - p.mean) * jnp.exp(-p.log_std), axis=-1)
    change = p.log_std - q.log_std
    kl = jnp.sum(0.5 * jnp.expm1(2 * change) - change, axis=-1)
    moved = jax.scipy.special.erf(distance / (2 * 2**0.5))
    return jnp.minimum(moved + jnp.sqrt(jnp.maximum(kl, 0.0) / 2), 1.0)
