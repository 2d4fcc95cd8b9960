"""Plays demonstrated actions back in the environment."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.types import Demos, Task, Trajectory
from envs_jax import Env, State


class Replay(NamedTuple):
    """What the demonstrated actions did, [M, N, ..], and where each demonstration then was."""

    steps: Trajectory  # mask 1 up to the demonstration's last step, an ending step or the horizon
    last_obs: jax.Array  # [M, O], after the last step with mask 1


def replay(env: Env, tasks: Task, demos: Demos) -> tuple[jax.Array, jax.Array]:
    """What the demonstrated actions achieve, open loop from the first demonstrated observation.

    Args:
        env: its `reward` (sparse or dense) decides what is returned.
        tasks: the environment's task type, [M, ..].
        demos: [M, N, ..]; steps after the episode's end or its horizon count for nothing.

    Returns:
        Undiscounted return [M], and whether the goal was reached [M], bool.
    """
    if demos.obs.shape[0] == 0:
        return jnp.zeros(0), jnp.zeros(0, bool)
    steps = replayed(env, tasks, demos).steps
    rewards, success = steps.mask * steps.reward, steps.mask * steps.success
    return jnp.sum(rewards, axis=1), jnp.any(success > 0, axis=1)


@partial(jax.jit, static_argnums=0)
def replayed(env: Env, tasks: Task, demos: Demos) -> Replay:
    """The steps that `replay` sums, as the environment makes them; M is at least 1."""
    return jax.vmap(lambda task, demo: _replay_one(env, task, demo))(tasks, demos)


def _replay_one(env: Env, task: Task, demo: Demos) -> Replay:
    exists = demo.mask * (jnp.arange(demo.mask.shape[0]) < env.horizon)

    def step(
        carry: tuple[State, jax.Array], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[State, jax.Array], tuple[Trajectory, jax.Array]]:
        state, running = carry
        action, exists = row
        following = env.step(state, action)
        outcome = (following.metrics["success"], following.metrics["diverged"], running * exists)
        record = Trajectory(state.obs, action, following.reward, following.done, *outcome)
        return (following, running * (1.0 - following.done)), (record, following.obs)

    start = (env.reset_to(demo.obs[0], task), jnp.ones(()))
    _, (steps, following) = jax.lax.scan(step, start, (demo.action, exists))
    last = jnp.maximum(jnp.sum(steps.mask).astype(int) - 1, 0)
    return Replay(steps, following[last])
