"""What the arrays of a demonstration file must satisfy."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from emrld_jax.demos.archive import DemoError
from envs_jax import Env

SPLITS = ("train", "test")
TOLERANCE = 1e-3  # of actions (policy units) and first observations (their units)

Arrays = dict[str, np.ndarray]


def task_fields(env: Env) -> dict[str, tuple[int, ...]]:
    """Shape of each field of one task of the environment."""
    return {name: np.shape(value)[1:] for name, value in env.train_tasks()._asdict().items()}


def check_arrays(path: Path, arrays: Arrays, env: Env, *, from_reset: bool) -> None:
    """Refuses arrays that are not demonstrations for `env`.

    Args:
        path: named in the messages.
        arrays: by key, "train/obs" and so on.
        env: what they shall teach.
        from_reset: every demonstration must begin where the environment does.

    Raises:
        DemoError: names the file, the key, what was found and what is allowed.
    """
    expected = {f"{split}/{key}" for split in SPLITS for key in _layout(env, 0, 0)}
    for key in sorted(expected - arrays.keys()):
        raise DemoError(f"{path}: {key} is missing")
    for key in sorted(arrays.keys() - expected):
        raise DemoError(f"{path}: {key} is not part of a demonstration file for {env.name}")
    if arrays["train/length"].size == 0:
        raise DemoError(f"{path}: train/length is empty; at least one demonstration is needed")
    for split in SPLITS:
        part = {key: arrays[f"{split}/{key}"] for key in _layout(env, 0, 0)}
        where = f"{path}: {split}"
        _check_shapes(where, part, env)
        _check_numbers(where, part)
        _check_tasks(where, part, env)
        _check_actions(where, part, env)
        if from_reset:
            _check_starts(where, part, env)


def _layout(env: Env, m: int, n: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Type and shape of each array of a split of `m` demonstrations of up to `n` steps."""
    return {
        "obs": ("float32", (m, n, env.observation_size)),
        "action": ("float32", (m, n, env.action_size)),
        "length": ("int32", (m,)),
        "return": ("float32", (m,)),
        "success": ("bool", (m,)),
        **{name: ("float32", (m, *shape)) for name, shape in task_fields(env).items()},
    }


def _check_shapes(where: str, part: Arrays, env: Env) -> None:
    if part["obs"].ndim != 3 or part["obs"].shape[1] < 1:
        raise DemoError(f"{where}/obs has shape {part['obs'].shape}; it must be [M, N, O], N >= 1")
    m, n = part["obs"].shape[:2]
    for key, (dtype, shape) in _layout(env, m, n).items():
        value = part[key]
        if value.dtype != np.dtype(dtype):
            raise DemoError(f"{where}/{key} has type {value.dtype}; it must be {dtype}")
        if value.shape != shape:
            raise DemoError(f"{where}/{key} has shape {value.shape}; it must be {shape}")


def _check_numbers(where: str, part: Arrays) -> None:
    for key, value in part.items():
        if not np.isfinite(value).all():
            raise DemoError(f"{where}/{key} holds numbers that are not finite (NaN or infinity)")
    n, length = part["obs"].shape[1], part["length"]
    wrong = (length < 1) | (length > n)
    if wrong.any():
        row = int(wrong.argmax())
        raise DemoError(f"{where}/length[{row}] is {length[row]}; allowed: 1 to {n}")
    padding = np.arange(n) >= length[:, None]
    for key in ("obs", "action"):
        if part[key][padding].any():
            raise DemoError(f"{where}/{key} is not zero after the end of a demonstration (padding)")


def _check_tasks(where: str, part: Arrays, env: Env) -> None:
    """A task's numbers must lie where the environment's own do, give or take their whole range."""
    for name, own in env.train_tasks()._asdict().items():
        values = np.asarray(own)
        low, high = values.min(axis=0), values.max(axis=0)
        span = np.maximum(high - low, 1e-6)
        wrong = (part[name] < low - span) | (part[name] > high + span)
        if wrong.any():
            row = int(wrong.reshape(len(wrong), -1).any(axis=1).argmax())
            raise DemoError(
                f"{where}/{name}[{row}] is {part[name][row]}, far from any task of {env.name}; "
                f"allowed: {low - span} to {high + span}"
            )


def _check_actions(where: str, part: Arrays, env: Env) -> None:
    """An action must be one that the environment executes as it is."""
    actions = part["action"]
    exists = np.arange(actions.shape[1]) < part["length"][:, None]
    if not exists.any():
        return
    executed = jax.vmap(lambda a: env.to_policy(env.to_physical(a)))(actions[exists])
    error = np.zeros(actions.shape, np.float32)
    error[exists] = np.abs(np.asarray(executed) - actions[exists])
    row, step, _ = np.unravel_index(int(np.argmax(error)), error.shape)
    if np.max(error) > TOLERANCE:
        raise DemoError(
            f"{where}/action[{row}, {step}] is {actions[row, step]}, which {env.name} would bound; "
            "actions must be in policy units, within the environment's bounds (if these are "
            "physical units, convert them: env.to_policy(physical))"
        )


def _check_starts(where: str, part: Arrays, env: Env) -> None:
    """The first observation must be the environment's start, if it has only one."""
    task = jax.tree.map(lambda x: x[0], env.train_tasks())
    start, other = (np.asarray(env.reset(jax.random.key(i), task).obs) for i in range(2))
    if not np.array_equal(start, other):
        return
    wrong = (np.abs(part["obs"][:, 0] - start) > TOLERANCE).any(axis=1)
    if wrong.any():
        row = int(wrong.argmax())
        raise DemoError(
            f"{where}/obs[{row}, 0] is {part['obs'][row, 0]}; {env.name} starts at {start} (a row "
            'pairs the observation before the action with it; start="anywhere" allows other starts)'
        )
