"""Adaptation of the policy to one task: collecting episodes on the way, or again on stored ones."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.meta.batching import one_at_a_time
from emrld_jax.meta.inner import InnerStep
from emrld_jax.policy import Policy
from emrld_jax.types import Collect, Demos, Params, Rollout, Rollouts, Task

InnerSteps = tuple[InnerStep, ...]


class Adapted(NamedTuple):
    """What adaptation to one task made."""

    params: Params
    path: tuple[Params, ...]  # before the first inner step, between them, after the last
    rollouts: Rollouts


def descend(
    policy: Policy, step: InnerStep, params: Params, rollout: Rollout | None, demos: Demos
) -> Params:
    """The parameters after one inner step.

    Differentiable in `params`, through the gradient too unless the step is first-order.
    """
    gradient = jax.grad(lambda p: step.loss(policy, p, rollout, demos))(params)
    if step.first_order:
        gradient = jax.lax.stop_gradient(gradient)
    return jax.tree.map(lambda p, g: p - step.learning_rate * g, params, gradient)


def adapt(
    policy: Policy,
    steps: InnerSteps,
    collect: Collect,
    params: Params,
    key: jax.Array,
    task: Task,
    demos: Demos,
) -> Adapted:
    """Adapts to one task, collecting episodes where an inner step asks for them.

    Not to be differentiated, which a CPU's layout does not allow; `readapt` is.
    """
    path, rollouts = [params], []
    for step, step_key in zip(steps, jax.random.split(key, len(steps)), strict=True):
        rollout = collect(path[-1], step_key, task) if step.on_policy else None
        path.append(_descend_once(policy, step, path[-1], rollout, demos))
        rollouts.append(rollout)
    return Adapted(path[-1], tuple(path), tuple(rollouts))


def _descend_once(
    policy: Policy, step: InnerStep, params: Params, rollout: Rollout | None, demos: Demos
) -> Params:
    """`descend` where nobody differentiates it; episodes without any advantage cost nothing."""

    @one_at_a_time
    def descended(params: Params, rollout: Rollout | None, demos: Demos) -> Params:
        if rollout is None:
            return descend(policy, step, params, None, demos)
        # the loss weighs each step by its advantage: where all are 0, no steps are as good
        nothing = jax.tree.map(lambda x: x[:0], rollout)
        return jax.lax.cond(
            jnp.any(rollout.advantage != 0),
            lambda: descend(policy, step, params, rollout, demos),
            lambda: descend(policy, step, params, nothing, demos),
        )

    return descended(params, rollout, demos)


def readapt(
    policy: Policy, steps: InnerSteps, params: Params, rollouts: Rollouts, demos: Demos
) -> tuple[Params, ...]:
    """Adapts to one task on stored episodes: what meta-learning differentiates in `params`.

    Returns:
        The path, as in `Adapted`: before the first inner step, between them, after the last.
    """
    path = [params]
    for step, rollout in zip(steps, rollouts, strict=True):
        path.append(descend(policy, step, path[-1], rollout, demos))
    return tuple(path)
