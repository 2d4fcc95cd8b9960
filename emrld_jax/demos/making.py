"""Demonstrations made by an expert: trained, played back once a task, and checked for the quality they claim."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emrld_jax.demos.archive import DemoError
from emrld_jax.demos.expert import conditioned, expert, mean_action
from emrld_jax.demos.format import DemoFile, DemoSet
from emrld_jax.demos.replay import replay
from emrld_jax.meta.trpo import Metrics
from emrld_jax.policy import Policy
from emrld_jax.sampling.rollouts import episode, episode_successes
from emrld_jax.types import Demos, Params, Task
from envs_jax import Env, make

QUALITIES = ("optimal", "suboptimal")
CANDIDATES = 256  # noisy episodes a task, of which the first that fits is kept
MAX_NOISY_STEPS = 50  # a longer one wanders too much to demonstrate anything
# Where a sub-optimal Point2D demonstration may end: outside the success radius, yet near (m). It stops at
# the first step closer than the middle.
NEAR_MISS = (0.1, 0.4)

Report = Callable[[str, int, Metrics], None]  # (phase, iteration, metrics)


class Training(NamedTuple):
    """How many iterations an expert trains on each reward; a sub-optimal one stops when it comes near."""

    dense_iterations: int
    sparse_iterations: int


class Played(NamedTuple):
    """Episodes with how far from the goal each step ended."""

    demos: Demos  # [.., T, ..], actions as the environment bounds them
    distance: jax.Array  # [.., T], m
    success: jax.Array  # [..], whether the episode reached the goal


def make_demos(name: str, quality: str, seed: int, training: Training, report: Report) -> DemoFile:
    """Trains an expert for all tasks of an environment and takes one trajectory a task from it.

    Args:
        name: of the environment.
        quality: "optimal": the mean action of an expert that reaches every goal;
            "suboptimal": noisy actions of an expert that stopped training early, cut off where they
            came nearest to the goal.
        seed: of all random numbers.
        training: how long the expert trains.
        report: told after each iteration.

    Raises:
        DemoError: the demonstrations have not the quality that they claim.
    """
    env = make(name)
    train, test = env.train_tasks(), env.test_tasks()
    tasks = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), train, test)
    key, play_key = jax.random.split(jax.random.key(seed))
    policy, params = train_expert(name, tasks, quality, key, training, report)
    if quality == "optimal":
        played = jax.tree.map(lambda x: x[:, 0], play(name, mean_action(policy), params, play_key, tasks, 1))
    else:
        noisy = play(name, policy, params, play_key, tasks, CANDIDATES)
        played = jax.vmap(lambda p: near_miss(env, p))(noisy)
    check_quality(env, quality, played)
    return _as_file(env, quality, train, played)


def train_expert(
    name: str, tasks: Task, quality: str, key: jax.Array, training: Training, report: Report
) -> tuple[Policy, Params]:
    """An expert of this quality for the tasks [M]: its policy and parameters."""
    dense, sparse = (expert(make(name, reward=reward)) for reward in ("dense", "sparse"))
    init_key, dense_key, sparse_key = jax.random.split(key, 3)
    state = dense.init(init_key)
    for i in range(training.dense_iterations):
        if quality == "suboptimal" and _comes_near(name, dense.policy, state.policy, tasks):
            return dense.policy, state.policy
        state, metrics = dense.update(state, jax.random.fold_in(dense_key, i), tasks)
        report("dense", i + 1, metrics)
    for i in range(training.sparse_iterations):
        state, metrics = sparse.update(state, jax.random.fold_in(sparse_key, i), tasks)
        report("sparse", i + 1, metrics)
    return sparse.policy, state.policy


@partial(jax.jit, static_argnums=(0, 1, 5))
def play(
    name: str, policy: Policy, params: Params, key: jax.Array, tasks: Task, num_episodes: int
) -> Played:
    """Episodes of an expert for the tasks [M]; fields [M, num_episodes, ..]."""
    env = make(name, reward="dense")  # whose reward is minus the distance

    def of_task(key: jax.Array, task: Task) -> Played:
        own = conditioned(policy, task)
        keys = jax.random.split(key, num_episodes)
        steps = jax.vmap(lambda k: episode(env, own, params, k, task))(keys)
        bounded = jax.vmap(jax.vmap(lambda a: env.to_policy(env.to_physical(a))))(steps.action)
        return Played(Demos(steps.obs, bounded, steps.mask), -steps.reward, episode_successes(steps))

    return jax.vmap(of_task)(jax.random.split(key, jax.tree.leaves(tasks)[0].shape[0]), tasks)


def near_miss(env: Env, noisy: Played) -> Played:
    """One task's demonstration: of its noisy episodes, [E, T, ..], the first that fits, cut off when near."""
    cut = jax.vmap(lambda p: _cut(env, p))(noisy)
    short = jnp.sum(cut.demos.mask, axis=-1) <= MAX_NOISY_STEPS
    fits = jax.vmap(lambda d, reached: _fits(env, d, reached))(end_distance(cut), cut.success)
    return jax.tree.map(lambda x: x[jnp.argmax(fits & short)], cut)


def _cut(env: Env, noisy: Played) -> Played:
    """One episode up to where it came nearest to the goal, on Point2D to where it first came near."""
    distance = jnp.where(noisy.demos.mask > 0, noisy.distance, jnp.inf)
    last = jnp.argmin(distance)
    if env.name == "point2d":
        near = distance <= 0.5 * sum(NEAR_MISS)
        last = jnp.where(jnp.any(near), jnp.argmax(near), last)
    kept = (jnp.arange(env.horizon) <= last).astype(jnp.float32)
    whole = jnp.sum(noisy.demos.mask * (1 - kept)) == 0
    demos = noisy.demos._replace(mask=noisy.demos.mask * kept)
    return Played(demos, noisy.distance, noisy.success * whole)


def end_distance(played: Played) -> jax.Array:
    """How far from the goal episodes ended, [..] in m."""
    last = jnp.sum(played.demos.mask, axis=-1).astype(jnp.int32) - 1
    return jnp.take_along_axis(played.distance, last[..., None], axis=-1)[..., 0]


def check_quality(env: Env, quality: str, played: Played) -> None:
    """Refuses demonstrations that are not what they claim; played: [M, T, ..].

    Optimal ones reach every goal. Sub-optimal ones end in the reward zone; on Point2D, whose zone is
    small, they end near the goal and reach none.

    Raises:
        DemoError: tells how many are at fault, and the first.
    """
    distance, reached = np.asarray(end_distance(played)), np.asarray(played.success) > 0
    if quality == "optimal":
        good, claim = reached, "reach the goal"
    else:
        good = np.asarray(jax.vmap(lambda d, s: _fits(env, d, s))(distance, played.success))
        claim = "end in the reward zone"
        if env.name == "point2d":
            claim = f"end {NEAR_MISS[0]} to {NEAR_MISS[1]} m from the goal and not reach it"
    if not good.all():
        row = int(good.argmin())
        raise DemoError(
            f"{env.name}: {int((~good).sum())} of {len(good)} demonstrations are not {quality}: each "
            f"must {claim}, but that of task {row} ends {distance[row]:.3f} m from its goal "
            f"(reached: {'yes' if reached[row] else 'no'}); train longer or with another seed"
        )


def _fits(env: Env, distance: jax.Array, reached: jax.Array) -> jax.Array:
    """Whether an episode that ends at this distance may pass as sub-optimal, []."""
    if env.name == "point2d":
        return (distance >= NEAR_MISS[0]) & (distance <= NEAR_MISS[1]) & (reached == 0)
    return distance <= env.reward_radius


def _comes_near(name: str, policy: Policy, params: Params, tasks: Task) -> bool:
    """Whether the mean action comes into the reward zone of every task."""
    env = make(name)
    played = play(name, mean_action(policy), params, jax.random.key(0), tasks, 1)
    distance = jnp.where(played.demos.mask > 0, played.distance, jnp.inf)
    return bool(jnp.all(jnp.min(distance, axis=-1) <= env.reward_radius))


def _as_file(env: Env, quality: str, train: Task, played: Played) -> DemoFile:
    """The demonstrations of the training tasks, which come first, and of the held-out ones."""
    size = jax.tree.leaves(train)[0].shape[0]
    parts = []
    for rows, tasks in ((slice(size), train), (slice(size, None), env.test_tasks())):
        demos = jax.tree.map(lambda x, rows=rows: x[rows], played.demos)
        longest = int(jnp.max(jnp.sum(demos.mask, axis=1)))
        demos = jax.tree.map(lambda x, longest=longest: x[:, :longest], demos)
        parts.append(DemoSet(demos, tasks, *replay(env, tasks, demos)))
    return DemoFile(env.name, quality, *parts)
