"""States that cheetahs of several kinds visit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emrld_jax.demos.expert import Expert, ExpertState, conditioned
from emrld_jax.demos.making import default_training
from envs_jax import make
from envs_jax.half_cheetah import CheetahTask, HalfCheetah


class Visited(NamedTuple):
    """Steps of episodes [E], of T steps each."""

    body: Any  # [E, T, 27], before the action
    action: Any  # [E, T, 6]


def visit(env: HalfCheetah, act: Callable[[Any, Any], Any], key: Any, pitch: float) -> Visited:
    """An episode from a start with this pitch (rad); `act(obs, key)` chooses actions."""
    reset_key, act_key = jax.random.split(key)
    start = env.reset(reset_key, jax.tree.map(lambda x: x[0], env.test_tasks()))
    start = env.reset_to(start.obs.at[env.observation_names.index("pitch")].add(pitch), start.task)

    def step(state: Any, key: Any) -> tuple[Any, Visited]:
        action = env.to_physical(act(state.obs, key))
        return env.step(state, action), Visited(state.pipeline_state.body, action)

    return jax.lax.scan(step, start, jax.random.split(act_key, env.horizon))[1]


def visited_by(
    env: HalfCheetah, trained: Expert, state: ExpertState, episodes: int
) -> dict[str, Visited]:
    """Steps of cheetahs that move at random, that run, and that have fallen on their back."""

    def at_random(obs: Any, key: Any) -> Any:
        return jax.random.normal(key, (6,))

    def running(direction: float, obs: Any, key: Any) -> Any:
        own = conditioned(trained.policy, CheetahTask(jnp.array(direction)))
        gaussian = own.apply(state.policy, obs)
        return gaussian.mean + jnp.exp(gaussian.log_std) * jax.random.normal(key, (6,))

    kinds: dict[str, tuple[Any, float]] = {
        "random actions": (at_random, 0.0),
        "expert, forward": (partial(running, 1.0), 0.0),
        "expert, backward": (partial(running, -1.0), 0.0),
        "fallen on its back": (at_random, np.pi),
    }
    keys = jax.random.split(jax.random.key(1), episodes)
    return {
        kind: jax.device_get(jax.jit(jax.vmap(partial(visit, env, act, pitch=pitch)))(keys))
        for kind, (act, pitch) in kinds.items()
    }


def trained_expert(iterations: int) -> tuple[Expert, ExpertState]:
    """An expert for both directions, by the engine in C."""
    env = make("half_cheetah", reward="dense")
    learner = default_training(env.name).make_expert(env)
    init_key, key = jax.random.split(jax.random.key(0))
    state = learner.init(init_key)
    for i in range(iterations):
        state, metrics = learner.update(state, jax.random.fold_in(key, i), env.train_tasks())
    reached = float(metrics["expert/return"])
    print(f"expert: dense return {reached:.0f} after {iterations} iterations", flush=True)
    return learner, state
