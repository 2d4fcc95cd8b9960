"""Tasks as users of Gymnasium name them: by number, or by what they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from operator import index
from typing import Any, NamedTuple

import jax
import numpy as np

from envs_jax import Env

SPLITS = ("train", "test")
SEEDS = 2**32  # of an episode's key


def tasks_of(env: Env, split: str) -> Any:
    """All tasks of a split: the environment's NamedTuple of NumPy arrays, [M, ..] float32.

    Raises:
        ValueError: there is no such split.
    """
    if split not in SPLITS:
        raise ValueError(f"split={split!r} is unknown; choose one of: {', '.join(SPLITS)}")
    hashable: Any = env
    return _tasks_of(hashable, split)


@lru_cache(maxsize=32)
def _tasks_of(env: Env, split: str) -> Any:
    tasks = env.train_tasks() if split == "train" else env.test_tasks()
    return jax.tree.map(lambda x: np.asarray(x, np.float32), tasks)


def count(tasks: Any) -> int:
    """How many tasks a batch of them holds."""
    return len(tasks[0])


def take(tasks: Any, number: int) -> Any:
    """One task of a batch."""
    return jax.tree.map(lambda x: x[number], tasks)


def blank(env: Env, size: int) -> Any:
    """Room for so many tasks, all zeros."""
    return jax.tree.map(lambda x: np.zeros((size, *x.shape[1:]), x.dtype), tasks_of(env, "train"))


def read_task(env: Env, given: Any, split: str) -> Any:
    """A task that somebody named.

    Args:
        env: the environment.
        given: a number in the split; or what the task is: the environment's NamedTuple, or a
            mapping with its fields.
        split: "train" or "test".

    Returns:
        The NamedTuple of float32 arrays.

    Raises:
        ValueError: there is no such task; says what is allowed.
    """
    tasks = tasks_of(env, split)
    if isinstance(given, Mapping):
        return _named(env, dict(given), tasks)
    if isinstance(given, tuple) and hasattr(given, "_asdict"):
        return _named(env, given._asdict(), tasks)
    try:
        number = index(given)
    except TypeError as error:
        fields = ", ".join(tasks._fields)
        raise ValueError(
            f"task={given!r} is neither the number of a task nor a mapping with {fields}"
        ) from error
    if not 0 <= number < count(tasks):
        last = count(tasks) - 1
        raise ValueError(f"task={number} is not allowed: {env.name} has {split} tasks 0 to {last}")
    return take(tasks, number)


def _named(env: Env, given: dict[str, Any], tasks: Any) -> Any:
    shapes = {name: value.shape[1:] for name, value in tasks._asdict().items()}
    if set(given) != set(shapes):
        raise ValueError(
            f"a task of {env.name} has {', '.join(shapes)}; given were {', '.join(given) or 'none'}"
        )
    return type(tasks)(*(_numbers(name, given[name], shapes[name]) for name in tasks._fields))


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        numbers = np.asarray(value, np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"task {name}={value!r} is no number, nor a list of some") from error
    if numbers.shape != shape or not np.isfinite(numbers).all():
        what = f"{shape[0]} finite numbers" if shape else "a finite number"
        raise ValueError(f"task {name}={value!r} is not allowed: it must be {what}")
    if name == "residual_angular_velocity" and abs(numbers) > math.pi:
        raise ValueError(f"task {name}={value!r} is not allowed: at most half a turn a step")
    return numbers


class Start(NamedTuple):
    """What an episode begins with."""

    task: Any  # the environment's NamedTuple
    seed: np.uint32  # of its key


class TaskChoice:
    """Which task an episode has.

    Args:
        env: the environment.
        split: whose tasks are meant, "train" or "test".
        task: of all episodes, as `read_task` takes it; None: each has a random one of the split.

    Raises:
        ValueError: there is no such split or task.
    """

    def __init__(self, env: Env, split: str, task: Any) -> None:
        tasks_of(env, split)
        self._env, self._split = env, split
        self._task = None if task is None else read_task(env, task, split)

    def draw(self, generator: np.random.Generator, options: Mapping[str, Any]) -> Start:
        """What an episode begins with.

        Args:
            generator: of the environment's randomness. As much is drawn whatever the task is, so
                that equal seeds begin equally.
            options: `task` and `split`, of this episode alone.

        Raises:
            ValueError: there is no such split or task.
        """
        split = options.get("split") or self._split
        tasks = tasks_of(self._env, split)
        number = int(generator.integers(count(tasks)))
        seed = np.uint32(generator.integers(SEEDS))
        if options.get("task") is not None:
            return Start(read_task(self._env, options["task"], split), seed)
        if self._task is not None and "split" not in options:
            return Start(self._task, seed)
        return Start(take(tasks, number), seed)
