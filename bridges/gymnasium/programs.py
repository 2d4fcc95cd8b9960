"""An environment's pure functions, compiled for Gymnasium, and what is told of their results."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs_jax import Env, State


class Programs(NamedTuple):
    """What is compiled of an environment: physical actions, and seeds in place of keys.

    Batched, all arguments and results have a leading [n].
    """

    reset: Callable[[Any, Any], State]  # seed [] uint32, task -> the start of an episode
    step: Callable[[State, Any], State]  # state, physical action [A] -> one step later


def programs(env: Env, *, batched: bool) -> Programs:
    """The programs of an environment, which equal environments share."""
    hashable: Any = env
    return _programs(hashable, batched)


@lru_cache(maxsize=32)
def _programs(env: Env, batched: bool) -> Programs:

    def reset(seed: jax.Array, task: Any) -> State:
        return env.reset(jax.random.key(seed), task)

    def step(state: State, action: jax.Array) -> State:
        return env.step(state, env.to_policy(action))

    if batched:
        return Programs(jax.jit(jax.vmap(reset)), jax.jit(jax.vmap(step)))
    return Programs(jax.jit(reset), jax.jit(step))


@jax.jit
def replaced(states: State, chosen: jax.Array, others: State) -> State:
    """States [n] of which the chosen ones [n] are those of others."""

    def choose(old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(chosen.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, states, others)


def information(task: Any, metrics: dict[str, Any]) -> dict[str, Any]:
    """What Gymnasium calls info: the task, and figures of the last step.

    Args:
        task: one, or a batch [n].
        metrics: of the environment's State, as NumPy arrays [] or [n].

    Returns:
        `task`, a dict of its fields; `success` and `diverged`, bool; others as floats. Numbers of
        one environment are Python's, of a batch arrays [n]; nothing is shared with the arguments.
    """
    flags = ("success", "diverged")
    told = {name: _told(x, bool if name in flags else float) for name, x in metrics.items()}
    return {"task": {name: _told(x, float) for name, x in task._asdict().items()}, **told}


def last_words(obs: np.ndarray, info: dict[str, Any], ended: np.ndarray) -> dict[str, Any]:
    """What the ended of n episodes ended with, as Gymnasium tells it."""
    last = np.full(len(ended), None, object)
    for i in np.flatnonzero(ended):
        last[i] = obs[i].copy()
    return {
        "final_obs": last,
        "final_info": masked(info, ended),
        "_final_obs": ended.copy(),
        "_final_info": ended.copy(),
    }


def masked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Info [n] of the chosen environments, with Gymnasium's masks: of `x` it is `_x`."""
    told: dict[str, Any] = {}
    for name, value in info.items():
        if isinstance(value, dict):
            told[name] = masked(value, mask)
        else:
            told[name] = value.copy()
            told[name][~mask] = 0
        told[f"_{name}"] = mask.copy()
    return told


def _told(numbers: Any, kind: type) -> Any:
    told: Any = np.array(numbers, kind)
    return told if told.ndim else told.item()
