"""Losses of the outer step: what each algorithm's meta-parameters are to lower."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from emrld_jax.meta.inner import masked_mean
from emrld_jax.meta.outer import Average, Objective, OuterLoss
from emrld_jax.policy import Policy, kl_divergence, log_prob
from emrld_jax.types import Demos, Experience, Gaussian, Params, Rollout, Rollouts

Path = tuple[Params, ...]
Before = tuple[Gaussian, ...]  # the policy that collected, at the observations of each collection


def surrogate(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
    """-mean(ratio * advantage) over one task's steps: the improvement TRPO predicts, negated."""
    ratio = _ratio(new, old, rollout)
    return -masked_mean(ratio * rollout.advantage, rollout.trajectory.mask)


def divergence(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
    """The mean of KL(new || old) over one task's steps."""
    return masked_mean(kl_divergence(new, old), rollout.trajectory.mask)


def surrogate_objective(policies: Callable[[Params], Gaussian], rollouts: Rollout) -> Objective:
    """The TRPO surrogate with the KL divergence, averaged over a leading axis of tasks.

    Args:
        policies: the policies at the rollouts' observations, of the parameters, [M, S, A].
        rollouts: fields [M, S, ..].
    """
    return Objective(
        policies,
        lambda new, old: _mean(surrogate, new, old, rollouts),
        lambda new, old: _mean(divergence, new, old, rollouts),
    )


def adapted_surrogate() -> OuterLoss:
    """The TRPO surrogate of the adapted policies on their own episodes (MAML, EMRLD)."""

    def outputs(policy: Policy, path: Path, experience: Experience, demos: Demos) -> Gaussian:
        return policy.apply(path[-1], experience.outer.trajectory.obs)

    def loss(
        new: Gaussian, old: Gaussian, experience: Experience, demos: Demos, average: Average
    ) -> jax.Array:
        return _mean(surrogate, new, old, experience.outer)

    return OuterLoss(outputs, loss, lambda new, old, e, demos: _mean(divergence, new, old, e.outer))


def adapted_demonstrations() -> OuterLoss:
    """-mean(log_prob) of the demonstrations under the adapted policies (Meta-BC, GMPS)."""

    def outputs(policy: Policy, path: Path, experience: Experience, demos: Demos) -> Gaussian:
        return policy.apply(path[-1], demos.obs)

    def loss(
        new: Gaussian, old: Gaussian, experience: Experience, demos: Demos, average: Average
    ) -> jax.Array:
        return -_mean(masked_mean, log_prob(new, demos.action), demos.mask)

    def moved(new: Gaussian, old: Gaussian, experience: Experience, demos: Demos) -> jax.Array:
        return _mean(masked_mean, kl_divergence(new, old), demos.mask)

    return OuterLoss(outputs, loss, moved)


def clipped_surrogate(clip: float | jax.Array, kl_penalty: float | jax.Array) -> OuterLoss:
    """The clipped surrogate of the adapted policies, kept near the policies before (ProMP).

    Ratios are those of whole actions; the surrogate is divided by the number of their dimensions.

    Args:
        clip: how far from 1 a ratio may go before its step says no more.
        kl_penalty: weight of KL(old || new) of the policies that adaptation collected with.
    """

    def clipped(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
        size = rollout.trajectory.action.shape[-1]
        ratio = _ratio(new, old, rollout) ** size
        bounded = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
        gain = jnp.minimum(ratio * rollout.advantage, bounded * rollout.advantage)
        return -masked_mean(gain, rollout.trajectory.mask) / size

    def strayed(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
        return divergence(old, new, rollout)

    def loss(
        new: tuple[Before, Gaussian],
        old: tuple[Before, Gaussian],
        experience: Experience,
        demos: Demos,
        average: Average,
    ) -> jax.Array:
        penalty = _mean_before(strayed, new[0], old[0], experience.inner)
        return _mean(clipped, new[1], old[1], experience.outer) + kl_penalty * penalty

    return OuterLoss(_before_and_after, loss, _moved_after, idle_steps=True)


def exploring_surrogate() -> OuterLoss:
    """The surrogate, plus credit for episodes that adaptation profits from (E-MAML).

    What is collected before adaptation counts by the return that comes after it, standardized over
    tasks: the meta-policy is to collect what adaptation needs.
    """

    def loss(
        new: tuple[Before, Gaussian],
        old: tuple[Before, Gaussian],
        experience: Experience,
        demos: Demos,
        average: Average,
    ) -> jax.Array:
        score = _standardized(_total_reward(experience.outer), average)

        def credit(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
            return masked_mean(_ratio(new, old, rollout), rollout.trajectory.mask)

        explored = _mean_before(credit, new[0], old[0], experience.inner, score)
        return _mean(surrogate, new[1], old[1], experience.outer) - explored

    return OuterLoss(_before_and_after, loss, _moved_after, idle_steps=True)


def distance_to_adapted() -> OuterLoss:
    """Half the squared distance to the adapted parameters, which are held (Reptile).

    Its gradient is the mean over tasks of meta-parameters minus adapted parameters.
    """

    def outputs(
        policy: Policy, path: Path, experience: Experience, demos: Demos
    ) -> tuple[tuple[Params, Params], Gaussian]:
        adapted = policy.apply(path[-1], experience.outer.trajectory.obs)
        return (path[0], jax.lax.stop_gradient(path[-1])), adapted

    def loss(
        new: tuple[tuple[Params, Params], Gaussian],
        old: Any,
        experience: Experience,
        demos: Demos,
        average: Average,
    ) -> jax.Array:
        return jnp.mean(_squared_distance(*new[0]))

    return OuterLoss(outputs, loss, _moved_after)


def _ratio(new: Gaussian, old: Gaussian, rollout: Rollout) -> jax.Array:
    """How much likelier a new policy makes each action, a dimension (geometric mean). [S]."""
    action = rollout.trajectory.action
    return jnp.exp(log_prob(new, action) - log_prob(old, action))


def _mean(of_task: Callable[..., jax.Array], *batches: Any) -> jax.Array:
    """The mean over a leading axis of tasks."""
    return jnp.mean(jax.vmap(of_task)(*batches))


def _before_and_after(
    policy: Policy, path: Path, experience: Experience, demos: Demos
) -> tuple[Before, Gaussian]:
    """The policies that collected for adaptation, and the adapted one, where they were."""
    collected = zip(path[:-1], experience.inner, strict=True)
    before = tuple(policy.apply(p, r.trajectory.obs) for p, r in collected if r is not None)
    return before, policy.apply(path[-1], experience.outer.trajectory.obs)


def _mean_before(
    of_task: Callable[..., jax.Array],
    new: Before,
    old: Before,
    inner: Rollouts,
    weight: jax.Array | float = 1.0,
) -> jax.Array:
    """The mean over tasks, each with its weight, and over adaptation's collections."""
    rollouts = [rollout for rollout in inner if rollout is not None]
    found = [jax.vmap(of_task)(*each) for each in zip(new, old, rollouts, strict=True)]
    return jnp.mean(jnp.stack([weight * of_tasks for of_tasks in found]))


def _moved_after(
    new: tuple[Any, Gaussian], old: tuple[Any, Gaussian], experience: Experience, demos: Demos
) -> jax.Array:
    """How far the adapted policies have moved, which are the second output."""
    return _mean(divergence, new[1], old[1], experience.outer)


def _total_reward(rollouts: Rollout) -> jax.Array:
    """Rewards of each task's episodes, [M]."""
    steps = rollouts.trajectory
    return jnp.sum(steps.reward * steps.mask, axis=-1)


def _standardized(x: jax.Array, average: Average) -> jax.Array:
    """Minus the mean over all tasks, over the standard deviation; 0 where all are equal. [M]."""
    centered = x - average(jnp.mean(x))
    return centered / (jnp.sqrt(average(jnp.mean(centered**2))) + 1e-8)


def _squared_distance(a: Params, b: Params) -> jax.Array:
    """Half of it, for each element of a leading axis. [M]."""
    parts = jax.tree.map(lambda x, y: jnp.sum((x - y) ** 2, axis=tuple(range(1, x.ndim))), a, b)
    return 0.5 * jax.tree.reduce(jnp.add, parts)
