"""TRPO on a quadratic, where the answer is known, and on a small real problem."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from emrld_jax.meta.adaptation import readapt
from emrld_jax.meta.outer import Objective
from emrld_jax.meta.trpo import conjugate_gradient, fisher_product, line_search, trpo
from tests.meta.problems import TASKS, adapted_objective, enhanced_steps, small_policy

START = np.array([0.5, -1.0, 2.0, 0.3])
SLOPE = np.array([1.0, 0.5, -2.0, 0.7])
MAX_KL = 0.02


def positive_definite(seed: int, size: int) -> np.ndarray:
    square = np.random.default_rng(seed).normal(size=(size, size))
    return square @ square.T + np.eye(size)


MATRIX = positive_definite(0, 4)


def as_params(x: np.ndarray) -> dict[str, jax.Array]:
    return {"a": jnp.asarray(x[:1]), "b": jnp.asarray(x[1:].reshape(-1, 1))}


def as_vector(params: Any) -> np.ndarray:
    return np.asarray(ravel_pytree(params)[0])


def quadratic(bend: float = 0.0, matrix: np.ndarray = MATRIX) -> Objective:
    """Loss slope'd + bend |d|^2 / 2 and divergence d'Hd / 2, of d = new - old."""

    def difference(new: Any, old: Any) -> jax.Array:
        return ravel_pytree(new)[0] - ravel_pytree(old)[0]

    def loss(new: Any, old: Any) -> jax.Array:
        d = difference(new, old)
        return jnp.asarray(SLOPE) @ d + 0.5 * bend * (d @ d)

    def divergence(new: Any, old: Any) -> jax.Array:
        d = difference(new, old)
        return 0.5 * d @ (jnp.asarray(matrix) @ d)

    return Objective(lambda params: params, loss, divergence)


def full_step(matrix: np.ndarray) -> np.ndarray:
    """-sqrt(2 max_kl / g'H^-1 g) H^-1 g."""
    direction = np.linalg.solve(matrix, SLOPE)
    return -np.sqrt(2 * MAX_KL / (SLOPE @ direction)) * direction


def update(
    objective: Objective, curvature: Objective | None = None, **settings: Any
) -> tuple[np.ndarray, dict[str, float]]:
    with jax.enable_x64(True):
        optimizer = trpo(max_kl=MAX_KL, **settings)
        step = jax.jit(lambda p: optimizer.update(objective, curvature or objective, p, ()))
        params, _, metrics = step(as_params(START))
        return as_vector(params), {name: float(value) for name, value in metrics.items()}


def test_the_step_on_a_quadratic_is_the_known_one() -> None:
    """Damping keeps the divergence of the full step strictly below max_kl."""
    result, metrics = update(quadratic(), damping=0.1)
    step = full_step(MATRIX + 0.1 * np.eye(4))
    np.testing.assert_allclose(result, START + step, rtol=1e-5)
    np.testing.assert_allclose(metrics["outer/kl"], 0.5 * step @ MATRIX @ step, rtol=1e-5)
    np.testing.assert_allclose(metrics["outer/improvement"], -SLOPE @ step, rtol=1e-5)
    np.testing.assert_allclose(metrics["outer/gradient_norm"], np.linalg.norm(SLOPE), rtol=1e-9)
    assert metrics["outer/line_search_tries"] == 1
    assert metrics["outer/accepted"] == 1


def test_without_damping_the_step_is_the_same_or_backtracked_once() -> None:
    """Then the full step's divergence is max_kl itself, up to rounding."""
    result, metrics = update(quadratic(), damping=0.0, backtrack_ratio=0.5)
    tries = metrics["outer/line_search_tries"]
    assert tries in (1, 2)
    np.testing.assert_allclose(result, START + 0.5 ** (tries - 1) * full_step(MATRIX), rtol=1e-5)


@pytest.mark.parametrize("bend", [3.0, 40.0, 1000.0])
@pytest.mark.parametrize("ratio", [0.5, 0.7])
def test_backtracks_until_the_loss_falls(bend: float, ratio: float) -> None:
    result, metrics = update(quadratic(bend), damping=0.1, backtrack_ratio=ratio)
    step = full_step(MATRIX + 0.1 * np.eye(4))
    k = next(
        k
        for k in range(15)
        if SLOPE @ step * ratio**k + 0.5 * bend * (step @ step) * ratio ** (2 * k) < 0
    )
    assert metrics["outer/line_search_tries"] == k + 1
    np.testing.assert_allclose(result, START + ratio**k * step, rtol=1e-5)


def test_these_bends_do_need_backtracking() -> None:
    step = full_step(MATRIX + 0.1 * np.eye(4))
    assert SLOPE @ step + 0.5 * 40.0 * step @ step > 0


def test_the_curvature_sample_gives_the_direction_and_nothing_else() -> None:
    """A matrix ten times too small gives steps too long, which the true divergence cuts."""
    other = positive_definite(1, 4) / 10
    result, metrics = update(quadratic(), quadratic(bend=1e6, matrix=other), damping=0.0)
    step = full_step(other)
    k = next(k for k in range(15) if 0.5 * (step @ MATRIX @ step) * 0.25**k < MAX_KL)
    assert k > 0
    np.testing.assert_allclose(result, START + 0.5**k * step, rtol=1e-5)
    expected = 0.5 * (step @ MATRIX @ step) * 0.25**k
    np.testing.assert_allclose(metrics["outer/kl"], expected, rtol=1e-5)
    np.testing.assert_allclose(metrics["outer/improvement"], -(SLOPE @ step) * 0.5**k, rtol=1e-5)


def poisoned(what: str) -> Objective:
    """An objective with a slope, on which nothing but the start is acceptable."""
    base = quadratic()

    def moved(new: Any, old: Any) -> jax.Array:
        return jnp.any(ravel_pytree(new)[0] != ravel_pytree(old)[0])

    def loss(new: Any, old: Any) -> jax.Array:
        worse = {"worse": 1.0, "nan loss": jnp.nan}.get(what, 0.0)
        return base.loss(new, old) + jnp.where(moved(new, old), worse, 0.0)

    def divergence(new: Any, old: Any) -> jax.Array:
        more = {"far": 1.0, "nan kl": jnp.nan}.get(what, 0.0)
        return base.divergence(new, old) + jnp.where(moved(new, old), more, 0.0)

    return Objective(base.outputs, loss, divergence)


@pytest.mark.parametrize("what", ["worse", "far", "nan loss", "nan kl"])
def test_where_no_step_is_acceptable_the_parameters_stay_bit_for_bit(what: str) -> None:
    result, metrics = update(poisoned(what), max_backtracks=7)
    np.testing.assert_array_equal(result, START)
    assert metrics["outer/accepted"] == 0
    assert metrics["outer/line_search_tries"] == 7
    assert metrics["outer/improvement"] == metrics["outer/kl"] == 0
    assert np.isfinite(list(metrics.values())).all()


def test_a_zero_gradient_moves_nothing() -> None:
    objective = quadratic()._replace(loss=lambda new, old: jnp.zeros(()))
    result, metrics = update(objective)
    np.testing.assert_array_equal(result, START)
    assert metrics["outer/accepted"] == 0


def test_the_line_search_takes_the_first_that_is_good_enough() -> None:
    """On a line from 0 with step 1: losses fall below 0 under 0.3, the KL is the length."""
    tried: list[float] = []

    def evaluate(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        jax.debug.callback(lambda v: tried.append(float(v)), x[0])
        return x[0] - 0.3, x[0]

    line = line_search(evaluate, jnp.zeros(1), jnp.ones(1), jnp.zeros(()), 0.2, 0.5, 15)
    jax.effects_barrier()
    assert tried == [1.0, 0.5, 0.25, 0.125]
    assert bool(line.accepted)
    np.testing.assert_array_equal(line.params, [0.125])
    np.testing.assert_array_equal(line.kl, 0.125)
    assert int(line.tries) == 4


def cg(matrix: np.ndarray, b: np.ndarray, iterations: int) -> tuple[np.ndarray, np.ndarray]:
    with jax.enable_x64(True):
        a = jnp.asarray(matrix)
        x, residual = conjugate_gradient(lambda v: a @ v, jnp.asarray(b), iterations)
        return np.asarray(x), np.asarray(residual)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_conjugate_gradient_solves_in_as_many_iterations_as_dimensions(seed: int) -> None:
    matrix, b = positive_definite(seed, 6), np.random.default_rng(seed).normal(size=6)
    x, residual = cg(matrix, b, 6)
    np.testing.assert_allclose(x, np.linalg.solve(matrix, b), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(residual, b - matrix @ x, atol=1e-10)


def test_conjugate_gradient_cut_short_tells_its_residual() -> None:
    matrix, b = positive_definite(3, 6), np.arange(1.0, 7.0)
    x, residual = cg(matrix, b, 2)
    assert np.linalg.norm(residual) > 1e-3
    np.testing.assert_allclose(residual, b - matrix @ x, rtol=1e-10)
    # the best point of the space that b and A b span
    krylov = np.stack([b, matrix @ b], axis=1)
    best = krylov @ np.linalg.solve(krylov.T @ matrix @ krylov, krylov.T @ b)
    np.testing.assert_allclose(x, best, rtol=1e-8)


def test_iterations_after_convergence_change_nothing() -> None:
    matrix, b = positive_definite(0, 6), np.ones(6)
    np.testing.assert_array_equal(cg(matrix, b, 60)[0], cg(matrix, b, 12)[0])


def test_conjugate_gradient_of_zero_is_zero() -> None:
    np.testing.assert_array_equal(cg(positive_definite(0, 3), np.zeros(3), 5)[0], np.zeros(3))


def test_without_a_gradient_nothing_is_tried_and_the_parameters_stay() -> None:
    objective = quadratic()._replace(loss=lambda new, old: jnp.zeros(()))
    params, _, metrics = trpo().update(objective, objective, as_params(START), ())
    np.testing.assert_array_equal(as_vector(params), np.asarray(START, np.float32))
    assert metrics["outer/line_search_tries"] == 0
    assert metrics["outer/accepted"] == 0


def test_conjugate_gradient_stops_where_curvature_is_not_positive() -> None:
    x, residual = cg(-np.eye(3), np.ones(3), 5)
    np.testing.assert_array_equal(x, np.zeros(3))
    np.testing.assert_array_equal(residual, np.ones(3))


@pytest.mark.parametrize("steps", [1, 2])
def test_the_fisher_matrix_through_the_adaptation_is_the_kls_hessian(steps: int) -> None:
    """Gauss-Newton equals the Hessian where new and old policies are equal."""
    damping = 0.01
    with jax.enable_x64(True):
        policy, params = small_policy((3,))
        objective = adapted_objective(policy, enhanced_steps(steps, 0.3))[0]
        flat, unravel = ravel_pytree(params)
        old = jax.jit(objective.outputs)(params)
        dense = jax.hessian(lambda x: objective.divergence(objective.outputs(unravel(x)), old))

        @jax.jit
        def matrix(flat: jax.Array) -> jax.Array:
            product = fisher_product(objective, flat, unravel, damping)
            return jax.vmap(product)(jnp.eye(flat.size))

        fisher = np.asarray(matrix(flat))
        expected = np.asarray(jax.jit(dense)(flat)) + damping * np.eye(flat.size)
    assert np.abs(expected).max() > 10 * damping
    np.testing.assert_allclose(fisher, expected, rtol=1e-8, atol=1e-10)


def numpy_kl(new: Any, old: Any, mask: np.ndarray) -> float:
    """KL(new || old), mean over tasks of the mean over living steps and dimensions."""
    (m1, s1), (m0, s0) = ((np.asarray(g.mean), np.exp(np.asarray(g.log_std))) for g in (new, old))
    kl = np.log(s0 / s1) + (s1**2 + (m1 - m0) ** 2) / (2 * s0**2) - 0.5
    return float(np.mean([kl[m][mask[m] > 0].mean() for m in range(TASKS)]))


def numpy_surrogate(new: Any, old: Any, rollouts: Any) -> float:
    action, mask = np.asarray(rollouts.trajectory.action), np.asarray(rollouts.trajectory.mask)

    def log_density(g: Any) -> np.ndarray:
        mean, log_std = np.asarray(g.mean), np.asarray(g.log_std)
        return np.mean(-0.5 * ((action - mean) / np.exp(log_std)) ** 2 - log_std, axis=-1)

    gain = np.exp(log_density(new) - log_density(old)) * np.asarray(rollouts.advantage)
    return -float(np.mean([gain[m][mask[m] > 0].mean() for m in range(TASKS)]))


@pytest.mark.parametrize("max_kl", [1e-3, 1e-2, 0.1])
def test_a_real_update_improves_the_adapted_policies_within_max_kl(max_kl: float) -> None:
    with jax.enable_x64(True):
        policy, params = small_policy()
        steps = enhanced_steps(1, 0.3)
        objective, inner, demos, outer = adapted_objective(policy, steps)
        optimizer = trpo(max_kl=max_kl)
        update = jax.jit(lambda p: optimizer.update(objective, objective, p, ()))
        new_params, _, metrics = update(params)

        @jax.jit
        def adapted(p: Any) -> Any:
            def of_task(inner: Any, demos: Any, obs: jax.Array) -> Any:
                return policy.apply(readapt(policy, steps, p, inner, demos)[-1], obs)

            return jax.vmap(of_task)(inner, demos, outer.trajectory.obs)

        new, old = adapted(new_params), adapted(params)
    mask = np.asarray(outer.trajectory.mask)
    kl, loss = numpy_kl(new, old, mask), numpy_surrogate(new, old, outer)
    before = numpy_surrogate(old, old, outer)
    assert float(metrics["outer/accepted"]) == 1
    assert 0 < kl < max_kl
    assert kl > 1e-3 * max_kl
    assert loss < before
    np.testing.assert_allclose(metrics["outer/kl"], kl, rtol=1e-8)
    np.testing.assert_allclose(metrics["outer/loss"], before, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(metrics["outer/improvement"], before - loss, rtol=1e-8)
