"""Returns, the linear baseline and generalized advantages, of one episode or one task."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from emrld_jax.precision import dot
from emrld_jax.types import Trajectory

RIDGE = 1e-5


def discounted_sum(x: jax.Array, discount: float) -> jax.Array:
    """y_t = x_t + discount * y_{t+1} over one sequence, y beyond its end 0. [T] -> [T]."""

    def step(following: jax.Array, now: jax.Array) -> tuple[jax.Array, jax.Array]:
        total = now + discount * following
        return total, total

    return jax.lax.scan(step, jnp.zeros((), x.dtype), x, reverse=True)[1]


def baseline_features(obs: jax.Array) -> jax.Array:
    """Features (s, s*s, 0.01t, (0.01t)^2, (0.01t)^3, 1) of one episode (section C).

    t counts the steps of the episode from 0. [T, O] -> [T, 2O + 4].
    """
    t = 0.01 * jnp.arange(obs.shape[0], dtype=obs.dtype)[:, None]
    return jnp.concatenate([obs, obs**2, t, t**2, t**3, jnp.ones_like(t)], axis=1)


def fit_baseline(features: jax.Array, targets: jax.Array, mask: jax.Array) -> jax.Array:
    """Weights w of least |X w - y|^2 + ridge |w|^2 over the rows with mask 1.

    The ridge enters as extra rows of a QR least-squares problem: the condition number is then the
    square root of the normal equations', which float32 can carry.

    Args:
        features: X, [S, F].
        targets: y, [S].
        mask: [S], 1 or 0.

    Returns:
        w, [F].
    """
    size = features.shape[1]
    ridge_rows = jnp.sqrt(RIDGE) * jnp.eye(size, dtype=features.dtype)
    q, r = jnp.linalg.qr(jnp.concatenate([features * mask[:, None], ridge_rows]))
    y = jnp.concatenate([targets * mask, jnp.zeros(size, targets.dtype)])
    return solve_triangular(r, dot(q.T, y))


def gae(reward: jax.Array, value: jax.Array, discount: float, gae_lambda: float) -> jax.Array:
    """Generalized advantages of one episode (Schulman et al. 2016, equation 16). [T], [T] -> [T].

    A_t = sum_k (discount * gae_lambda)^k delta_{t+k}, delta_t = r_t + discount V_{t+1} - V_t, where
    V beyond the last step is 0. Steps after an early end must have reward and value 0.
    """
    following = jnp.append(value[1:], jnp.zeros((), value.dtype))
    delta = reward + discount * following - value
    return discounted_sum(delta, discount * gae_lambda)


def normalize(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean 0, standard deviation 1 over entries with mask 1; 0 elsewhere, and if all are equal."""
    count = jnp.maximum(jnp.sum(mask), 1.0)
    centered = (x - jnp.sum(x * mask) / count) * mask
    return centered / (jnp.sqrt(jnp.sum(centered**2) / count) + 1e-8)


def baseline_weights(trajectory: Trajectory, discount: float) -> jax.Array:
    """The baseline fitted to the discounted returns of one task's episodes. [E, T, ..] -> [F]."""
    features = jax.vmap(baseline_features)(trajectory.obs)
    returns = jax.vmap(lambda r: discounted_sum(r, discount))(trajectory.reward * trajectory.mask)
    rows = features.reshape(-1, features.shape[-1])
    return fit_baseline(rows, returns.reshape(-1), trajectory.mask.reshape(-1))


def reward_advantages(
    trajectory: Trajectory, weights: jax.Array, discount: float, gae_lambda: float
) -> jax.Array:
    """Advantages of one task's episodes against a baseline, in units of the reward. [E, T].

    The horizon ends an episode like any other end: nothing is expected after it, which the baseline
    knows from its time features.
    """
    value = dot(jax.vmap(baseline_features)(trajectory.obs), weights) * trajectory.mask
    reward = trajectory.reward * trajectory.mask
    return jax.vmap(lambda r, v: gae(r, v, discount, gae_lambda))(reward, value)


def advantages(trajectory: Trajectory, discount: float, gae_lambda: float) -> jax.Array:
    """Normalized advantages of one task's episodes against the baseline fitted to them. [E, T]."""
    weights = baseline_weights(trajectory, discount)
    return normalize(reward_advantages(trajectory, weights, discount, gae_lambda), trajectory.mask)
