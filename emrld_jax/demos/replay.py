"""Plays demonstrated actions back in the environment."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from emrld_jax.types import Demos, Played, Task
from envs_jax import Env, State


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
    played = replayed(env, tasks, demos)
    rewards, success = played.mask * played.reward, played.mask * played.success
    return jnp.sum(rewards, axis=1), jnp.any(success > 0, axis=1)


@partial(jax.jit, static_argnums=0)
def replayed(env: Env, tasks: Task, demos: Demos) -> Played:
    """The steps that `replay` sums, [M, ..]; M is at least 1."""
    return jax.vmap(lambda task, demo: _replay_one(env, task, demo))(tasks, demos)


def _replay_one(env: Env, task: Task, demo: Demos) -> Played:
    exists = demo.mask * (jnp.arange(demo.mask.shape[0]) < env.horizon)

    def step(
        carry: tuple[State, jax.Array], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[State, jax.Array], Played]:
        state, running = carry
        action, exists = row
        following = env.step(state, action)
        outcome = (following.reward, following.done, following.metrics["success"])
        played = Played(state.obs, action, *outcome, running * exists, following.obs)
        return (following, running * (1.0 - following.done)), played

    start = (env.reset_to(demo.obs[0], task), jnp.ones(()))
    _, played = jax.lax.scan(step, start, (demo.action, exists))
    last = jnp.maximum(jnp.sum(played.mask).astype(int) - 1, 0)
    return played._replace(last_obs=played.last_obs[last])
