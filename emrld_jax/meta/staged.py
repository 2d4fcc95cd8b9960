"""Adaptation whose episodes come from elsewhere, one inner step after another.

A robot collects for hours what a simulation collects within a call. So adaptation stops where it
needs episodes that are not there yet, and is done again from its start once they are: the same
`MetaLearner.adapt`, whichever algorithm it is of.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax

from emrld_jax.meta.learner import MetaLearner
from emrld_jax.types import Demos, Params, Rollout, Task


class Staged(NamedTuple):
    """How far adaptation has come."""

    params: Params  # adapted, or of the policy that collects the next inner step's episodes
    adapted: bool
    used: int  # rollouts that it has used


class _NeedEpisodesError(Exception):
    """Adaptation cannot go on without episodes of these parameters' policy."""

    def __init__(self, params: Params) -> None:
        super().__init__("there are no more episodes")
        self.params = params


def adapt_with(
    learner: MetaLearner, params: Params, task: Task, demos: Demos, rollouts: Sequence[Rollout]
) -> Staged:
    """Adapts to one task with the episodes that there are. Not to be traced.

    Args:
        learner: the algorithm.
        params: the meta-parameters.
        task: whose episodes they are.
        demos: its demonstration, [N, ..].
        rollouts: one for each inner step that collects, in order: each was collected by the policy
            that this function returned for those before it.

    Returns:
        The adapted parameters once every step has its episodes, and until then those that collect
        the next ones: without any rollouts the meta-parameters, or warm-started ones.

    Raises:
        ValueError: more rollouts than inner steps that collect.
    """
    used = 0

    def collect(params: Params, key: jax.Array, task: Task) -> Rollout:
        nonlocal used
        if used == len(rollouts):
            raise _NeedEpisodesError(params)
        used += 1
        return rollouts[used - 1]

    try:
        # of the key's numbers nothing is made: they are for collecting
        adapted = learner.adapt(params, jax.random.key(0), task, demos, collect)
    except _NeedEpisodesError as need:
        return Staged(need.params, False, used)
    if used < len(rollouts):
        raise ValueError(f"adaptation takes the episodes of {used} steps, not of {len(rollouts)}")
    return Staged(adapted.params, True, used)
