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

CANDIDATES = 64  # noisy episodes a task, of which the first that fits is kept


class Rule(NamedTuple):
    """What a sub-optimal demonstration is in an environment."""

    max_steps: int  # about 1.5 times the straight way at full speed; a longer one wanders
    nearest: float  # m: how near to the goal it may end
    farthest: float  # m: how far from the goal it may end
    may_reach: bool  # whether it may succeed; else it stops once it is near


# Point2D's demonstrations come near and reach nothing; the wheeled ones end in the reward zone.
SUBOPTIMAL = {
    "point2d": Rule(30, 0.1, 0.4, may_reach=False),
    "two_wheeled": Rule(31, 0.0, 0.5, may_reach=True),
    "two_wheeled_drift": Rule(45, 0.0, 0.5, may_reach=True),
}


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

    Optimal ones reach the goal. Sub-optimal ones satisfy the environment's rule.
    """
    reached, distance = played.success > 0, end_distance(played)
    if quality == "optimal":
        return reached
    rule = suboptimal_rule(env)
    short = jnp.sum(played.demos.mask, axis=-1) <= rule.max_steps
    near = (distance >= rule.nearest) & (distance <= rule.farthest)
    return short & near & (rule.may_reach | ~reached)


def suboptimal_rule(env: Env) -> Rule:
    """What a sub-optimal demonstration is in this environment.

    Raises:
        DemoError: nobody has said so yet.
    """
    if env.name not in SUBOPTIMAL:
        raise DemoError(
            f"what suboptimal means is not defined for {env.name}, only for "
            f"{', '.join(SUBOPTIMAL)}; add a Rule in emrld_jax/demos/quality.py"
        )
    return SUBOPTIMAL[env.name]


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
    claim = "reach its goal"
    if quality == "suboptimal":
        rule = suboptimal_rule(env)
        claim = f"end {rule.nearest} to {rule.farthest} m from its goal after at most "
        claim += f"{rule.max_steps} steps" + ("" if rule.may_reach else " and not reach it")
    raise DemoError(
        f"{env.name}: {int((~good).sum())} of {len(good)} demonstrations are not {quality}: each "
        f"must {claim}, but number {row} (from 0; training tasks, then held-out ones) ends after "
        f"{int(steps)} steps {float(distance):.3f} m away (reached: "
        f"{bool(played.success[row] > 0)}); train the expert longer "
        "(dense_iterations) or with another seed"
    )


def end_distance(played: Played) -> jax.Array:
    """How far from the goal episodes ended, [..] in m."""
    last = jnp.sum(played.demos.mask, axis=-1).astype(jnp.int32) - 1
    return jnp.take_along_axis(played.distance, last[..., None], axis=-1)[..., 0]


def _cut(env: Env, noisy: Played) -> Played:
    """One episode up to where it came nearest to the goal, or near if it may not reach it."""
    distance = jnp.where(noisy.demos.mask > 0, noisy.distance, jnp.inf)
    last = jnp.argmin(distance)
    rule = suboptimal_rule(env)
    if not rule.may_reach:
        near = distance <= 0.5 * (rule.nearest + rule.farthest)
        last = jnp.where(jnp.any(near), jnp.argmax(near), last)
    mask = noisy.demos.mask * (jnp.arange(env.horizon) <= last)
    whole = jnp.sum(mask) == jnp.sum(noisy.demos.mask)
    return Played(noisy.demos._replace(mask=mask), noisy.distance, noisy.success * whole)
