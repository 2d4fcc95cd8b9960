"""Demonstrations from an expert: it is trained, and one trajectory a task is taken from it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.demos.archive import DemoError
from emrld_jax.demos.claims import Played
from emrld_jax.demos.expert import Expert, ExpertState, expert
from emrld_jax.demos.format import DemoFile, DemoSet
from emrld_jax.demos.quality import check_quality, first_that_fits, has_quality
from emrld_jax.demos.replay import replay
from emrld_jax.meta.outer import Metrics
from emrld_jax.types import Task
from envs_jax import Env, make


class Standing(NamedTuple):
    """Where the training of an expert stands; all that its rest depends on, but for the keys."""

    state: ExpertState
    iteration: int  # iterations done, on both rewards together


Report = Callable[[str, Standing, Metrics], None]  # (reward, where it stands now, metrics)
Restore = Callable[[Standing], Standing]  # (the start) -> where a training goes on


class Training(NamedTuple):
    """How many iterations an expert trains on each reward, at the most."""

    dense_iterations: int
    sparse_iterations: int
    make_expert: Callable[..., Expert] = expert  # (env)
    try_every: int = 1  # iterations, where it ends as soon as its episodes fit


# the dense reward of these is what they are judged by, so they train on nothing else
RUNNER = partial(expert, num_episodes=20, squash=True, max_kl=0.03, discount=0.97, gae_lambda=0.95)
TRAININGS = {"half_cheetah": Training(500, 0, RUNNER, try_every=10)}


def default_training(name: str) -> Training:
    """How long the expert of an environment trains unless told otherwise."""
    return TRAININGS.get(name, Training(60, 20))


def make_demos(
    name: str,
    quality: str,
    seed: int,
    training: Training,
    report: Report,
    restore: Restore,
) -> DemoFile:
    """Trains an expert for all tasks of an environment and takes one trajectory a task from it.

    Args:
        name: of the environment.
        quality: "optimal": the mean action of a trained expert; "suboptimal": noisy actions of an
            expert that stopped training early, cut off before they achieve anything.
        seed: of all random numbers.
        training: how long the expert trains.
        report: told after each iteration; what it raises ends the training.
        restore: where to go on; if with a training that was stopped, all is as if it was not.

    Raises:
        DemoError: the demonstrations have not the quality that they claim.
    """
    env = make(name)
    train, test = env.train_tasks(), env.test_tasks()
    tasks = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), train, test)
    train_key, play_key = jax.random.split(jax.random.key(seed))
    played_by = after_training if training.sparse_iterations else once_it_fits
    played = played_by(name, quality, tasks, train_key, play_key, training, report, restore)
    check_quality(env, quality, played)
    return _as_file(env, quality, train, test, played)


def after_training(
    name: str,
    quality: str,
    tasks: Task,
    train_key: jax.Array,
    play_key: jax.Array,
    training: Training,
    report: Report,
    restore: Restore,
) -> Played:
    """Trajectories, [M, ..], of an expert trained on the dense and then on the sparse reward."""
    dense, sparse = (
        training.make_expert(make(name, reward=reward)) for reward in ("dense", "sparse")
    )
    init_key, dense_key, sparse_key = jax.random.split(train_key, 3)
    state, done = restore(Standing(dense.init(init_key), 0))
    first = training.dense_iterations
    for i in range(done, first):
        state, metrics = dense.update(state, jax.random.fold_in(dense_key, i), tasks)
        report("dense", Standing(state, i + 1), metrics)
    for i in range(max(done, first), first + training.sparse_iterations):
        state, metrics = sparse.update(state, jax.random.fold_in(sparse_key, i - first), tasks)
        report("sparse", Standing(state, i + 1), metrics)
    return first_that_fits(name, quality, sparse.policy, state.policy, play_key, tasks)


def once_it_fits(
    name: str,
    quality: str,
    tasks: Task,
    train_key: jax.Array,
    play_key: jax.Array,
    training: Training,
    report: Report,
    restore: Restore,
) -> Played:
    """Trajectories, [M, ..], of an expert that stops when every task has one that fits."""
    env = make(name)
    learner = training.make_expert(make(name, reward="dense"))
    init_key, dense_key = jax.random.split(train_key)
    state, done = restore(Standing(learner.init(init_key), 0))
    while True:
        last = done == training.dense_iterations
        if done and (last or done % training.try_every == 0):
            # with the same noise each time: only the expert's progress decides when it is good
            played = first_that_fits(name, quality, learner.policy, state.policy, play_key, tasks)
            if last or bool(has_quality(env, quality, played).all()):
                return played
        state, metrics = learner.update(state, jax.random.fold_in(dense_key, done), tasks)
        done += 1
        report("dense", Standing(state, done), metrics)


def _as_file(env: Env, quality: str, train: Task, test: Task, played: Played) -> DemoFile:
    """The demonstrations of the training tasks, which come first, and of the held-out ones."""
    size = jax.tree.leaves(train)[0].shape[0]

    def part(rows: slice, tasks: Task) -> DemoSet:
        demos = jax.tree.map(lambda x: x[rows], played.demos)
        longest = int(jnp.max(jnp.sum(demos.mask, axis=1)))
        demos = jax.tree.map(lambda x: x[:, :longest], demos)
        returns, success = replay(env, tasks, demos)
        if not jnp.array_equal(success, played.success[rows] > 0):
            raise DemoError(f"{env.name}: replayed demonstrations do not end as they were played")
        return DemoSet(demos, tasks, returns, success)

    return DemoFile(env.name, quality, part(slice(size), train), part(slice(size, None), test))
