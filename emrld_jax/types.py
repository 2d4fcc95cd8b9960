"""The types that the parts exchange.

One legend for all shapes: M tasks, E episodes a task, T steps an episode (horizon), S steps of a
task's episodes, N demonstration steps (padded), O observation size, A action size. Code is written
for one task; a batch of tasks has a leading [M]. float32 unless said otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

Params = Any  # a pytree of arrays
Task = Any  # an environment's task: a NamedTuple of arrays


class Trajectory(NamedTuple):
    """A task's episodes, [E, T, ..], or their steps gathered without padding, [S, ..]."""

    obs: jax.Array  # [E, T, O], before the action
    action: jax.Array  # [E, T, A], policy units, as sampled (unbounded)
    reward: jax.Array  # [E, T], after the action
    done: jax.Array  # [E, T], 1 where the environment ended the episode
    success: jax.Array  # [E, T], 1 at a step that was a success
    diverged: jax.Array  # [E, T], 1 at a step in which the simulation broke down
    mask: jax.Array  # [E, T], 1 up to and with the ending step
    log_prob: jax.Array  # [E, T], of the action when it was sampled


class Rollout(NamedTuple):
    """A task's episodes with what learning needs of them."""

    trajectory: Trajectory
    advantage: jax.Array  # [E, T], normalized over the task's steps, constant in the parameters


class Demos(NamedTuple):
    """One task's demonstration."""

    obs: jax.Array  # [N, O]
    action: jax.Array  # [N, A], policy units
    mask: jax.Array  # [N], 1 where the step exists


OuterDemos = Demos | None  # what the outer loss is to see; None: what adaptation sees


class Played(NamedTuple):
    """One task's demonstrated actions as the environment takes them, open loop."""

    obs: jax.Array  # [N, O], before the action
    action: jax.Array  # [N, A], policy units
    reward: jax.Array  # [N], after the action
    done: jax.Array  # [N], 1 where the environment ended the episode
    success: jax.Array  # [N], 1 at a step that was a success
    mask: jax.Array  # [N], 1 up to the demonstration's last step, an ending step or the horizon
    last_obs: jax.Array  # [O], after the last step with mask 1


class Gaussian(NamedTuple):
    """Independent normal distributions over action dimensions."""

    mean: jax.Array  # [.., A], policy units
    log_std: jax.Array  # [.., A]


Rollouts = tuple[Rollout | None, ...]  # one an inner step; None where it is not on-policy


class Experience(NamedTuple):
    """The episodes of one meta-iteration, with a leading [M] for a batch of tasks."""

    inner: Rollouts  # that each on-policy inner step collected
    outer: Rollout  # that the adapted policies collected


# Collects a task's episodes with a policy, in simulation, in an evaluation or with a real robot.
Collect = Callable[[Params, jax.Array, Task], Rollout]  # (params, key, task)
