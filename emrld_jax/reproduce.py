"""The paper's figures from one command: `python -m emrld_jax.reproduce` (`--help`).

Trains what is not finished, then draws. Stopped at any point, the same command goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache

from emrld_jax.runs import cli
from emrld_jax.runs.config import TrainConfig, check_config
from emrld_jax.runs.help_texts import asks_for_help
from emrld_jax.runs.usage import usage
from emrld_jax.study.plan import ReproduceConfig, Study, programs, studies
from emrld_jax.study.programs import Program

EXAMPLES = (
    "figure=curves envs=[point2d] seeds=3",
    "figure=all seeds=5 out=results",
    "figure=all fast=true out=smoke",
    "figure=curves draw=true",
)


def main() -> int:
    """Reproduces as the command line says."""
    arguments = sys.argv[1:]
    if asks_for_help(arguments):
        print(
            usage(
                "emrld_jax.reproduce",
                "Train what the paper's figures need, and draw them.\n"
                "Stopped at any point, the same command goes on where it was.",
                EXAMPLES,
                ReproduceConfig(),
                {},
            )
        )
        return 0
    values = cli.parse(arguments, ReproduceConfig(), {})
    config = cli.updated(ReproduceConfig(), values)
    check_config(config)
    planned = studies(config)
    for program in programs(planned):
        _configured(program)  # what is wrong with a training is told before any begins
    return _carry_out(config, planned)


@cache
def _configured(program: Program) -> TrainConfig:
    return cli.train_config(program.arguments(program.seeds[0], len(program.seeds)))


def _carry_out(config: ReproduceConfig, planned: Sequence[Study]) -> int:
    # only now, since it imports much: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.runs.progress import tell  # noqa: PLC0415
    from emrld_jax.study.checking import check_runs  # noqa: PLC0415
    from emrld_jax.study.drawing import draw  # noqa: PLC0415
    from emrld_jax.study.launching import launch_all  # noqa: PLC0415
    from emrld_jax.study.running import run_all  # noqa: PLC0415
    from emrld_jax.study.watching import Watch  # noqa: PLC0415

    console, needed = Console(), programs(planned)
    if note := check_runs(needed, _configured):
        tell(console, note)
    if config.draw:
        draw(planned, config, console)
        return 0
    runs = sum(len(program.folders) for program in needed)
    done = sum(program.finished for program in needed)
    tell(console, f"{runs} runs in {len(needed)} programs, {done} of them finished already")
    watch = Watch(needed, lambda program: _configured(program).meta.iterations, console)
    if config.launcher:
        outcome = launch_all(needed, config.launcher, watch)
    else:
        outcome = run_all(needed, watch)
    if outcome.exit_code:
        tell(console, "stopped; the same command goes on where it was")
        return outcome.exit_code
    for program, log in outcome.failed:
        tell(console, f"not finished: {program.name}; see {log}")
    draw(planned, config, console)
    return 1 if outcome.failed else 0


if __name__ == "__main__":
    cli.run_command(main)
