"""Which trainings the paper's figures need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from emrld_jax import algorithms
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.fields import setting
from emrld_jax.runs.config import ConfigError
from emrld_jax.study.programs import MOST_SEEDS, Grid, Program
from envs_jax import names

FIGURES = ("curves", "sensitivity", "ablation", "trajectories")
COMPARED = ("emrld", "emrld_ws", "maml", "meta_bc", "gmps")  # in the paper
WEIGHTS = (0.2, 0.4, 0.6, 0.8, 1.0)
SEEDS, FAST_SEEDS = 5, 1  # unless they are given
MAIN = "main"  # the part of the runs that have no settings of their own
CHOSEN = {"envs": names(), "qualities": QUALITIES, "algos": algorithms.names()}


@dataclass
class ReproduceConfig:
    """All settings of a reproduction."""

    figure: str = setting(
        "curves",
        "curves: all algorithms on all environments; sensitivity: to w_rl and w_bc; ablation: "
        "without one of the two; trajectories: under a drift of -0.65",
        choices=(*FIGURES, "all"),
    )
    seeds: int | None = setting(
        None,
        f"seeds of each line, from 0 on; null: {SEEDS}, with fast=true {FAST_SEEDS}",
        at_least=1,
        at_most=MOST_SEEDS,
    )
    fast: bool = setting(
        False, "two meta-iterations and few episodes each, to see whether all of it works"
    )
    out: str = setting("reproduced", "folder of the runs, figures, tables and the report")
    envs: list[str] = setting([*names()], "environments of the curves", choices=names())
    qualities: list[str] = setting([*QUALITIES], "of the shipped demonstrations", choices=QUALITIES)
    algos: list[str] = setting(
        [*COMPARED], "algorithms of the curves and trajectories", choices=algorithms.names()
    )
    steps: int = setting(
        3,
        "the curves' runs are evaluated on held-out tasks after up to so many adaptation steps; "
        "0: they are not",
        at_least=0,
        at_most=100,
    )
    draw: bool = setting(False, "train nothing: only draw what is finished")
    launcher: str | None = setting(
        None, "hand the trainings to this launcher of Hydra's, such as submitit_slurm"
    )


class Study(NamedTuple):
    """The trainings that one figure shows."""

    figure: str
    programs: tuple[Program, ...]


def studies(config: ReproduceConfig) -> list[Study]:
    """What the configuration asks for; a program that two figures show is in both.

    Raises:
        ConfigError: there is nothing to do, or a list of names is empty.
    """
    for name, offered in CHOSEN.items():
        if not getattr(config, name):
            raise ConfigError(
                f"{name}=[] is not allowed: it must name one or more of {', '.join(offered)}"
            )
    made = [
        Study(figure, tuple(_MAKE[figure](config)))
        for figure in FIGURES
        if config.figure in (figure, "all")
    ]
    if not any(study.programs for study in made):
        raise ConfigError(f"figure={config.figure} needs none of envs={config.envs}")
    return made


def whole(config: ReproduceConfig) -> list[Study]:
    """All that the figures can show of runs in the folder, whatever commands have trained them.

    Every environment, algorithm and set of demonstrations, with all seeds that are there.
    """
    qualities = [*dict.fromkeys((*config.qualities, *QUALITIES))]  # in the order that is given
    every = replace(
        config, figure="all", envs=[*names()], algos=[*algorithms.names()], qualities=qualities
    )
    return [
        study._replace(programs=tuple(own.with_seeds_there() for own in study.programs))
        for study in studies(every)
    ]


def programs(planned: Sequence[Study]) -> list[Program]:
    """Each program of the studies once."""
    return list(dict.fromkeys(program for study in planned for program in study.programs))


def _program(
    config: ReproduceConfig,
    group: str,
    env: str,
    demos: str,
    algo: str,
    settings: tuple[str, ...] = (),
    grid: Grid = (),
) -> Program:
    seeds = config.seeds or (FAST_SEEDS if config.fast else SEEDS)
    steps = config.steps if group == MAIN else 0
    return Program(
        Path(config.out) / "runs" / group,
        env,
        demos,
        algo,
        tuple(range(seeds)),
        settings,
        grid,
        steps,
        config.fast,
    )


def _curves(config: ReproduceConfig) -> list[Program]:
    """Of an algorithm without demonstrations one line stands for both sets."""
    pairs = [(_demos(algo, own), algo) for own in config.qualities for algo in config.algos]
    once = dict.fromkeys(pairs)
    return [_program(config, MAIN, env, *pair) for env in config.envs for pair in once]


def _demos(algo: str, quality: str) -> str:
    """What an algorithm is given; one that takes none is the same run whichever are chosen."""
    return quality if algorithms.takes_demonstrations(algo) else QUALITIES[0]


def _sensitivity(config: ReproduceConfig) -> list[Program]:
    """Supplement, Fig. 2: one weight varies, the other one is 1.

    The lines at w_rl = 0.2 are those of the curves, and w_rl = w_bc = 1 is in both panels.
    """
    if "point2d" not in config.envs:
        return []
    made = []
    for algo in ("emrld", "emrld_ws"):
        own = partial(_program, config, env="point2d", demos="optimal", algo=algo)
        made += [
            own(MAIN),
            own("sensitivity", settings=("w_bc=1",), grid=(("w_rl", WEIGHTS[1:]),)),
            own("sensitivity", settings=("w_rl=1",), grid=(("w_bc", WEIGHTS[:-1]),)),
        ]
    return made


def _ablation(config: ReproduceConfig) -> list[Program]:
    """Supplement, Fig. 3: EMRLD whole, without demonstrations, without the policy gradient."""
    if "point2d" not in config.envs:
        return []
    kinds = ((MAIN, ()), ("without_w_bc", ("w_bc=0",)), ("without_w_rl", ("w_rl=0",)))
    return [
        _program(config, group, "point2d", demos, "emrld", settings)
        for demos in config.qualities
        for group, settings in kinds
    ]


def _trajectories(config: ReproduceConfig) -> list[Program]:
    """Supplement, Fig. 1, in simulation."""
    if "two_wheeled_drift" not in config.envs:
        return []
    own = partial(_program, config, MAIN, "two_wheeled_drift")
    return [own(_demos(algo, config.qualities[0]), algo) for algo in config.algos]


_MAKE: dict[str, Callable[[ReproduceConfig], list[Program]]] = {
    "curves": _curves,
    "sensitivity": _sensitivity,
    "ablation": _ablation,
    "trajectories": _trajectories,
}
