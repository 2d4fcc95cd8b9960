"""Trajectories of an expert, and whether they have the quality that demonstrations claim."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from emrld_jax.demos.archive import DemoError
from emrld_jax.demos.claims import Played, claim
from emrld_jax.demos.expert import conditioned
from emrld_jax.policy import Policy, mean_action
from emrld_jax.sampling.rollouts import episode, episode_successes
from emrld_jax.types import Demos, Params, Task
from envs_jax import Env, make

CANDIDATES = 64  # episodes a task, of which the first that fits is kept


@partial(jax.jit, static_argnums=(0, 1, 5))
def play(
    name: str, policy: Policy, params: Params, key: jax.Array, tasks: Task, num_episodes: int
) -> Played:
    """Episodes of an expert for the tasks [M] of an environment; fields [M, num_episodes, ..]."""
    env = make(name, reward="dense")

    def of_task(key: jax.Array, task: Task) -> Played:
        own = conditioned(policy, task)
        keys = jax.random.split(key, num_episodes)
        steps = jax.vmap(lambda k: episode(env, own, params, k, task))(keys)
        bounded = jax.vmap(jax.vmap(lambda a: env.to_policy(env.to_physical(a))))(steps.action)
        tasks = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_episodes, *x.shape)), task)
        demos = Demos(steps.obs, bounded, steps.mask)
        return Played(demos, steps.reward, episode_successes(steps), tasks)

    return jax.vmap(of_task)(jax.random.split(key, jax.tree.leaves(tasks)[0].shape[0]), tasks)


def first_that_fits(
    name: str, quality: str, policy: Policy, params: Params, key: jax.Array, tasks: Task
) -> Played:
    """Each task's first episode that has the quality when cut off; fields [M, ..].

    Optimal ones are played with the mean action, all others with the policy's noise.
    """
    env = make(name)
    played_by = mean_action(policy) if quality == "optimal" else policy
    cut = _each(claim(env, quality).cut, play(name, played_by, params, key, tasks, CANDIDATES))
    first = jnp.argmax(has_quality(env, quality, cut), axis=1)
    return jax.tree.map(lambda x: jax.vmap(lambda row, i: row[i])(x, first), cut)


def has_quality(env: Env, quality: str, played: Played) -> jax.Array:
    """Whether episodes are what they claim, [..] bool."""
    return _each(claim(env, quality).holds, played)


def check_quality(env: Env, quality: str, played: Played) -> None:
    """Refuses demonstrations that are not what they claim; fields of `played` are [M, ..].

    Raises:
        DemoError: tells how many are at fault, and about the first.
    """
    good, claimed = has_quality(env, quality, played), claim(env, quality)
    if bool(good.all()):
        return
    row = int(jnp.argmin(good))
    found = claimed.tell(jax.tree.map(lambda x: x[row], played))
    raise DemoError(
        f"{env.name}: {int((~good).sum())} of {len(good)} demonstrations are not {quality}: each "
        f"must {claimed.words}, but number {row} (from 0; training tasks, then held-out ones) "
        f"{found}; train the expert longer (dense_iterations) or with another seed"
    )


def _each(function: Callable[[Played], Any], played: Played) -> Any:
    """What a function of one episode makes of each."""
    for _ in range(played.success.ndim):
        function = jax.vmap(function)
    return function(played)
