"""Makes demonstrations: `python -m emrld_jax.make_demos env=point2d quality=optimal`."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emrld_jax.demos import DemoSet
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError, check_config
from emrld_jax.runs.help_texts import asks_for_help
from emrld_jax.runs.outputs import check_new
from emrld_jax.runs.usage import usage
from envs_jax import make, names

if TYPE_CHECKING:
    from rich.console import Console

    from emrld_jax.demos import DemoFile
    from emrld_jax.demos.making import Training
    from emrld_jax.runs.experts import KeptTraining

ITERATIONS = ("dense_iterations", "sparse_iterations")


@dataclass
class MakeDemosConfig:
    """All settings of making demonstrations."""

    env: str = setting("point2d", "the environment", choices=names())
    quality: str = setting(
        "optimal",
        "optimal: a trained expert that reaches every goal, or runs fast; suboptimal: noisy "
        "trajectories of an expert that stopped early, cut off before they achieve much",
        choices=QUALITIES,
    )
    seed: int = setting(0, "seed of all random numbers", at_least=0, at_most=10**9)
    out: str | None = setting(None, "file to write; null: demos/ENV_QUALITY.npz")
    dense_iterations: int | None = setting(
        None,
        "iterations of the expert on the dense reward, at the most; null: what the environment "
        "takes",
        at_least=1,
    )
    sparse_iterations: int | None = setting(
        None,
        "then iterations on the sparse reward; for optimal demonstrations only; null: what the "
        "environment takes",
        at_least=0,
    )


def main() -> int:
    """Makes demonstrations as the command line says."""
    arguments = sys.argv[1:]
    if asks_for_help(arguments):
        print(
            usage(
                "emrld_jax.make_demos",
                "Train an expert and write one demonstration a task into a file.\n"
                "Stopped at any point, the same command goes on where it was.",
                ("env=point2d quality=optimal", "env=two_wheeled quality=suboptimal seed=1"),
                MakeDemosConfig(),
                {},
            )
        )
        return 0
    values = cli.parse(arguments, MakeDemosConfig(), {})
    config = cli.updated(MakeDemosConfig(), values)
    check_config(config)
    if config.quality == "suboptimal" and "sparse_iterations" in values:
        raise ConfigError("sparse_iterations has no effect with quality=suboptimal")
    out = Path(config.out or f"demos/{config.env}_{config.quality}.npz")
    check_new(out, ".npz")
    make_file(config, out)
    return 0


def make_file(config: MakeDemosConfig, out: Path) -> None:
    """Makes the demonstrations, with progress, and writes them with where they come from."""
    # only now: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.demos import check_tasks, provenance, save  # noqa: PLC0415
    from emrld_jax.runs.experts import kept_training  # noqa: PLC0415
    from emrld_jax.runs.progress import tell  # noqa: PLC0415
    from emrld_jax.runs.provenance import software  # noqa: PLC0415

    console, env = Console(), make(config.env)
    training = chosen_training(config)
    iterations = {name: getattr(training, name) for name in ITERATIONS}
    settings = {"env": config.env, "quality": config.quality, "seed": config.seed, **iterations}
    with kept_training(out, settings, console) as kept:
        file = trained_demos(config, training, kept, console)
        if not training.sparse_iterations:
            tell(console, "stopped: for every task there is a try that fits")
        figures = {"train": summary(file.train), "test": summary(file.test)}
        told = [argument for argument in sys.argv[1:] if not argument.startswith("out=")]
        origin = provenance(
            command=shlex.join(["python", "-m", "emrld_jax.make_demos", *told]),
            seed=config.seed,
            **software(),
            began=kept.began["code"],  # of an earlier version, perhaps
            figures=figures,
        )
        file = replace(file, provenance=origin)
        check_tasks(file, env)
        save(out, file, env)
    for split, values in figures.items():
        console.print(f"{split}: " + ", ".join(f"{k} {v}" for k, v in values.items()))
    console.print(f"wrote {out}")


def trained_demos(
    config: MakeDemosConfig, training: Training, kept: KeptTraining, console: Console
) -> DemoFile:
    """Demonstrations of an expert that is trained, or whose training goes on, with progress."""
    from emrld_jax.demos.making import Standing, make_demos  # noqa: PLC0415
    from emrld_jax.runs.progress import ProgressView  # noqa: PLC0415

    told_at = time.perf_counter()
    with ProgressView(console, 0, sum(getattr(training, name) for name in ITERATIONS)) as view:

        def report(reward: str, standing: Standing, metrics: dict[str, Any]) -> None:
            nonlocal told_at
            last, told_at = told_at, time.perf_counter()
            broken = float(metrics["expert/diverged"])
            figures = (
                f"{reward} reward, return {float(metrics['expert/return']):.1f}  "
                f"success {float(metrics['expert/success']):.0%}"
                + f"  {broken:.2%} of simulations broke down"
                * (broken > 0)
            )
            view.show(standing.iteration, figures, told_at - last)
            kept.keep(standing)

        return make_demos(config.env, config.quality, config.seed, training, report, kept.restore)


def chosen_training(config: MakeDemosConfig) -> Training:
    """How long the expert trains: as the environment takes, unless the settings say otherwise."""
    from emrld_jax.demos.making import default_training  # noqa: PLC0415

    training = default_training(config.env)
    if config.dense_iterations is not None:
        training = training._replace(dense_iterations=config.dense_iterations)
    if config.sparse_iterations is not None:
        training = training._replace(sparse_iterations=config.sparse_iterations)
    if config.quality == "suboptimal":
        training = training._replace(sparse_iterations=0)
    return training


def summary(part: DemoSet) -> dict[str, Any]:
    """What the demonstrations of a split achieve."""
    return {
        "mean_return": round(float(np.mean(part.returns)), 2),
        "reached": f"{int(np.sum(part.success))} of {len(part.success)}",
        "mean_steps": round(float(np.mean(np.sum(part.demos.mask, axis=1))), 1),
    }


if __name__ == "__main__":
    cli.run_command(main)
