"""Gradient-following outer optimizers against their formulas in NumPy."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from emrld_jax.meta.gradient import adam, sgd
from emrld_jax.meta.outer import Objective

TARGET = np.array([1.0, -2.0, 0.5], np.float32)
CURVATURE = np.array([4.0, 1.0, 0.1], np.float32)
START = {"x": jnp.array([0.0, 0.5, 3.0])}


def quadratic() -> Objective:
    """Half of the curvature times the squared way to the target; how far outputs moved."""

    def loss(new: Any, old: Any) -> Any:
        return 0.5 * jnp.sum(CURVATURE * (new - TARGET) ** 2)

    def divergence(new: Any, old: Any) -> Any:
        return jnp.sum((new - old) ** 2)

    return Objective(lambda params: params["x"], loss, divergence)


def numpy_loss(x: np.ndarray) -> float:
    return float(0.5 * np.sum(CURVATURE * (x - TARGET) ** 2))


def test_adam_is_its_formula_and_goes_on_where_it_stopped() -> None:
    optimizer, objective = adam(0.1, steps=2), quadratic()
    params, state = START, optimizer.init(START)
    x, m, v = np.asarray(START["x"], float), np.zeros(3), np.zeros(3)
    for iteration in range(3):
        params, state, metrics = optimizer.update(objective, objective, params, state)
        before = x.copy()
        for step in range(2):
            gradient = CURVATURE * (x - TARGET)
            if step == 0:
                np.testing.assert_allclose(
                    metrics["outer/gradient_norm"], np.linalg.norm(gradient), rtol=1e-4
                )
            m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
            t = 2 * iteration + step + 1
            x = x - 0.1 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        np.testing.assert_allclose(params["x"], x, rtol=1e-4)
        np.testing.assert_allclose(metrics["outer/loss"], numpy_loss(before), rtol=1e-4)
        gained = numpy_loss(before) - numpy_loss(x)
        np.testing.assert_allclose(metrics["outer/improvement"], gained, rtol=1e-3)
        np.testing.assert_allclose(metrics["outer/kl"], np.sum((x - before) ** 2), rtol=1e-3)


def test_sgd_goes_down_the_gradient() -> None:
    optimizer, objective = sgd(0.25), quadratic()
    params, _, _ = optimizer.update(objective, objective, START, optimizer.init(START))
    start = np.asarray(START["x"])
    np.testing.assert_allclose(params["x"], start - 0.25 * CURVATURE * (start - TARGET), rtol=1e-5)
