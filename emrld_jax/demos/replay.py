"""Plays demonstrated actions back in the environment."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from emrld_jax.types import Demos, Task
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
    return _replay_all(env, tasks, demos)


@partial(jax.jit, static_argnums=0)
def _replay_all(env: Env, tasks: Task, demos: Demos) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(lambda task, demo: _replay_one(env, task, demo))(tasks, demos)


def _replay_one(env: Env, task: Task, demo: Demos) -> tuple[jax.Array, jax.Array]:
    exists = demo.mask * (jnp.arange(demo.mask.shape[0]) < env.horizon)

    def step(
        carry: tuple[State, jax.Array], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[State, jax.Array], tuple[jax.Array, jax.Array]]:
        state, running = carry
        action, exists = row
        state = env.step(state, action)
        counts = running * exists
        figures = (counts * state.reward, counts * state.metrics["success"])
        return (state, running * (1.0 - state.done)), figures

    start = (env.reset_to(demo.obs[0], task), jnp.ones(()))
    _, (rewards, success) = jax.lax.scan(step, start, (demo.action, exists))
    return jnp.sum(rewards), jnp.any(success > 0)
