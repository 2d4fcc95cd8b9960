"""Teleoperated drives as demonstrations for training. (This needs JAX.)"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from bridges.environments import zone
from bridges.messages import BridgeError
from bridges.settings import SettingError
from bridges.task import outcome
from bridges.teleoperation import Drive
from emrld_jax import demos
from emrld_jax.types import Demos
from envs_jax.two_wheeled_drift import TwoWheeledDrift


def environment(name: str) -> Any:
    """The environment of this name, as it is by default."""
    return envs_jax.make(name)


def task(env: Any, drive: Drive, goal: Sequence[float], residual: float | None) -> tuple[Any, str]:
    """The task that a drive demonstrates, and how it was found, for people.

    Raises:
        SettingError: the environment's task is not given, or another one's is.
    """
    if isinstance(env, TwoWheeledDrift):
        if goal:
            raise SettingError("goal is two_wheeled's; two_wheeled_drift's is at (2, 1) m")
        if residual is None:
            raise SettingError(
                "env=two_wheeled_drift needs residual_angular_velocity=RAD, what the robot turned "
                f"by itself each {env.dt:g} s; this drive looks like {_drift(env, drive):.2f}"
            )
        return _of(env, residual), f"task: residual_angular_velocity={residual:g} rad a step"
    if residual is not None:
        raise SettingError("residual_angular_velocity is two_wheeled_drift's; two_wheeled has goal")
    if goal and len(goal) != 2:
        raise SettingError(f"goal={list(goal)} is not allowed: it must be [x,y], in m")
    x, y = goal or [float(v) for v in drive.pose[-1, :2]]
    found = "as given" if goal else "where the drive ended; goal=[x,y] names another"
    return _of(env, [x, y]), f"task: goal=[{x:.3f},{y:.3f}] m, {found}"


def write(out: Path, env: Any, one: Any, drive: Drive, quality: str, bag: Path) -> list[str]:
    """Writes the drive as the demonstration of its task.

    Returns:
        What it is like, in lines.

    Raises:
        BridgeError: the demonstration file would be refused.
    """
    asked = np.asarray(jax.vmap(env.to_policy)(jnp.asarray(drive.action, jnp.float32)))
    executed = jax.vmap(lambda a: env.to_policy(env.to_physical(a)))(jnp.asarray(asked))
    action = np.asarray(executed)
    length, total, success = _judged(env, one, drive.pose)
    shown = Demos(
        jnp.asarray(drive.pose[None, :length], jnp.float32),
        jnp.asarray(action[None, :length]),
        jnp.ones((1, length)),
    )
    tasks = jax.tree.map(lambda x: jnp.asarray(x)[None], one)
    part = demos.DemoSet(shown, tasks, np.array([total]), np.array([success]))
    command = shlex.join(["python", "-m", "bridges.import_bag", *sys.argv[1:]])
    origin = demos.provenance(command=command, bag=str(bag), notes=list(drive.notes))
    file = demos.DemoFile(env.name, quality, part, demos.empty(env), origin)
    report = [
        _clipped(asked[:length], action[:length]),
        _length(drive, length, env),
        f"as driven: return {total:.1f}, {'reached' if success else 'did not reach'} the goal",
        _replayed(env, part, drive.pose[: length + 1]),
    ]
    try:
        demos.save(out, file, env)
    except demos.DemoError as error:
        raise BridgeError(f"the demonstration is refused: {error}") from error
    return report


def _of(env: Any, value: Any) -> Any:
    """The environment's task of this one value."""
    return type(env.train_tasks())(jnp.asarray(value, jnp.float32))


def _drift(env: Any, drive: Drive) -> float:
    """rad a step that the robot turned beside what it was told."""
    return float(np.median(np.diff(drive.pose[:, 2]) - env.dt * drive.action[:, 1]))


def _judged(env: Any, one: Any, pose: np.ndarray) -> tuple[int, float, bool]:
    """Steps up to the episode's end, their return, and success, of the poses as they were."""
    rules, total = zone(env, one), 0.0
    assert rules is not None
    for t, (x, y, _) in enumerate(pose[1:]):
        step = outcome(rules, float(x), float(y), t)
        total += step.reward
        if step.done or t + 1 == env.horizon:
            return t + 1, total, step.success
    return len(pose) - 1, total, False


def _length(drive: Drive, length: int, env: Any) -> str:
    way = np.sum(np.hypot(*np.diff(drive.pose[: length + 1, :2], axis=0).T))
    cut = len(drive.action) - length
    more = f"; {cut} steps after the episode's end were cut off" if cut else ""
    return f"{length} steps of {env.dt:g} s, {way:.2f} m{more}"


def _clipped(asked: np.ndarray, action: np.ndarray) -> str:
    excess = np.abs(asked - action)
    number = int(np.sum(np.max(excess, axis=1) > 1e-4))
    if not number:
        return "actions: all within the environment's bounds"
    return (
        f"actions: {number} of {len(action)} were outside the environment's bounds, by up to "
        f"{np.max(excess):.2f} of a policy's units, and were clipped"
    )


def _replayed(env: Any, part: demos.DemoSet, pose: np.ndarray) -> str:
    """How far the environment's own dynamics lead from where the robot was."""
    played = demos.replayed(env, part.tasks, part.demos)
    returns, success = demos.replay(env, part.tasks, part.demos)
    number = int(np.sum(np.asarray(played.mask[0])))
    path = np.concatenate([np.asarray(played.obs[0, :number]), np.asarray(played.last_obs)])
    off = np.hypot(*(path[:, :2] - pose[: number + 1, :2]).T)
    return (
        f"replayed in {env.name}: return {float(returns[0]):.1f}, "
        f"{'reaches' if bool(success[0]) else 'does not reach'} the goal; its path is off by "
        f"{np.max(off):.3f} m at most, {off[-1]:.3f} m at the end"
    )
