"""Outer objectives, functions of the meta-parameters, and what an optimizer of them is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.meta.inner import masked_mean
from emrld_jax.policy import kl_divergence, log_prob
from emrld_jax.types import Gaussian, Params, Rollout

Metrics = dict[str, jax.Array]


class Objective(NamedTuple):
    """A loss of a model's outputs, and how far outputs are from the old ones.

    Keeping the outputs in sight lets an optimizer linearize the model once, and use the curvature
    that the divergence has in them (Gauss-Newton).

    Where several devices share the tasks, all but `average` is of a device's own ones. An optimizer
    averages the loss, the divergence and their derivatives in the parameters before it uses them.
    """

    outputs: Callable[[Params], Any]
    loss: Callable[[Any, Any], jax.Array]  # (new outputs, old outputs) -> []
    divergence: Callable[[Any, Any], jax.Array]  # (new, old) -> [], least where they are equal
    average: Callable[[Any], Any] = lambda own: own  # the mean over devices, of a pytree


class OuterOptimizer(NamedTuple):
    """Something that improves parameters on an objective, as pure functions."""

    init: Callable[[Params], Any]  # (params) -> opt_state
    # (objective, curvature, params, opt_state) -> (params, opt_state, metrics), where `curvature`
    # is the same objective, perhaps on a sample of the data, for optimizers that use second
    # derivatives
    update: Callable[[Objective, Objective, Params, Any], tuple[Params, Any, Metrics]]


def surrogate(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
    """-mean(ratio * advantage) over one task's steps: the improvement TRPO predicts, negated."""
    action = rollout.trajectory.action
    ratio = jnp.exp(log_prob(new, action) - log_prob(old, action))
    return -masked_mean(ratio * rollout.advantage, rollout.trajectory.mask)


def surrogate_objective(policies: Callable[[Params], Gaussian], rollouts: Rollout) -> Objective:
    """The TRPO surrogate with the KL divergence, averaged over a leading axis of tasks.

    Args:
        policies: the policies at the rollouts' observations, of the parameters, [M, S, A].
        rollouts: fields [M, S, ..].
    """
    mask = rollouts.trajectory.mask

    def loss(new: Gaussian, old: Gaussian) -> jax.Array:
        return jnp.mean(jax.vmap(surrogate)(new, old, rollouts))

    def divergence(new: Gaussian, old: Gaussian) -> jax.Array:
        return jnp.mean(jax.vmap(masked_mean)(kl_divergence(new, old), mask))

    return Objective(policies, loss, divergence)
