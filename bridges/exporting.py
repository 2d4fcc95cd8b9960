"""From a run folder to a bundle. (This needs JAX; what runs the bundle does not.)"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bridges.bundle import Bundle, Network, Stage
from bridges.environments import described, described_task, zone
from bridges.messages import BridgeError
from bridges.parameters import tensors_of
from bridges.policy import Policy
from bridges.tensor_file import Tensors
from emrld_jax.demos import DemoSet
from emrld_jax.meta.staged import adapt_with
from emrld_jax.runs.config import ConfigError, algorithm_settings
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.provenance import (
    other_demonstrations,
    read_provenance,
    sha256,
    software,
    typed_command,
)
from emrld_jax.runs.saved import load_config
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.runs.trained import newest
from emrld_jax.types import Params
from envs_jax import Env
from envs_jax.two_wheeled_drift import TwoWheeledDrift

OTHER = {"train": "test", "test": "train"}
# of actions, as parts of their size or of 1: above what float32 rounds in a trained network, below
# what another function would make of it
TOLERANCE = 1e-4
CHECKED = 1000  # observations

# [N, O] -> mean actions [N, A], policy units, and what is executed of them [N, A]
Act = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Exported(NamedTuple):
    """A bundle, and the trained policy itself to compare with."""

    bundle: Bundle
    act: Act


def export(
    run: str,
    split: str = "test",
    task: int | None = None,
    demos: str | None = None,
    note: Callable[[str], None] = print,
) -> Exported:
    """Makes the bundle of a run's newest checkpoint for one of its tasks.

    Args:
        run: the run folder; nothing in it is changed.
        split: "train" or "test", of the demonstrations.
        task: which of the split's; None: `robot_task`.
        demos: demonstrations in place of the run's, of the same environment.
        note: told of what is not as it was when the run was trained.

    Raises:
        ConfigError, DemoError: the run, its demonstrations or the task are refused.
        BridgeError: NumPy does not compute what JAX does.
    """
    folder = RunFolder(Path(run))
    config = load_config(folder.config)
    # only adaptation is exported, so the outer loss's own demonstrations need not be there
    setup = set_up(replace(config, demos=demos or config.demos, outer_demos=None))
    if demos is None and (text := other_demonstrations(folder.provenance, setup.demos_path)):
        note(text)
    index = _index(setup, split, task)
    params, iteration = newest(setup, folder, note)
    origin = _origin(folder, setup, iteration, {"split": split, "task": index})
    return bundled(setup, params, getattr(setup.demos, split), index, origin)


def bundled(
    setup: Setup, params: Params, part: DemoSet, index: int, origin: dict[str, Any]
) -> Exported:
    """The bundle of some meta-parameters for one task of a split, adapted as far as it can be.

    Raises:
        BridgeError: NumPy does not compute what JAX does.
    """
    task, demo = jax.tree.map(lambda x: x[index], (part.tasks, part.demos))
    staged = adapt_with(setup.learner, params, task, demo, ())
    steps = int(np.sum(demo.mask))
    shown = {"obs": demo.obs[:steps], "action": demo.action[:steps]}
    tensors = {
        **_tensors(setup, staged.params, "policy"),
        **_tensors(setup, params, "meta"),
        **{f"demos/{name}": np.asarray(value, np.float32) for name, value in shown.items()},
    }
    stage = Stage(staged.used, staged.adapted)
    exported = Exported(_bundle(setup, task, stage, tensors, origin), _act(setup, staged.params))
    check_agreement(exported, _in_numpy(exported.bundle), "NumPy")
    return exported


def told(bundle: Bundle) -> str:
    """What a bundle is, in a line."""
    weights = sum(x.size for name, x in bundle.tensors.items() if name.startswith("policy/"))
    numbers = ", ".join(f"{name}={value}" for name, value in bundle.task.items())
    stage = "adapted" if bundle.stage.adapted else "collects episodes to adapt with"
    return (
        f"{bundle.algorithm} on {bundle.environment.name}, {numbers}: {weights} numbers, {stage}; "
        f"content {bundle.content_sha256[:12]}"
    )


def robot_task(env: Env, tasks: Any) -> int:
    """The paper's experiment on its robot, if it is among the tasks; else the first one."""
    if not isinstance(env, TwoWheeledDrift):
        return 0
    distance = np.abs(np.asarray(tasks.residual_angular_velocity) - env.robot_experiment)
    return int(np.argmin(distance)) if np.min(distance) < 1e-5 else 0


def check_agreement(exported: Exported, act: Act, what: str) -> float:
    """Refuses what acts otherwise than the trained policy around the demonstration.

    Returns:
        The largest difference of a mean action, in policy units (as part of its size if above 1).

    Raises:
        BridgeError: it is too large.
    """
    shown = exported.bundle.tensors["demos/obs"]
    low, high = shown.min(axis=0), shown.max(axis=0)
    span = high - low + 0.1
    generator = np.random.default_rng(0)
    obs = generator.uniform(low - span, high + span, (CHECKED, low.size)).astype(np.float32)
    differences = [
        np.max(np.abs(own - wanted) / np.maximum(np.abs(wanted), 1.0))
        for own, wanted in zip(act(obs), exported.act(obs), strict=True)
    ]
    worst = float(np.max(differences))  # NaN if one is
    if not worst <= TOLERANCE:
        raise BridgeError(
            f"{what} computes other actions than JAX: they differ by {worst:.2g}, allowed are "
            f"{TOLERANCE:g}"
        )
    return float(differences[0])


def _index(setup: Setup, split: str, task: int | None) -> int:
    part = getattr(setup.demos, split)
    number = part.demos.mask.shape[0]
    if number == 0:
        raise ConfigError(
            f"split={split}: {setup.demos_path} has no demonstrations of such tasks; "
            f"split={OTHER[split]} takes the others"
        )
    if task is not None and task >= number:
        raise ConfigError(
            f"task={task} is not allowed: {setup.demos_path} has {number} tasks with "
            f"split={split}, so it must be 0 to {number - 1}"
        )
    return robot_task(setup.env, part.tasks) if task is None else task


def _bundle(
    setup: Setup, task: Any, stage: Stage, tensors: Tensors, origin: dict[str, Any]
) -> Bundle:
    config, net = setup.config, setup.config.policy
    environment, observation, action = described(setup.env)
    return Bundle(
        environment=environment,
        task=described_task(task),
        zone=zone(setup.env, task),
        observation=observation,
        action=action,
        control_period=float(setup.env.dt),
        policy=Network(list(net.hidden_sizes), net.activation, net.squash),
        algorithm=config.algo,
        settings=asdict(algorithm_settings(config)),
        seed=config.seed,
        stage=stage,
        provenance=origin,
        tensors=tensors,
    )


def _tensors(setup: Setup, params: Params, part: str) -> Tensors:
    obs = jnp.zeros(setup.env.observation_size)
    return tensors_of(params, setup.learner.policy.apply(params, obs).log_std, part)


def _act(setup: Setup, params: Params) -> Act:
    @jax.jit
    def act(obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = setup.learner.policy.apply(params, obs).mean
        return mean, jax.vmap(setup.env.to_physical)(mean)

    def exact(obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with jax.default_matmul_precision("float32"):  # accelerators round more by default
            mean, physical = act(jnp.asarray(obs))
        return np.asarray(mean), np.asarray(physical)

    return exact


def _in_numpy(bundle: Bundle) -> Act:
    policy = Policy(bundle)

    def act(obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = policy.mean(obs)
        return mean, policy.to_physical(mean)

    return act


def _origin(
    folder: RunFolder, setup: Setup, iteration: int, chosen: dict[str, Any]
) -> dict[str, Any]:
    """Where the bundle comes from: the run, and this export."""
    try:
        began = read_provenance(folder.provenance)
    except ConfigError:  # has been told
        began = {}
    record = {name: began.get(name) for name in ("time", "command", "code", "packages", "demos")}
    demos = {"path": str(setup.demos_path), "sha256": sha256(setup.demos_path)}
    export = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": typed_command(),
        **software(),
        "demos": {**demos, "quality": setup.demos.quality},
        **chosen,
    }
    return {"run": {"folder": str(folder.path), "iteration": iteration, **record}, "export": export}
