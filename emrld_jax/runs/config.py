"""The configuration of a run, typed: what the command line sets and `config.yaml` holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any

from emrld_jax import algorithms
from emrld_jax.fields import check, setting
from emrld_jax.settings import (
    AdaptSettings,
    MetaSettings,
    PolicySettings,
    Settings,
    numbers,
    with_values,
)
from envs_jax import Env, make, names
from envs_jax.base import REWARDS
from envs_jax.physics import BACKENDS

W_RL_OPTIMAL, W_RL_SUBOPTIMAL = 0.2, 1.0  # the paper's (section C)
# taken literally: no grammar in a path
PATHS = ("demos", "outer_demos", "file", "out", "resume", "run", "runs")
RESUMABLE = ("meta.iterations", "checkpoint_every", "evaluation_episodes")
PLACES = (  # where a run computes, which is no part of what it is: never kept with a run
    "devices",
    "processes",
    "distributed.coordinator",
    "distributed.num_processes",
    "distributed.process_id",
    "distributed.timeout",
)
VARIED = numbers(Settings())  # settings that runs of one program may differ in


class ConfigError(ValueError):
    """A configuration is refused; the message names the setting and what is allowed."""


@dataclass
class EnvSettings:
    """The environment."""

    name: str = setting("point2d", "the environment, chosen by env=NAME", choices=names())
    reward: str = setting(
        "sparse",
        "sparse: none far from a goal (half_cheetah: near its start); dense: everywhere",
        choices=REWARDS,
    )
    horizon: int = setting(100, "steps of an episode", at_least=1, at_most=100_000)
    reward_radius: float | None = setting(
        None,
        "m from the goal within which sparse reward is not 0 (not half_cheetah); null: the paper's",
        above=0,
    )
    zone_distance: float | None = setting(
        None,
        "half_cheetah: m from its start beyond which sparse reward is not 0; null: the paper's",
        above=0,
    )
    backend: str | None = setting(
        None,
        "half_cheetah's physics: mujoco in C, or mjx; auto or null: C on a CPU, else MJX",
        choices=BACKENDS,
    )
    mjx_iterations: int | None = setting(
        None, "half_cheetah: of MJX's contact solver; null: 4, see docs/half_cheetah.md", at_least=1
    )
    mjx_line_search: int | None = setting(
        None, "half_cheetah: of MJX's line search; null: 4, see docs/half_cheetah.md", at_least=1
    )


@dataclass
class DistributedSettings:
    """Several processes, on one machine or many, that train together with the same settings."""

    coordinator: str | None = setting(
        None, "HOST:PORT of the process with id 0, which others can reach; null: one process alone"
    )
    num_processes: int = setting(1, "processes that train together", at_least=1, at_most=4096)
    process_id: int = setting(
        0, "which of them this one is; 0 writes all files", at_least=0, at_most=4095
    )
    timeout: int = setting(
        60, "s to wait for the others at the start, and for a sign of life", at_least=5
    )


@dataclass
class TrainConfig:
    """All settings of a training run."""

    algo: str = setting("emrld", "the algorithm", choices=algorithms.names())
    demos: str = setting(
        "optimal", "optimal or suboptimal (shipped demonstrations), or the path of a .npz file"
    )
    outer_demos: str | None = setting(
        None,
        "meta_bc and gmps: demonstrations of the same tasks for the outer loss, as demos; null: "
        "those of demos serve both",
    )
    seed: int = setting(0, "seed of all random numbers", at_least=0, at_most=10**9)
    num_seeds: int = setting(
        1,
        "seeds trained side by side in one program, from seed on; each is a run of its own",
        at_least=1,
        at_most=4096,
    )
    vmap: dict[str, list[float]] = setting(
        {},
        "values of a number that are trained side by side, such as vmap.w_rl=[0.2,0.5]; also of "
        + ", ".join(name for name in VARIED if name != "w_rl"),
    )
    w_rl: float | None = setting(
        None,
        f"weight of the policy gradient in the inner loss; null: {W_RL_OPTIMAL:g}, and "
        f"{W_RL_SUBOPTIMAL:g} with suboptimal demonstrations",
        at_least=0,
    )
    w_bc: float = setting(1.0, "weight of the demonstrations in the inner loss", at_least=0)
    checkpoint_every: int = setting(10, "meta-iterations between checkpoints", at_least=1)
    evaluation_episodes: int = setting(
        50,
        "episodes a task, before and after adaptation, for the final table",
        at_least=1,
        at_most=10_000,
    )
    diagnostics: bool = setting(
        False,
        "measure each iteration against Theorem 3.2 (docs/theory.md), on one device: each task "
        "adapts and collects twice more; changes no result",
    )
    runs: str = setting("runs", "folder that run folders are made in")
    resume: str | None = setting(
        None,
        "run folder to continue, or a folder of several that began together; with it, only "
        f"{', '.join(RESUMABLE)} may be given, and where to compute",
    )
    devices: str = setting(
        "1", "how many devices of each process share the work: a whole number, or all"
    )
    processes: int = setting(
        1, "processes to start on this machine, each on its share of the cores", at_least=1
    )
    env: EnvSettings = field(default_factory=EnvSettings)
    policy: PolicySettings = field(default_factory=PolicySettings)
    adapt: AdaptSettings = field(default_factory=AdaptSettings)
    meta: MetaSettings = field(default_factory=MetaSettings)
    distributed: DistributedSettings = field(default_factory=DistributedSettings)


@dataclass
class EvaluateConfig:
    """All settings of an evaluation of a run; `adapt` defaults to the run's own."""

    run: str | None = setting(None, "run folder whose policy is evaluated; required")
    tasks: str = setting(
        "test", "training tasks, or the held-out ones of the run's file", choices=("train", "test")
    )
    episodes: int = setting(
        100,
        "episodes a task, after each number of adaptation steps",
        at_least=1,
        at_most=10_000,
    )
    deterministic: bool = setting(
        False, "evaluate the mean action; episodes for adaptation are sampled all the same"
    )
    video: bool = setting(False, "film an episode of each direction too (half_cheetah)")
    demos: str | None = setting(None, "demonstrations to adapt with; null: those of the run")
    seed: int = setting(0, "seed of all random numbers", at_least=0, at_most=10**9)
    adapt: AdaptSettings = field(default_factory=AdaptSettings)


def check_config(config: Any) -> None:
    """Refuses values that are not allowed, in all sections.

    Raises:
        ConfigError: names the setting, its value and what is allowed.
    """
    _check_values(config)
    if isinstance(config, TrainConfig):
        _check_training(config)


def coordinator_address(settings: DistributedSettings) -> tuple[str, int]:
    """The coordinator's host and port.

    Raises:
        ConfigError: the setting is no HOST:PORT.
    """
    host, _, port = str(settings.coordinator).rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(
            f"distributed.coordinator={settings.coordinator} is not allowed: it must be HOST:PORT"
        )
    return host, int(port)


def _check_values(config: Any) -> None:
    try:
        check(config)
        for item in fields(config):
            if is_dataclass(section := getattr(config, item.name)):
                check(section, f"{item.name}.")
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _check_training(config: TrainConfig) -> None:
    """Refuses settings that do not go together."""
    policy, distributed = config.policy, config.distributed
    if policy.start_at_zero and not policy.hidden_sizes:
        raise ConfigError(
            "policy.hidden_sizes=[] is not allowed with policy.start_at_zero=true: the last hidden "
            "layer's units make the start; give policy.start_at_zero=false"
        )
    if config.devices != "all" and not (config.devices.isdecimal() and int(config.devices) > 0):
        raise ConfigError(f"devices={config.devices} is not allowed: it must be at least 1, or all")
    if distributed.process_id >= distributed.num_processes:
        raise ConfigError(
            f"distributed.process_id={distributed.process_id} is not allowed: it must be below "
            f"distributed.num_processes={distributed.num_processes}"
        )
    alone = distributed.num_processes == 1
    if alone != (distributed.coordinator is None):
        raise ConfigError(
            f"distributed.num_processes={distributed.num_processes} "
            + ("goes with" if alone else "needs")
            + (" distributed.coordinator=null" if alone else " distributed.coordinator=HOST:PORT")
        )
    if not alone:
        coordinator_address(distributed)
    if not alone and config.processes > 1:
        raise ConfigError(
            f"processes={config.processes} starts processes on this machine alone; it cannot be "
            "given along with distributed.coordinator"
        )
    for name, values in config.vmap.items():
        for value in values:
            _check_values(with_values(config, {name: value}))


def algorithm_settings(config: TrainConfig) -> Settings:
    """What an algorithm is assembled from; `w_rl` must be resolved."""
    if config.w_rl is None:
        raise ValueError("w_rl is not resolved yet")
    return Settings(config.w_rl, config.w_bc, config.policy, config.adapt, config.meta)


def make_env(settings: EnvSettings) -> Env:
    """The environment with these settings."""
    given = {k: v for k, v in asdict(settings).items() if v is not None}
    return make(given.pop("name"), **given)


def default_w_rl(quality: str) -> float:
    """The paper's weight of the policy gradient for demonstrations of this quality."""
    return W_RL_SUBOPTIMAL if quality == "suboptimal" else W_RL_OPTIMAL
