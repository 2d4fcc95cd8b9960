"""The demonstration file: versioned, pickle-free, checked as a whole (docs/demonstrations.md)."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata as packages
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from emrld_jax.demos.archive import MAX_BYTES, DemoError, read_npz
from emrld_jax.demos.checks import SPLITS, check_arrays, task_fields
from emrld_jax.types import Demos, Task
from envs_jax import Env

FORMAT = "emrld-demos"
VERSION = 1
STARTS = ("reset", "anywhere")


class DemoSet(NamedTuple):
    """One demonstration for each of M tasks."""

    demos: Demos  # [M, N, ..]
    tasks: Task  # the environment's task type, [M, ..]
    returns: Any  # [M], undiscounted return of the demonstration
    success: Any  # [M], bool: it reached the goal


@dataclass(frozen=True)
class DemoFile:
    """What a demonstration file says.

    Attributes:
        environment: name of the environment.
        quality: "optimal", "suboptimal" or a label of one's own.
        train: demonstrations of the training tasks.
        test: demonstrations of the held-out tasks; M may be 0.
        provenance: where the demonstrations come from, as JSON values.
        start: "reset" if every demonstration begins where the environment does, else "anywhere".
    """

    environment: str
    quality: str
    train: DemoSet
    test: DemoSet
    provenance: dict[str, Any] = field(default_factory=dict)
    start: str = "reset"


def provenance(**entries: Any) -> dict[str, Any]:
    """A provenance record: `entries` with the time (UTC) and the version of this package."""
    try:
        version = packages.version("emrld-jax")
    except packages.PackageNotFoundError:
        version = "unknown"
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return {"created": created, "emrld_jax": version, **entries}


def empty(env: Env) -> DemoSet:
    """A split without demonstrations (M = 0, N = 1)."""
    fields = {name: jnp.zeros((0, *shape)) for name, shape in task_fields(env).items()}
    demos = Demos(
        jnp.zeros((0, 1, env.observation_size)),
        jnp.zeros((0, 1, env.action_size)),
        jnp.zeros((0, 1)),
    )
    return DemoSet(demos, _task_type(env)(**fields), jnp.zeros(0), jnp.zeros(0, bool))


def save(path: str | Path, file: DemoFile, env: Env) -> None:
    """Writes a demonstration file, all of it or nothing; steps outside the mask become zeros.

    Raises:
        DemoError: `load` would refuse it.
    """
    path = Path(path)
    about = _metadata(file, env)
    try:
        text = np.array(json.dumps(about, sort_keys=True))
    except (TypeError, ValueError) as error:
        raise DemoError(f"{path}: provenance holds what JSON cannot ({error})") from error
    arrays = {**_split_arrays(path, "train", file.train), **_split_arrays(path, "test", file.test)}
    _check_metadata(path, about, env)
    check_arrays(path, arrays, env, from_reset=file.start == "reset")
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, metadata=text, **arrays)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def load(path: str | Path, env: Env) -> DemoFile:
    """Reads a demonstration file for `env` and refuses it whole if anything in it is wrong.

    The tasks need not be the environment's own; see `check_tasks`.

    Raises:
        DemoError: names the file, the key, what was found and what is allowed.
    """
    path = Path(path)
    arrays = read_npz(path, MAX_BYTES)
    about = _read_metadata(path, arrays.pop("metadata", None))
    _check_metadata(path, about, env)
    check_arrays(path, arrays, env, from_reset=about["start"] == "reset")
    train, test = (_demo_set(arrays, split, env) for split in SPLITS)
    return DemoFile(
        about["environment"], about["quality"], train, test, about["provenance"], about["start"]
    )


def check_tasks(
    file: DemoFile, env: Env, tolerance: float = 1e-4, splits: Sequence[str] = SPLITS
) -> None:
    """Refuses demonstrations whose tasks are not the environment's own, row by row.

    Args:
        file: what `load` returned.
        env: its `train_tasks()` and `test_tasks()` are the ones expected.
        tolerance: largest difference of a task's numbers, in their units.
        splits: which splits to check; `("train",)` for imported files, which have no test split.

    Raises:
        DemoError: the number or the values of the tasks differ.
    """
    for split in splits:
        expected = getattr(env, f"{split}_tasks")()
        _check_rows(split, getattr(file, split).tasks, expected, env.name, tolerance)


def check_same_tasks(file: DemoFile, other: DemoFile, named: str, tolerance: float = 1e-4) -> None:
    """Refuses demonstrations whose training tasks are not those of another file, row by row.

    Args:
        file: what is checked.
        other: what has the tasks that are expected.
        named: what the other is called in messages.
        tolerance: largest difference of a task's numbers, in their units.

    Raises:
        DemoError: the number or the values of the tasks differ.
    """
    _check_rows("train", file.train.tasks, other.train.tasks, named, tolerance)


def _check_rows(split: str, found: Task, expected: Task, owner: str, tolerance: float) -> None:
    for name, value in expected._asdict().items():
        want, have = np.asarray(value), np.asarray(getattr(found, name))
        if len(want) != len(have):
            raise DemoError(
                f"{split}/{name}: demonstrations of {len(have)} tasks, but {owner} has "
                f"{len(want)} {split} tasks"
            )
        wrong = np.abs(want - have).reshape(len(want), -1).max(axis=1) > tolerance
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DemoError(
                f"{split}/{name}[{row}] is {have[row]}, but {owner}'s {split} task is {want[row]}"
            )


def _task_type(env: Env) -> Any:
    return type(env.train_tasks())


def _described(env: Env) -> dict[str, Any]:
    """What the file must say about the environment."""
    names = ("observation_names", "observation_units", "action_names", "action_units")
    return {"action_space": "policy", **{name: list(getattr(env, name)) for name in names}}


def _metadata(file: DemoFile, env: Env) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "environment": file.environment,
        "quality": file.quality,
        "start": file.start,
        "provenance": file.provenance,
        **_described(env),
    }


def _read_metadata(path: Path, text: np.ndarray | None) -> dict[str, Any]:
    if text is None or text.shape != () or text.dtype.kind != "U":
        raise DemoError(f"{path}: no 'metadata' string, so not an {FORMAT} file")
    try:
        about = json.loads(str(text))
    except (ValueError, RecursionError) as error:
        raise DemoError(f"{path}: metadata is not JSON ({error})") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise DemoError(f"{path}: metadata does not say format {FORMAT!r}")
    return about


def _check_metadata(path: Path, about: dict[str, Any], env: Env) -> None:
    if about.get("version") != VERSION:
        raise DemoError(
            f"{path}: version {about.get('version')!r} of the format; this emrld_jax reads "
            f"version {VERSION} (a newer file needs a newer emrld_jax)"
        )
    if about.get("environment") != env.name:
        raise DemoError(
            f"{path}: demonstrations of {about.get('environment')} cannot teach {env.name}"
        )
    for key, expected in _described(env).items():
        if about.get(key) != expected:
            raise DemoError(f"{path}: {key} is {about.get(key)!r}; {env.name} has {expected!r}")
    if about.get("start") not in STARTS:
        raise DemoError(f"{path}: start is {about.get('start')!r}; allowed: {', '.join(STARTS)}")
    if not isinstance(about.get("quality"), str) or not about["quality"]:
        raise DemoError(f"{path}: quality is {about.get('quality')!r}; a label such as 'optimal'")
    if not isinstance(about.get("provenance"), dict):
        raise DemoError(f"{path}: provenance is not a dictionary")


def _split_arrays(path: Path, split: str, part: DemoSet) -> dict[str, np.ndarray]:
    mask = np.asarray(part.demos.mask) > 0
    length = mask.sum(axis=1).astype(np.int32)
    if not np.array_equal(mask, np.arange(mask.shape[1]) < length[:, None]):
        raise DemoError(f"{path}: {split}: a mask must be 1 up to the last step and 0 after it")
    arrays = {
        "obs": np.where(mask[..., None], np.asarray(part.demos.obs, np.float32), 0),
        "action": np.where(mask[..., None], np.asarray(part.demos.action, np.float32), 0),
        "length": length,
        "return": np.asarray(part.returns, np.float32),
        "success": np.asarray(part.success, bool),
        **{k: np.asarray(v, np.float32) for k, v in part.tasks._asdict().items()},
    }
    return {f"{split}/{key}": value for key, value in arrays.items()}


def _demo_set(arrays: dict[str, np.ndarray], split: str, env: Env) -> DemoSet:
    part = {
        key.removeprefix(f"{split}/"): jnp.asarray(value)
        for key, value in arrays.items()
        if key.startswith(f"{split}/")
    }
    steps = jnp.arange(part["obs"].shape[1])
    mask = (steps[None] < part["length"][:, None]).astype(jnp.float32)
    tasks = _task_type(env)(**{name: part[name] for name in task_fields(env)})
    return DemoSet(Demos(part["obs"], part["action"], mask), tasks, part["return"], part["success"])
