"""Trajectories of an expert, and whether they have the quality that demonstrations claim."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.demos.archive import DemoError
from emrld_jax.demos.expert import conditioned
from emrld_jax.policy import Policy, mean_action
from emrld_jax.sampling.rollouts import episode, episode_successes
from emrld_jax.types import Demos, Params, Task
from envs_jax import Env, make

QUALITIES = ("optimal", "suboptimal")
CANDIDATES = 64  # noisy episodes a task, of which the first that fits is kept
# The longest a sub-optimal demonstration may be, about 1.5 times the straight way at full speed; a
# longer one wanders too much to demonstrate anything.
MAX_NOISY_STEPS = {"point2d": 30, "two_wheeled": 31, "two_wheeled_drift": 45}
# Where a sub-optimal Point2D demonstration may end: outside the success radius, yet near (m). It
# stops at the first step closer than the middle.
NEAR_MISS = (0.1, 0.4)


class Played(NamedTuple):
    """Episodes with how far from the goal each step ended."""

    demos: Demos  # [.., T, ..], actions as the environment bounds them
    distance: jax.Array  # [.., T], m
    success: jax.Array  # [..], 1 if the episode reached the goal


@partial(jax.jit, static_argnums=(0, 1, 5))
def play(
    name: str, policy: Policy, params: Params, key: jax.Array, tasks: Task, num_episodes: int
) -> Played:
    """Episodes of an expert for the tasks [M] of an environment; fields [M, num_episodes, ..]."""
    env = make(name, reward="dense")  # whose reward is minus the distance

    def of_task(key: jax.Array, task: Task) -> Played:
        own = conditioned(policy, task)
        keys = jax.random.split(key, num_episodes)
        steps = jax.vmap(lambda k: episode(env, own, params, k, task))(keys)
        bounded = jax.vmap(jax.vmap(lambda a: env.to_policy(env.to_physical(a))))(steps.action)
        demos = Demos(steps.obs, bounded, steps.mask)
        return Played(demos, -steps.reward, episode_successes(steps))

    return jax.vmap(of_task)(jax.random.split(key, jax.tree.leaves(tasks)[0].shape[0]), tasks)


def best_try(name: str, policy: Policy, params: Params, tasks: Task) -> Played:
    """The mean action's episode for each task; fields [M, ..]."""
    played = play(name, mean_action(policy), params, jax.random.key(0), tasks, 1)
    return jax.tree.map(lambda x: x[:, 0], played)


def near_misses(name: str, policy: Policy, params: Params, key: jax.Array, tasks: Task) -> Played:
    """Each task's first noisy episode that may pass as sub-optimal when cut off; fields [M, ..]."""
    env = make(name)
    noisy = play(name, policy, params, key, tasks, CANDIDATES)
    cut = jax.vmap(jax.vmap(lambda episode: _cut(env, episode)))(noisy)
    fits = has_quality(env, "suboptimal", cut)
    first = jnp.argmax(fits, axis=1)
    return jax.tree.map(lambda x: jax.vmap(lambda row, i: row[i])(x, first), cut)


def has_quality(env: Env, quality: str, played: Played) -> jax.Array:
    """Whether episodes are what they claim, [..] bool.

    Optimal ones reach the goal. Sub-optimal ones are short and end in the reward zone; on Point2D,
    whose zone is small, they end near the goal and do not reach it.
    """
    reached, distance = played.success > 0, end_distance(played)
    if quality == "optimal":
        return reached
    short = jnp.sum(played.demos.mask, axis=-1) <= MAX_NOISY_STEPS[env.name]
    if env.name == "point2d":
        return short & ~reached & (distance >= NEAR_MISS[0]) & (distance <= NEAR_MISS[1])
    return short & (distance <= env.reward_radius)


def check_quality(env: Env, quality: str, played: Played) -> None:
    """Refuses demonstrations that are not what they claim; fields of `played` are [M, ..].

    Raises:
        DemoError: tells how many are at fault, and about the first.
    """
    good = has_quality(env, quality, played)
    if bool(good.all()):
        return
    row = int(jnp.argmin(good))
    steps, distance = played.demos.mask[row].sum(), end_distance(played)[row]
    claims = {
        "optimal": "reach its goal",
        "suboptimal": f"in at most {MAX_NOISY_STEPS[env.name]} steps come "
        + (
            f"{NEAR_MISS[0]} to {NEAR_MISS[1]} m near its goal and not reach it"
            if env.name == "point2d"
            else f"within {env.reward_radius} m of its goal"
        ),
    }
    raise DemoError(
        f"{env.name}: {int((~good).sum())} of {len(good)} demonstrations are not {quality}: each "
        f"must {claims[quality]}, but that of task {row} ends after {int(steps)} steps "
        f"{float(distance):.3f} m away (reached: {bool(played.success[row] > 0)}); train the "
        "expert longer or with another seed"
    )


def end_distance(played: Played) -> jax.Array:
    """How far from the goal episodes ended, [..] in m."""
    last = jnp.sum(played.demos.mask, axis=-1).astype(jnp.int32) - 1
    return jnp.take_along_axis(played.distance, last[..., None], axis=-1)[..., 0]


def _cut(env: Env, noisy: Played) -> Played:
    """One episode up to where it came nearest to the goal; on Point2D, to where it came near."""
    distance = jnp.where(noisy.demos.mask > 0, noisy.distance, jnp.inf)
    last = jnp.argmin(distance)
    if env.name == "point2d":
        near = distance <= 0.5 * sum(NEAR_MISS)
        last = jnp.where(jnp.any(near), jnp.argmax(near), last)
    mask = noisy.demos.mask * (jnp.arange(env.horizon) <= last)
    whole = jnp.sum(mask) == jnp.sum(noisy.demos.mask)
    return Played(noisy.demos._replace(mask=mask), noisy.distance, noisy.success * whole)
