"""Losses of the inner step, each of one task's data, and the step that descends on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.policy import Policy, log_prob
from emrld_jax.types import Demos, Params, Rollout

# (policy, params, rollout or None, demos) -> []; each step of the rollout weighed by its advantage
InnerLoss = Callable[[Policy, Params, Rollout | None, Demos], jax.Array]


class InnerStep(NamedTuple):
    """One gradient step of adaptation."""

    loss: InnerLoss
    learning_rate: float | jax.Array
    on_policy: bool  # whether it collects episodes first, with the parameters it starts from
    first_order: bool  # whether the meta-gradient ignores the dependence of its gradient on them


def masked_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """The mean of x over the entries with mask 1; 0 if there are none. Any equal shapes -> []."""
    return jnp.sum(x * mask) / jnp.maximum(jnp.sum(mask), 1.0)


def policy_gradient_loss(policy: Policy, params: Params, rollout: Rollout) -> jax.Array:
    """-mean(advantage * log_prob) over the steps of the task's episodes."""
    steps = rollout.trajectory
    density = log_prob(policy.apply(params, steps.obs), steps.action)
    return -masked_mean(rollout.advantage * density, steps.mask)


def likelihood_ratio_loss(policy: Policy, params: Params, rollout: Rollout) -> jax.Array:
    """-mean(advantage * ratio), the ratio that of the policy to the one that collected.

    Where the two are equal its gradient is the policy gradient; its second derivatives also hold
    how the distribution of actions depends on the parameters (ProMP, Rothfuss et al. 2019).
    The ratio is that of whole actions. It is divided by the number of their dimensions, so that
    inner rates are those of `policy_gradient_loss`, which takes the mean over dimensions.
    """
    steps = rollout.trajectory
    size = steps.action.shape[-1]
    density = log_prob(policy.apply(params, steps.obs), steps.action)
    ratio = jnp.exp(size * (density - steps.log_prob))
    return -masked_mean(rollout.advantage * ratio, steps.mask) / size


def demonstration_loss(policy: Policy, params: Params, demos: Demos) -> jax.Array:
    """-mean(log_prob) over the task's demonstration steps: behavior cloning."""
    density = log_prob(policy.apply(params, demos.obs), demos.action)
    return -masked_mean(density, demos.mask)


def _is_zero(weight: float | jax.Array) -> bool:
    return isinstance(weight, int | float) and weight == 0


def enhanced_loss(w_rl: float | jax.Array, w_bc: float | jax.Array) -> InnerLoss:
    """w_rl * policy gradient + w_bc * demonstrations: EMRLD's inner loss.

    A term whose weight is the number 0 is not computed; that of a traced weight always is.
    """

    def loss(policy: Policy, params: Params, rollout: Rollout | None, demos: Demos) -> jax.Array:
        total = jnp.zeros(())
        if rollout is not None and not _is_zero(w_rl):
            total += w_rl * policy_gradient_loss(policy, params, rollout)
        if not _is_zero(w_bc):
            total += w_bc * demonstration_loss(policy, params, demos)
        return total

    return loss


def policy_gradient() -> InnerLoss:
    """The policy gradient alone."""
    return enhanced_loss(w_rl=1.0, w_bc=0.0)


def demonstrations() -> InnerLoss:
    """The demonstrations alone."""
    return enhanced_loss(w_rl=0.0, w_bc=1.0)


def likelihood_ratio() -> InnerLoss:
    """The likelihood ratio alone, on episodes."""

    def loss(policy: Policy, params: Params, rollout: Rollout | None, demos: Demos) -> jax.Array:
        if rollout is None:
            raise ValueError("the likelihood ratio needs episodes: the step must be on-policy")
        return likelihood_ratio_loss(policy, params, rollout)

    return loss
