"""Returns, the baseline and advantages against worked numbers and plain NumPy loops."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax.sampling.advantages import (
    RIDGE,
    advantages,
    baseline_features,
    discounted_sum,
    fit_baseline,
    gae,
    normalize,
)
from emrld_jax.types import Trajectory

LENGTHS = (7, 3, 1, 5)
HORIZON = 7


def episodes(seed: int = 0, horizon: int = HORIZON) -> Trajectory:
    """Random episodes of LENGTHS; what comes after their ends is not zero."""
    rng = np.random.default_rng(seed)
    mask = (np.arange(horizon) < np.array(LENGTHS)[:, None]).astype(float)
    return Trajectory(
        obs=jnp.asarray(rng.normal(size=(len(LENGTHS), horizon, 2))),
        action=jnp.asarray(rng.normal(size=(len(LENGTHS), horizon, 2))),
        reward=jnp.asarray(rng.normal(size=mask.shape)),
        done=jnp.zeros(mask.shape),
        success=jnp.zeros(mask.shape),
        diverged=jnp.zeros(mask.shape),
        mask=jnp.asarray(mask),
        log_prob=jnp.zeros(mask.shape),
    )


def ridge_solution(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    x, y = x.astype(np.float64), y.astype(np.float64)
    return np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ y)


def looped_advantages(trajectory: Trajectory, discount: float, gae_lambda: float) -> np.ndarray:
    """What `advantages` says it computes, episode by episode and step by step."""
    obs, reward = np.asarray(trajectory.obs, float), np.asarray(trajectory.reward, float)
    features, returns, raw = [], [], []
    for e, length in enumerate(LENGTHS):
        for t in range(length):
            s, time = obs[e, t], 0.01 * t
            features.append([*s, *(s * s), time, time**2, time**3, 1.0])
            returns.append(sum(discount ** (k - t) * reward[e, k] for k in range(t, length)))
    values = iter(np.array(features) @ ridge_solution(np.array(features), np.array(returns)))
    for e, length in enumerate(LENGTHS):
        value = [*(next(values) for _ in range(length)), 0.0]
        delta = [reward[e, t] + discount * value[t + 1] - value[t] for t in range(length)]
        for t in range(length):
            raw.append(sum((discount * gae_lambda) ** (k - t) * delta[k] for k in range(t, length)))
    normalized = iter((np.array(raw) - np.mean(raw)) / np.std(raw))
    result = np.zeros(reward.shape)
    for e, length in enumerate(LENGTHS):
        result[e, :length] = [next(normalized) for _ in range(length)]
    return result


def test_discounted_sum_of_worked_numbers() -> None:
    total = discounted_sum(jnp.array([1.0, 2.0, 4.0]), 0.5)
    np.testing.assert_allclose(total, [3.0, 4.0, 4.0])


def test_discount_1_and_0_are_the_plain_sum_and_the_terms() -> None:
    x = jnp.array([1.0, -2.0, 4.0])
    np.testing.assert_allclose(discounted_sum(x, 1.0), [3.0, 2.0, 4.0])
    np.testing.assert_allclose(discounted_sum(x, 0.0), x)


def test_gae_of_worked_numbers() -> None:
    reward, value = jnp.array([1.0, 2.0]), jnp.array([0.5, 1.0])
    # delta_1 = 2 - 1 = 1; delta_0 = 1 + 0.5 * 1 - 0.5 = 1; A_0 = 1 + 0.25 * 1
    np.testing.assert_allclose(gae(reward, value, 0.5, 0.5), [1.25, 1.0])


def test_gae_with_lambda_1_is_the_return_minus_the_value() -> None:
    rng = np.random.default_rng(1)
    reward, value = (jnp.asarray(rng.normal(size=9), jnp.float32) for _ in range(2))
    returns = discounted_sum(reward, 0.9)
    np.testing.assert_allclose(gae(reward, value, 0.9, 1.0), returns - value, atol=1e-5)


def test_gae_with_lambda_0_is_the_one_step_error() -> None:
    reward, value = jnp.array([1.0, 0.0, 2.0]), jnp.array([3.0, 1.0, 4.0])
    result = gae(reward, value, 0.5, 0.0)
    np.testing.assert_allclose(result, [1 + 0.5 - 3, 0 + 2 - 1, 2 - 4])


def test_features_of_worked_numbers() -> None:
    features = baseline_features(jnp.array([[2.0, -3.0], [0.5, 1.0], [0.0, 4.0]]))
    expected = [
        [2.0, -3.0, 4.0, 9.0, 0.0, 0.0, 0.0, 1.0],
        [0.5, 1.0, 0.25, 1.0, 0.01, 1e-4, 1e-6, 1.0],
        [0.0, 4.0, 0.0, 16.0, 0.02, 4e-4, 8e-6, 1.0],
    ]
    np.testing.assert_allclose(features, expected, rtol=1e-6)


def test_baseline_is_the_ridge_solution_of_the_rows_in_the_mask() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(30, 5)), rng.normal(size=30)
    mask = rng.random(30) < 0.6
    with jax.enable_x64(True):
        fitted = fit_baseline(jnp.asarray(x), jnp.asarray(y), jnp.asarray(mask, float))
    np.testing.assert_allclose(fitted, ridge_solution(x[mask], y[mask]), rtol=1e-9)


def test_baseline_holds_in_float32_on_nearly_dependent_features() -> None:
    """Time features are nearly dependent: normal equations in float32 would lose the answer."""
    rng = np.random.default_rng(3)
    walk = np.cumsum(0.1 * rng.normal(size=(6, 100, 2)), axis=1).astype(np.float32)
    features = np.concatenate([np.asarray(baseline_features(jnp.asarray(w))) for w in walk])
    targets = rng.normal(size=len(features)).astype(np.float32)
    fitted = fit_baseline(jnp.asarray(features), jnp.asarray(targets), jnp.ones(len(targets)))
    assert fitted.dtype == jnp.float32
    predicted = features.astype(float) @ np.asarray(fitted, float)
    expected = features.astype(float) @ ridge_solution(features, targets)
    np.testing.assert_allclose(predicted, expected, atol=1e-4)


def test_ridge_settles_features_that_are_not_independent() -> None:
    x = np.ones((4, 2))
    with jax.enable_x64(True):
        fitted = fit_baseline(jnp.asarray(x), 2 * jnp.ones(4), jnp.ones(4))
    np.testing.assert_allclose(fitted, [8 / (8 + RIDGE)] * 2, rtol=1e-9)


def test_normalize_worked_numbers() -> None:
    result = normalize(jnp.array([1.0, 3.0, 100.0]), jnp.array([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(result, [-1.0, 1.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize("mask", [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
def test_normalize_gives_zeros_where_nothing_differs(mask: list[float]) -> None:
    result = normalize(jnp.full(3, 2.0), jnp.array(mask))
    np.testing.assert_array_equal(result, np.zeros(3))


@pytest.mark.parametrize(("discount", "gae_lambda"), [(0.95, 1.0), (0.9, 0.5), (1.0, 0.0)])
def test_advantages_equal_a_loop_over_episodes_and_steps(
    discount: float, gae_lambda: float
) -> None:
    with jax.enable_x64(True):
        trajectory = episodes()
        result = advantages(trajectory, discount, gae_lambda)
    expected = looped_advantages(trajectory, discount, gae_lambda)
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_advantages_in_float32_are_near_those_in_float64() -> None:
    trajectory = episodes()
    assert trajectory.obs.dtype == jnp.float32
    expected = looped_advantages(trajectory, 0.95, 1.0)
    np.testing.assert_allclose(advantages(trajectory, 0.95, 1.0), expected, atol=1e-3)


def test_what_comes_after_an_end_changes_nothing() -> None:
    trajectory = episodes()
    other = episodes(seed=9)

    def keep(a: jax.Array, b: jax.Array) -> jax.Array:
        mask = trajectory.mask.reshape(trajectory.mask.shape + (1,) * (a.ndim - 2))
        return jnp.where(mask > 0, a, 50 * b)

    changed = jax.tree.map(keep, trajectory, other)._replace(mask=trajectory.mask)
    np.testing.assert_array_equal(advantages(changed, 0.95, 1.0), advantages(trajectory, 0.95, 1.0))


def test_a_longer_padding_changes_nothing() -> None:
    trajectory = episodes()
    longer = jax.tree.map(
        lambda x: jnp.pad(x, [(0, 0), (0, 4), *[(0, 0)] * (x.ndim - 2)]), trajectory
    )
    padded = advantages(longer, 0.95, 1.0)
    np.testing.assert_allclose(padded[:, :HORIZON], advantages(trajectory, 0.95, 1.0), atol=1e-4)
    np.testing.assert_array_equal(padded[:, HORIZON:], np.zeros((len(LENGTHS), 4)))
