"""Trust region policy optimization (Schulman et al. 2015).

Conjugate gradient finds the direction, a line search the length of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from emrld_jax.meta.outer import Metrics, Objective, OuterOptimizer
from emrld_jax.precision import dot
from emrld_jax.types import Params


class Line(NamedTuple):
    """Where a line search stands."""

    tries: jax.Array  # [], int
    accepted: jax.Array  # [], bool
    params: jax.Array  # [P], of the last try
    loss: jax.Array  # []
    kl: jax.Array  # []


class Iterate(NamedTuple):
    """Where the conjugate gradient stands."""

    iteration: jax.Array  # [], int
    x: jax.Array  # [P]
    residual: jax.Array  # [P]
    direction: jax.Array  # [P]
    squared: jax.Array  # [], residual . residual


def conjugate_gradient(
    product: Callable[[jax.Array], jax.Array], b: jax.Array, iterations: int
) -> tuple[jax.Array, jax.Array]:
    """x near the solution of A x = b for a symmetric positive definite A, and the residual b - A x.

    Starts from 0, and ends early on convergence or where rounding lost positive curvature. For
    b = 0 there is nothing to do.

    Args:
        product: v -> A v, [P] -> [P].
        b: [P].
    """

    def iterate(state: Iterate) -> Iterate:
        image = product(state.direction)
        curvature = dot(state.direction, image)
        positive = curvature > 0
        length = jnp.where(positive, state.squared / jnp.where(positive, curvature, 1.0), 0.0)
        residual = state.residual - length * image
        squared = dot(residual, residual)
        return Iterate(
            jnp.where(positive, state.iteration + 1, iterations),
            state.x + length * state.direction,
            residual,
            residual + squared / state.squared * state.direction,
            squared,
        )

    def unfinished(state: Iterate) -> jax.Array:
        return (state.iteration < iterations) & (state.squared > 1e-10 * dot(b, b))

    start = Iterate(jnp.zeros((), jnp.int32), jnp.zeros_like(b), b, b, dot(b, b))
    end = jax.lax.while_loop(unfinished, iterate, start)
    return end.x, end.residual


def line_search(
    evaluate: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    params: jax.Array,
    step: jax.Array,
    loss: jax.Array,
    max_kl: float,
    ratio: float,
    max_tries: int,
) -> Line:
    """The first of params + step * ratio^k, k < max_tries, that is accepted, else the last.

    Accepted is one whose loss falls below `loss` with a KL under max_kl. A step of 0 is not tried.

    Args:
        evaluate: parameters [P] -> (loss [], KL []).
        params: [P].
        step: [P], the longest step.
        loss: [], at params.
    """

    def try_next(line: Line) -> Line:
        candidate = params + step * ratio ** line.tries.astype(step.dtype)
        new_loss, kl = evaluate(candidate)
        accepted = (new_loss < loss) & (kl < max_kl)  # False if either is NaN
        return Line(line.tries + 1, accepted, candidate, new_loss, kl)

    def unfinished(line: Line) -> jax.Array:
        return ~line.accepted & (line.tries < max_tries) & moves

    moves = jnp.any(step != 0)
    zero = jnp.zeros((), loss.dtype)
    start = Line(jnp.zeros((), jnp.int32), jnp.zeros((), bool), params, loss, zero)
    return jax.lax.while_loop(unfinished, try_next, start)


def trpo(
    *,
    max_kl: float = 0.01,
    cg_iterations: int = 10,
    damping: float = 1e-5,
    backtrack_ratio: float = 0.5,
    max_backtracks: int = 15,
) -> OuterOptimizer:
    """One step that lowers the loss while the KL divergence from its start stays under max_kl.

    At the start the KL's Hessian is its Gauss-Newton form J' H J, with J the Jacobian of the
    outputs and H the Hessian of the divergence in them. So the outputs are linearized once, and
    each of the conjugate gradient's products costs one Jacobian-vector and one vector-Jacobian
    product.

    If no step on the line is accepted, the parameters stay.
    """

    def update(
        objective: Objective, curvature: Objective, params: Params, opt_state: Any
    ) -> tuple[Params, Any, Metrics]:
        flat, unravel = ravel_pytree(params)
        old, pull = jax.vjp(lambda x: objective.outputs(unravel(x)), flat)
        own_loss, slope = jax.value_and_grad(objective.loss)(old, old)
        loss, gradient = objective.average((own_loss, pull(slope)[0]))

        def evaluate(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            new = objective.outputs(unravel(x))
            return objective.average((objective.loss(new, old), objective.divergence(new, old)))

        product = fisher_product(curvature, flat, unravel, damping)
        direction, residual = conjugate_gradient(product, -gradient, cg_iterations)
        squared = dot(direction, -gradient - residual)  # direction' F direction, without a product
        step = jnp.sqrt(2 * max_kl / jnp.maximum(squared, 1e-12)) * direction
        line = line_search(evaluate, flat, step, loss, max_kl, backtrack_ratio, max_backtracks)
        return (
            unravel(jnp.where(line.accepted, line.params, flat)),
            opt_state,
            _metrics(line, loss, gradient),
        )

    return OuterOptimizer(init=lambda params: (), update=update)


def _metrics(line: Line, loss: jax.Array, gradient: jax.Array) -> Metrics:
    """What a step tells of its start, [] and [P], and of the line search."""
    return {
        "outer/loss": loss,
        "outer/improvement": jnp.where(line.accepted, loss - line.loss, 0.0),
        "outer/kl": jnp.where(line.accepted, line.kl, 0.0),
        "outer/accepted": line.accepted.astype(loss.dtype),
        "outer/line_search_tries": line.tries.astype(loss.dtype),
        "outer/gradient_norm": jnp.linalg.norm(gradient),
    }


def fisher_product(
    objective: Objective, flat: jax.Array, unravel: Callable[[jax.Array], Params], damping: float
) -> Callable[[jax.Array], jax.Array]:
    """v -> (F + damping) v, [P] -> [P], with F the divergence's Gauss-Newton matrix at `flat`."""
    old, push = jax.linearize(lambda x: objective.outputs(unravel(x)), flat)
    pull = jax.linear_transpose(push, flat)
    slope = jax.grad(objective.divergence)

    def product(v: jax.Array) -> jax.Array:
        _, curved = jax.jvp(lambda new: slope(new, old), (old,), (push(v),))
        return objective.average(pull(curved)[0]) + damping * v

    return product
