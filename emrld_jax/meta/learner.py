"""The meta-learner: collects episodes around the adaptation, then improves on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from emrld_jax.meta.adaptation import Adapted, InnerSteps, adapt, readapt
from emrld_jax.meta.batching import map_each, max_over_devices, mean_over_devices
from emrld_jax.meta.outer import Metrics, Objective, OuterLoss, OuterOptimizer
from emrld_jax.policy import Policy
from emrld_jax.sampling.rollouts import (
    episode_divergences,
    episode_returns,
    episode_successes,
    gather_living,
    living_steps,
    without_idle_steps,
)
from emrld_jax.types import Collect, Demos, Experience, OuterDemos, Params, Rollout, Task

# Sizes, as parts of all steps, that a batch of gathered steps is padded to: each compiles once.
BUCKETS = (0.0, 0.25, 0.5, 1.0)


class MetaState(NamedTuple):
    """What meta-learning has learned so far."""

    params: Params
    opt_state: Any


Sizes = Any  # an Experience with a number of steps in place of each Rollout


class Gathered(NamedTuple):
    """What the first half of a meta-iteration makes."""

    experience: Experience
    needed: Sizes  # most steps of a task that matter, [] each
    metrics: Metrics


class Halves(NamedTuple):
    """The two halves of a meta-iteration, not compiled yet, so that they can be batched first.

    The first collects all episodes, without gradients. The second re-adapts on them as a function
    of the meta-parameters, which the optimizer improves. Between them the number of steps that
    matter is read, so that the others can be left out: steps after an episode's end, and of those
    that adaptation uses, steps without an advantage. (An inner loss must weigh each step's term by
    its advantage.)

    Where several devices share the tasks, along an axis of a mesh, [M] is a device's own tasks.
    """

    # (params, keys [M], tasks [M], demos [M], axis or None)
    gather: Callable[[Params, jax.Array, Task, Demos, str | None], Gathered]
    # (experience, demos [M], outer demos [M], sizes, axis or None, every): what the optimizer
    # improves on, of each `every`-th step that matters
    objective: Callable[[Experience, Demos, OuterDemos, Sizes, str | None, int], Objective]
    # (state, experience, demos [M], outer demos [M], sizes, axis or None), where sizes are static
    improve: Callable[
        [MetaState, Experience, Demos, OuterDemos, Sizes, str | None], tuple[MetaState, Metrics]
    ]


# one meta-iteration: (state, key, tasks [M], demos [M], outer_demos [M] or None); with None, which
# need not be given, the outer loss sees the demonstrations that adaptation sees
Update = Callable[..., tuple[MetaState, Metrics]]


class MetaLearner(NamedTuple):
    """A meta-RL algorithm as functions."""

    policy: Policy
    init: Callable[[jax.Array], MetaState]  # (key)
    # (params, key, task, demos, collect), all of one task; `collect` may be a simulation or a robot
    # (not to be differentiated: `readapt` is, on episodes that are there already)
    adapt: Callable[[Params, jax.Array, Task, Demos, Collect], Adapted]
    update: Update
    halves: Halves  # what `update` is made of


def meta_learner(
    policy: Policy,
    inner_steps: InnerSteps,
    collect: Collect,
    outer_loss: OuterLoss,
    optimizer: OuterOptimizer,
    curvature_every: int = 1,
) -> MetaLearner:
    """Assembles a meta-learner.

    The optimizer's curvature is computed on each `curvature_every`-th of the steps that exist.
    """

    parts = _Parts(policy, inner_steps, collect, outer_loss, optimizer, curvature_every)
    halves = Halves(parts.gather, parts.objective, parts.improve)
    return MetaLearner(policy, parts.init, parts.adapt, _compiled(halves), halves)


class _Parts(NamedTuple):
    """What a meta-learner is assembled of; its methods are the learner's functions."""

    policy: Policy
    inner_steps: InnerSteps
    collect: Collect
    outer_loss: OuterLoss
    optimizer: OuterOptimizer
    curvature_every: int

    def init(self, key: jax.Array) -> MetaState:
        params = self.policy.init(key)
        return MetaState(params, self.optimizer.init(params))

    def adapt(
        self, params: Params, key: jax.Array, task: Task, demos: Demos, collect: Collect
    ) -> Adapted:
        return adapt(self.policy, self.inner_steps, collect, params, key, task, demos)

    def experience(self, params: Params, key: jax.Array, task: Task, demos: Demos) -> Experience:
        adapt_key, outer_key = jax.random.split(key)
        adapted = self.adapt(params, adapt_key, task, demos, self.collect)
        return Experience(adapted.rollouts, self.collect(adapted.params, outer_key, task))

    def gather(
        self, params: Params, keys: jax.Array, tasks: Task, demos: Demos, axis: str | None
    ) -> Gathered:
        each_task = jax.vmap(self.experience, in_axes=(None, 0, 0, 0))
        experience = each_task(params, keys, tasks, demos)
        metrics = mean_over_devices(_episode_metrics(experience), axis)
        if not self.outer_loss.idle_steps:
            # adaptation weighs steps by their advantage, the trust region does not
            experience = _without_idle_steps(experience)
        most = jax.tree.map(lambda r: jnp.max(living_steps(r)), experience, is_leaf=_is_rollout)
        return Gathered(experience, max_over_devices(most, axis), metrics)

    def objective(
        self,
        experience: Experience,
        demos: Demos,
        outer_demos: OuterDemos,
        sizes: Sizes,
        axis: str | None,
        every: int,
    ) -> Objective:
        steps = _gather_living(experience, sizes, every)
        shown = demos if outer_demos is None else outer_demos
        return _objective(self.policy, self.inner_steps, self.outer_loss, steps, demos, shown, axis)

    def improve(
        self,
        state: MetaState,
        experience: Experience,
        demos: Demos,
        outer_demos: OuterDemos,
        sizes: Sizes,
        axis: str | None,
    ) -> tuple[MetaState, Metrics]:
        exact, sampled = (
            self.objective(experience, demos, outer_demos, sizes, axis, every)
            for every in (1, self.curvature_every)
        )
        params, opt_state, metrics = self.optimizer.update(
            exact, sampled, state.params, state.opt_state
        )
        params = mean_over_devices(params, axis)  # equal up to rounding: they must not drift apart
        size = jnp.linalg.norm(ravel_pytree(params)[0])
        return MetaState(params, opt_state), {**metrics, "outer/params_norm": size}


def _objective(
    policy: Policy,
    inner_steps: InnerSteps,
    outer_loss: OuterLoss,
    steps: Experience,
    demos: Demos,
    shown: Demos,
    axis: str | None,
) -> Objective:
    """The outer loss of the meta-parameters, through adaptation on these steps, [M, ..].

    Adaptation sees `demos`, the outer loss what is `shown`.
    """
    average = partial(mean_over_devices, axis=axis)

    def outputs(params: Params) -> Any:
        def of_task(experience: Experience, demos: Demos, shown: Demos) -> Any:
            path = readapt(policy, inner_steps, params, experience.inner, demos)
            return outer_loss.outputs(policy, path, experience, shown)

        return map_each(of_task, steps, demos, shown)

    return Objective(
        outputs,
        lambda new, old: outer_loss.loss(new, old, steps, shown, average),
        lambda new, old: outer_loss.divergence(new, old, steps, shown),
        average,
    )


def _compiled(halves: Halves) -> Update:
    """A meta-iteration of one learner on one device."""

    @jax.jit
    def gather(params: Params, key: jax.Array, tasks: Task, demos: Demos) -> Gathered:
        keys = jax.random.split(key, demos.mask.shape[0])
        return halves.gather(params, keys, tasks, demos, None)

    improve = jax.jit(halves.improve, static_argnums=(4, 5))

    def update(
        state: MetaState,
        key: jax.Array,
        tasks: Task,
        demos: Demos,
        outer_demos: OuterDemos = None,
    ) -> tuple[MetaState, Metrics]:
        experience, needed, metrics = gather(state.params, key, tasks, demos)
        sizes = bucket_sizes(experience, needed)
        state, outer = improve(state, experience, demos, outer_demos, sizes, None)
        return state, {**metrics, **outer}

    return update


def bucket_sizes(experience: Experience, needed: Sizes) -> Sizes:
    """How many steps a task of each rollout are gathered into; waits for `needed`."""
    totals = jax.tree.map(lambda r: prod(r.advantage.shape[-2:]), experience, is_leaf=_is_rollout)
    return jax.tree.map(bucket, totals, jax.device_get(needed))


def bucket(total: int, needed: int) -> int:
    """The smallest of the BUCKETS, as parts of `total` steps, that holds the needed ones."""
    return next(size for part in BUCKETS if (size := int(part * total)) >= needed)


def _is_rollout(x: Any) -> bool:
    return isinstance(x, Rollout)


def _without_idle_steps(experience: Experience) -> Experience:
    """Without the steps that adaptation has no use for, of a batch of tasks [M]."""
    inner = jax.tree.map(jax.vmap(without_idle_steps), experience.inner, is_leaf=_is_rollout)
    return experience._replace(inner=inner)


def _gather_living(experience: Experience, sizes: Sizes, every: int) -> Experience:
    """The episodes' existing steps, [M, size, ..], padded to the sizes; or a sample of them."""

    def of_tasks(rollout: Rollout, size: int) -> Rollout:
        return jax.vmap(lambda r: gather_living(r, -(-size // every), every))(rollout)

    return jax.tree.map(of_tasks, experience, sizes, is_leaf=_is_rollout)


def _episode_metrics(experience: Experience) -> Metrics:
    """Mean return, success and length of each stage's episodes, and the share that broke down.

    Stage k comes before the on-policy inner step k (from 0), the last stage after the last step.
    """
    stages = [rollout for rollout in (*experience.inner, experience.outer) if rollout is not None]
    metrics: Metrics = {}
    for stage, rollout in enumerate(stages):
        metrics[f"adapt/return_{stage}"] = jnp.mean(episode_returns(rollout.trajectory))
        metrics[f"adapt/success_{stage}"] = jnp.mean(episode_successes(rollout.trajectory))
        metrics[f"adapt/diverged_{stage}"] = jnp.mean(episode_divergences(rollout.trajectory))
        metrics[f"adapt/length_{stage}"] = jnp.mean(jnp.sum(rollout.trajectory.mask, axis=-1))
    return metrics
