"""Theorem 3.2 beside a meta-step: its terms, estimated, and the improvement, measured.

Both meta-policies adapt and collect anew, with the same random numbers, which are none of
training's: so the estimates do not flatter an update that was fitted to its own episodes.
docs/theory.md tells what each number is, and where an estimate is a model.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer import Metrics
from emrld_jax.policy import Policy, log_prob, total_variation
from emrld_jax.precision import dot
from emrld_jax.sampling.advantages import (
    baseline_features,
    baseline_weights,
    reward_advantages,
)
from emrld_jax.theory.bound import Terms
from emrld_jax.types import Collect, Demos, Gaussian, Params, Played, Task, Trajectory


class Shown(NamedTuple):
    """One task's demonstration, and what it is worth in the environment."""

    demos: Demos  # what adaptation sees
    played: Played


class Estimation(NamedTuple):
    """How returns are discounted and advantages estimated; episodes end at the horizon."""

    discount: float  # may be traced, as gae_lambda
    gae_lambda: float
    horizon: int


class Estimates(NamedTuple):
    """Of one task, [] each. Sums over time are discounted, and means over episodes."""

    surrogate: jax.Array  # sum over the old policy's steps of (ratio - 1) * advantage
    tv_old: jax.Array  # sum over the old policy's steps
    tv_demonstrator: jax.Array  # sum over the demonstrated steps
    least_gain: jax.Array  # the demonstrator's least advantage at a demonstrated step
    total_gain: jax.Array  # the demonstrator's return above the old policy's
    largest: jax.Array  # |advantage|, of either's steps
    steps_old: jax.Array
    steps_new: jax.Array
    steps_shown: jax.Array
    improvement: jax.Array  # of the discounted return
    improvement_undiscounted: jax.Array


def diagnose(
    learner: MetaLearner,
    collect: Collect,
    how: Estimation,
    old: Params,
    new: Params,
    key: jax.Array,
    tasks: Task,
    shown: Shown,
) -> Metrics:
    """The terms of the bound, the bound and the measured improvement of a meta-step.

    Args:
        learner: whose `adapt` makes the policies that the theorem compares.
        collect: makes a task's episodes.
        how: of the returns.
        old: meta-parameters before the step.
        new: after it.
        key: of all random numbers, the same for both.
        tasks: [M, ..].
        shown: [M, ..].
    """

    def one(key: jax.Array, task: Task, shown: Shown) -> Estimates:
        adapt_key, episodes_key = jax.random.split(key)

        def adapted(params: Params) -> tuple[Params, Trajectory]:
            own = learner.adapt(params, adapt_key, task, shown.demos, collect).params
            return own, collect(own, episodes_key, task).trajectory

        # One after the other, also on an accelerator: XLA's CPU runtime (JAX 0.10.2) may wait for
        # ever in two batched QR decompositions, here of the two baselines, that go on at once.
        both = jax.tree.map(lambda *leaves: jnp.stack(leaves), old, new)
        found = jax.lax.map(adapted, both)
        (own, before), (changed, after) = (
            jax.tree.map(lambda leaf, k=k: leaf[k], found) for k in range(2)
        )
        return estimate(learner.policy, how, own, before, changed, after, shown)

    keys = jax.random.split(key, shown.demos.mask.shape[0])
    return _metrics(jax.vmap(one)(keys, tasks, shown))


def estimate(
    policy: Policy,
    how: Estimation,
    old: Params,
    before: Trajectory,
    new: Params,
    after: Trajectory,
    shown: Shown,
) -> Estimates:
    """What one task tells: adapted parameters with their episodes [E, T, ..], and a demonstration.

    The demonstrator is taken for a policy that does what it did, with the new policy's deviation.
    """
    weights = baseline_weights(before, how.discount)
    advantage = reward_advantages(before, weights, how.discount, how.gae_lambda) * before.mask
    gains, tail = _demonstrated_gains(shown.played, weights, how)
    first, second = (policy.apply(params, before.obs) for params in (old, new))
    size = before.action.shape[-1]  # log_prob is a mean over dimensions, the ratio of the action
    ratio = jnp.exp(size * (log_prob(second, before.action) - log_prob(first, before.action)))
    played = shown.played
    own = policy.apply(new, played.obs)
    demonstrator = Gaussian(played.action, own.log_std)
    now, then, showing = (_weights(x.mask, how.discount) for x in (before, after, played))
    old_return = _per_episode(now * before.reward)
    return Estimates(
        surrogate=_per_episode(now * (ratio - 1.0) * advantage),
        tv_old=_per_episode(now * total_variation(first, second)),
        tv_demonstrator=jnp.sum(showing * total_variation(own, demonstrator)),
        least_gain=jnp.min(gains, where=played.mask > 0, initial=jnp.inf),
        total_gain=jnp.sum(showing * played.reward) + tail - old_return,
        largest=jnp.maximum(jnp.max(jnp.abs(advantage)), jnp.max(jnp.abs(gains))),
        steps_old=_per_episode(now),
        steps_new=_per_episode(then),
        steps_shown=jnp.sum(showing),
        improvement=_per_episode(then * after.reward) - old_return,
        improvement_undiscounted=_per_episode(
            after.mask * after.reward - before.mask * before.reward
        ),
    )


def _weights(mask: jax.Array, discount: float) -> jax.Array:
    """discount^t at the t-th step of each sequence, 0 outside the mask. [.., T] -> [.., T]."""
    powers = discount ** jnp.arange(mask.shape[-1])
    return mask * jnp.broadcast_to(powers, mask.shape)


def _per_episode(x: jax.Array) -> jax.Array:
    """The sum over time, as the mean over episodes. [E, T] -> []."""
    return jnp.mean(jnp.sum(x, axis=-1))


def _demonstrated_gains(
    played: Played, weights: jax.Array, how: Estimation
) -> tuple[jax.Array, jax.Array]:
    """What each demonstrated step gains on the old policy, by the baseline's values; and the tail.

    reward + discount * V(next) - V, [N], 0 outside the mask; and what the old policy would still
    earn where the demonstration stops before the episode does, discounted, [].
    """
    n = jnp.sum(played.mask).astype(int)
    obs = jnp.concatenate([played.obs, played.last_obs[None]]).at[n].set(played.last_obs)
    goes_on = (1.0 - jnp.sum(played.mask * played.done)) * (n < how.horizon)
    exists = jnp.append(played.mask, 0.0).at[n].set(goes_on)
    value = dot(baseline_features(obs), weights) * exists
    gains = (played.reward + how.discount * value[1:] - value[:-1]) * played.mask
    return gains, value[n] * how.discount**n


def _metrics(tasks: Estimates) -> Metrics:
    """Means over tasks, [M] each; distances as means over steps."""
    mean: Estimates = jax.tree.map(jnp.mean, tasks)
    found = Terms(
        surrogate=mean.surrogate,
        tv_old=mean.tv_old / mean.steps_old,
        tv_demonstrator=mean.tv_demonstrator / mean.steps_shown,
        delta=jnp.min(tasks.least_gain),
        c1=jnp.max(tasks.largest),
        steps_old=mean.steps_old,
        steps_new=mean.steps_new,
    )
    metrics = {f"theory/{name}": value for name, value in found._asdict().items()}
    metrics["theory/delta_mean"] = mean.total_gain / mean.steps_shown
    metrics["theory/bound"] = found.bound
    for name in ("improvement", "improvement_undiscounted"):
        own = getattr(tasks, name)
        metrics[f"theory/{name}"] = jnp.mean(own)
        if len(own) > 1:  # one task alone does not tell how much tasks differ
            metrics[f"theory/{name}_se"] = jnp.std(own, ddof=1) / len(own) ** 0.5
    return metrics
