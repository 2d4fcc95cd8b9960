"""Imports demonstrations from the paper's released files, and files laid out like them.

Two layouts are read, from a pickle or (the second) an .npz file:
- a dictionary or list of one dictionary for each task: `state` [L, O], `action` [L, A], the task;
- one dictionary of padded arrays: `state` [M, N, O], `action` [M, N, A], `length` [M], and the
  task [M, ..].
Actions are in physical units and may lie outside the bounds, as the expert's network sampled them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from emrld_jax.demos.archive import DemoError, read_npz
from emrld_jax.demos.checks import TOLERANCE, task_fields
from emrld_jax.demos.format import DemoFile, DemoSet, empty, provenance
from emrld_jax.demos.replay import replay
from emrld_jax.demos.unpickle import MAX_ITEMS, count_items, read_pickle
from emrld_jax.types import Demos
from envs_jax import Env

CHAOTIC = ("half_cheetah",)
ALIASES = {
    "obs": ("state", "states", "obs", "observations"),
    "action": ("action", "actions"),
    "goal": ("goal", "goal_loc"),
    "residual_angular_velocity": ("residual_angular_velocity", "residual", "drift"),
    "direction": ("direction",),
}


class Recording(NamedTuple):
    """One demonstration as it was stored."""

    obs: np.ndarray  # [L, O]
    action: np.ndarray  # [L, A], policy units, within the environment's bounds
    task: dict[str, np.ndarray]  # one entry for each field of the environment's task


def import_file(path: str | Path, environment: str, quality: str, command: str = "") -> DemoFile:
    """Demonstrations of the environment's training tasks from a foreign file; `test` stays empty.

    A file whose rows pair the observation *after* an action with it is shifted by one row. The
    first action is then dropped where the observation before it is unknown: it is known only where
    the action leads from the environment's start to the first observation. Returns are those of
    a replay from the first observation, its steps counted from 0.

    Args:
        path: a pickle, or an .npz file of padded arrays.
        environment: one of `envs_jax.names()`.
        quality: label to store, such as "suboptimal".
        command: stored in the provenance.

    Raises:
        DemoError: the file is unsafe, broken or laid out otherwise, or its rows do not follow the
            environment's dynamics.
    """
    path = Path(path)
    if environment not in envs_jax.names():
        raise DemoError(
            f"environment {environment!r} cannot be imported for; allowed: "
            f"{', '.join(envs_jax.names())}"
        )
    if environment in CHAOTIC:
        raise DemoError(
            f"{environment}'s recordings cannot be imported: its contacts are chaotic, and rows of "
            "another version of MuJoCo's do not follow its dynamics closely enough to be checked"
        )
    env = envs_jax.make(environment)
    contents = read_npz(path) if path.suffix == ".npz" else read_pickle(path)
    recordings = [
        _recording(f"{path}: {label}", entry, env) for label, entry in _entries(path, contents)
    ]
    shifted = _is_shifted(path, recordings, env)
    dropped = 0
    if shifted:
        moved = [_shift(f"{path}: demonstration {i}", r, env) for i, r in enumerate(recordings)]
        dropped = sum(len(r.obs) for r in recordings) - sum(len(r.obs) for r in moved)
        recordings = moved
    train = _demo_set(recordings, env)
    about = provenance(
        command=command,
        source=path.name,
        source_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        rows="shifted: paired the observation after the action" if shifted else "as stored",
        dropped_rows=dropped,
        notes="imported; actions bounded as the environment bounds them",
    )
    start = "reset" if all(_starts_at_reset(r, env) for r in recordings) else "anywhere"
    return DemoFile(environment, quality, train, empty(env), about, start)


def _entries(path: Path, contents: Any) -> list[tuple[str, Mapping[str, Any]]]:
    """One labeled dictionary for each demonstration, whichever layout the file has."""
    if isinstance(contents, dict) and "metadata" in contents:
        raise DemoError(f"{path}: is a demonstration file already; use it as demos={path}")
    if isinstance(contents, dict) and any(name in contents for name in ALIASES["obs"]):
        return _unpack(path, contents)
    if isinstance(contents, dict):
        entries = [(f"[{key!r}]", value) for key, value in contents.items()]
    elif isinstance(contents, list | tuple):
        entries = [(f"[{i}]", value) for i, value in enumerate(contents)]
    else:
        raise DemoError(f"{path}: holds a {type(contents).__name__}, not demonstrations")
    if not entries:
        raise DemoError(f"{path}: holds no demonstrations")
    for label, entry in entries:
        if not isinstance(entry, dict):
            raise DemoError(f"{path}: {label} is a {type(entry).__name__}, not a dictionary")
    return entries


def _unpack(path: Path, contents: dict[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Padded arrays -> one dictionary for each demonstration; a single demonstration stays one."""
    values = {k: _numbers(f"{path}: {k}", v) for k, v in contents.items() if _is_known(k)}
    obs, action = (_find(str(path), values, name) for name in ("obs", "action"))
    if obs.ndim == 2:
        return [("the demonstration", contents)]
    length = _numbers(f"{path}: length", contents.get("length", [obs.shape[1]] * len(obs)))
    if obs.ndim != 3 or any(v.ndim == 0 or len(v) != len(obs) for v in (length, *values.values())):
        raise DemoError(f"{path}: its arrays do not all have one entry for each demonstration")
    if action.shape[:2] != obs.shape[:2]:
        raise DemoError(f"{path}: state has shape {obs.shape}, but action {action.shape}")
    if length.ndim != 1 or (length != length.round()).any():
        raise DemoError(f"{path}: length must hold one whole number for each demonstration")
    if len(obs) == 0 or length.min() < 1 or length.max() > obs.shape[1]:
        raise DemoError(f"{path}: length must be 1 to {obs.shape[1]} for each demonstration")
    rows = ALIASES["obs"] + ALIASES["action"]
    return [
        (f"[{i}]", {k: v[i, : int(n)] if k in rows else v[i] for k, v in values.items()})
        for i, n in enumerate(length)
    ]


def _is_known(key: Any) -> bool:
    return any(key in names for names in ALIASES.values())


def _find(where: str, entry: Mapping[str, Any], name: str) -> Any:
    allowed = ALIASES.get(name, (name,))
    for key in allowed:
        if key in entry:
            return entry[key]
    raise DemoError(f"{where} has no {name}; allowed keys: {', '.join(allowed)}")


def _numbers(where: str, value: Any) -> np.ndarray:
    if count_items(value) > MAX_ITEMS:
        raise DemoError(f"{where} holds more than {MAX_ITEMS} numbers, or lists nested too deeply")
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise DemoError(f"{where} is not an array of numbers ({error})") from error
    if not np.isfinite(array).all():
        raise DemoError(f"{where} holds numbers that are not finite (NaN or infinity)")
    return array


def _recording(where: str, entry: Mapping[str, Any], env: Env) -> Recording:
    """One demonstration; its physical actions become bounded policy actions."""
    obs = _numbers(f"{where} state", _find(where, entry, "obs")).astype(np.float32)
    action = _numbers(f"{where} action", _find(where, entry, "action")).astype(np.float32)
    if obs.ndim != 2 or len(obs) < 1 or obs.shape[1] != env.observation_size:
        raise DemoError(f"{where} state has shape {obs.shape}, not [L, {env.observation_size}]")
    if action.shape != (len(obs), env.action_size):
        raise DemoError(
            f"{where} action has shape {action.shape}, not {(len(obs), env.action_size)}"
        )
    task = {}
    for name, shape in task_fields(env).items():
        value = _numbers(f"{where} {name}", _find(where, entry, name)).astype(np.float32)
        if value.size != np.prod(shape, dtype=int):
            raise DemoError(f"{where} {name} has shape {value.shape}, not {shape}")
        task[name] = value.reshape(shape)
    bounded = _of_rows(lambda a: env.to_policy(env.to_physical(env.to_policy(a))), action)
    return Recording(obs, bounded, task)


def _of_rows(function: Callable[..., jax.Array], *rows: np.ndarray) -> np.ndarray:
    """A function of each row, [L, ..]; padded to a power of two, so that few sizes are compiled."""
    count = len(rows[0])
    more = (1 << (count - 1).bit_length()) - count
    padded = (np.pad(r, [(0, more)] + [(0, 0)] * (r.ndim - 1), mode="edge") for r in rows)
    return np.asarray(jax.vmap(function)(*map(jnp.asarray, padded)))[:count]


def _predict(recording: Recording, obs: np.ndarray, action: np.ndarray, env: Env) -> np.ndarray:
    """What the environment observes after each action [L, A] at each observation [L, O]: [L, O]."""
    if len(obs) == 0:
        return obs
    task = type(env.train_tasks())(**recording.task)
    return _of_rows(lambda o, a: env.step(env.reset_to(o, task), a).obs, obs, action)


def _is_shifted(path: Path, recordings: list[Recording], env: Env) -> bool:
    """Whether rows pair the observation after the action with it, by the environment's dynamics."""
    aligned = shifted = 0.0
    for r in recordings:
        for first, error in ((0, "aligned"), (1, "shifted")):
            action = r.action[first : len(r.obs) - 1 + first]
            off = float(np.abs(_predict(r, r.obs[:-1], action, env) - r.obs[1:]).max(initial=0.0))
            if error == "aligned":
                aligned = max(aligned, off)
            else:
                shifted = max(shifted, off)
    if aligned <= TOLERANCE:
        return False
    if shifted <= TOLERANCE:
        return True
    raise DemoError(
        f"{path}: its steps do not follow {env.name}'s dynamics: off by up to {aligned:.3g} as "
        f"stored, {shifted:.3g} shifted by one row; {TOLERANCE:g} is allowed"
    )


def _shift(where: str, r: Recording, env: Env) -> Recording:
    """Pairs each action with the observation before it, if need be without the first action."""
    start = _start(r, env)[None]
    reaches = np.abs(_predict(r, start, r.action[:1], env) - r.obs[:1]).max() <= TOLERANCE
    if reaches:
        return r._replace(obs=np.concatenate([start, r.obs[:-1]]))
    if len(r.obs) < 2:
        raise DemoError(f"{where} has a single action, and the observation before it is unknown")
    return r._replace(obs=r.obs[:-1], action=r.action[1:])


def _start(r: Recording, env: Env) -> np.ndarray:
    task = type(env.train_tasks())(**r.task)
    return np.asarray(env.reset(jax.random.key(0), task).obs)


def _starts_at_reset(r: Recording, env: Env) -> bool:
    return bool((np.abs(r.obs[0] - _start(r, env)) <= TOLERANCE).all())


def _demo_set(recordings: list[Recording], env: Env) -> DemoSet:
    """Pads the recordings to the longest and replays them."""
    longest = max(len(r.obs) for r in recordings)

    def pad(rows: np.ndarray) -> np.ndarray:
        return np.pad(rows, [(0, longest - len(rows))] + [(0, 0)] * (rows.ndim - 1))

    demos = Demos(
        jnp.stack([pad(r.obs) for r in recordings]),
        jnp.stack([pad(r.action) for r in recordings]),
        jnp.stack([pad(np.ones(len(r.obs), np.float32)) for r in recordings]),
    )
    fields = {name: jnp.stack([r.task[name] for r in recordings]) for name in task_fields(env)}
    tasks = type(env.train_tasks())(**fields)
    return DemoSet(demos, tasks, *replay(env, tasks, demos))
