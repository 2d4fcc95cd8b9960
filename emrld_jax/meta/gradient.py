"""Outer optimizers that follow the gradient of the loss alone."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from emrld_jax.meta.outer import Metrics, Objective, OuterOptimizer
from emrld_jax.types import Params


def adam(learning_rate: float | jax.Array, steps: int = 1) -> OuterOptimizer:
    """Steps of Adam on one batch of episodes (Kingma & Ba 2015)."""
    return gradient_steps(optax.adam(learning_rate), steps)


def sgd(learning_rate: float | jax.Array) -> OuterOptimizer:
    """One step along the negative gradient."""
    return gradient_steps(optax.sgd(learning_rate), 1)


def gradient_steps(transformation: optax.GradientTransformation, steps: int) -> OuterOptimizer:
    """An optax optimizer, several steps on one batch of episodes."""

    def update(
        objective: Objective, curvature: Objective, params: Params, opt_state: Any
    ) -> tuple[Params, Any, Metrics]:
        old = objective.outputs(params)

        def descend(carry: tuple[Params, Any], _: None) -> tuple[tuple[Params, Any], Any]:
            params, opt_state = carry
            own = jax.value_and_grad(lambda p: objective.loss(objective.outputs(p), old))(params)
            loss, gradient = objective.average(own)
            updates, opt_state = transformation.update(gradient, opt_state, params)
            return (optax.apply_updates(params, updates), opt_state), (
                loss,
                jnp.linalg.norm(ravel_pytree(gradient)[0]),
            )

        (params, opt_state), (losses, norms) = jax.lax.scan(
            descend, (params, opt_state), length=steps
        )
        new = objective.outputs(params)
        after = (objective.loss(new, old), objective.divergence(new, old))
        loss, divergence = objective.average(after)
        metrics = {
            "outer/loss": losses[0],
            "outer/improvement": losses[0] - loss,
            "outer/kl": divergence,
            "outer/gradient_norm": norms[0],
        }
        return params, opt_state, metrics

    return OuterOptimizer(transformation.init, update)
