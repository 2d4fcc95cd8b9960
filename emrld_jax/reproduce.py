"""The paper's figures from one command: `python -m emrld_jax.reproduce` (`--help`).

Trains what is not finished, then draws. Stopped at any point, the same command goes on.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import jax
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError, TrainConfig, check_config, make_env
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.help_texts import asks_for_help
from emrld_jax.runs.usage import did_you_mean, usage
from emrld_jax.study.plan import ReproduceConfig, Study, programs, studies, whole
from emrld_jax.study.programs import Program

if TYPE_CHECKING:
    from rich.console import Console

    from emrld_jax.study.running import Outcome

EXAMPLES = (
    "figure=curves envs=[point2d] seeds=3",
    "figure=all seeds=5 out=results",
    "envs=[point2d] qualities=[optimal] fast=true out=smoke",
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
    if config.launcher is not None:
        _check_launcher(config.launcher)
    planned = studies(config)
    for program in programs(planned):
        own = _configured(program)  # what is wrong with a training is told before any begins
        if not config.draw and config.launcher is None:
            make_env(own.env)  # what is not installed, too
    return _carry_out(config, planned)


def _check_launcher(launcher: str) -> None:
    """Refuses a launcher that Hydra does not know, or whose package is not installed."""
    from emrld_jax.sweep import EXTRAS  # noqa: PLC0415  (few give a launcher)

    with initialize_config_dir(str(cli.CONF), version_base="1.3"):
        offered = GlobalHydra.instance().config_loader().get_group_options("hydra/launcher")
    if launcher in offered:
        return
    if launcher in EXTRAS:
        raise ConfigError(
            f"launcher={launcher} is not installed: pip install 'emrld-jax[{EXTRAS[launcher]}]'"
        )
    known = sorted({*offered, *EXTRAS})
    hint = did_you_mean(launcher, known)
    raise ConfigError(f"launcher={launcher} is unknown{hint} (there are: {', '.join(known)})")


@cache
def _configured(program: Program) -> TrainConfig:
    return cli.train_config(program.arguments(program.seeds[0], len(program.seeds)))


def _carry_out(config: ReproduceConfig, planned: Sequence[Study]) -> int:
    # only now, since it imports much: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.runs.progress import tell  # noqa: PLC0415
    from emrld_jax.study.checking import check_runs, other_runs  # noqa: PLC0415
    from emrld_jax.study.drawing import draw  # noqa: PLC0415
    from emrld_jax.study.running import Outcome  # noqa: PLC0415

    console, needed = Console(), programs(planned)
    out = Path(config.out)
    if config.draw and not (out / "runs").is_dir():
        raise ConfigError(
            f"draw=true with out={out}: there are no runs; it must be the folder of a study"
        )
    out.mkdir(parents=True, exist_ok=True)
    with RunFolder(out).locked():
        for note in check_runs(needed, _configured):
            tell(console, f"note: {note}")
        outcome = Outcome([], 0) if config.draw else _train(config, needed, console)
        if outcome.exit_code:
            tell(console, "stopped; the same command goes on where it was")
            return outcome.exit_code
        for program, log in outcome.failed:
            words = f"see {log}" if log else f"it is not continued by {config.launcher}"
            tell(console, f"not finished: {program.name}; {words}")
            for folder in program.diverged:
                tell(console, f"  {folder.path} diverged")
        shown = whole(config)
        left_out = other_runs(programs(shown), needed, _configured)
        for path, reason in left_out.items():
            tell(console, f"not shown: {path}: {reason}")
        good = draw(shown, left_out, config, console)
    return 0 if good and not outcome.failed else 1


def _train(config: ReproduceConfig, needed: Sequence[Program], console: Console) -> Outcome:
    """Trains what is not finished, telling how far it is."""
    from emrld_jax.runs.progress import tell  # noqa: PLC0415
    from emrld_jax.study.launching import launch_all  # noqa: PLC0415
    from emrld_jax.study.running import run_all  # noqa: PLC0415
    from emrld_jax.study.watching import Watch  # noqa: PLC0415

    runs = sum(len(program.folders) for program in needed)
    done = sum(program.finished for program in needed)
    tell(console, f"{runs} runs in {len(needed)} programs, {done} of them finished already")
    watch = Watch(needed, lambda program: _configured(program).meta.iterations, console)
    if config.launcher:
        return launch_all(needed, config.launcher, watch)
    # an accelerator's memory is for one program at a time
    return run_all(needed, watch, None if jax.default_backend() == "cpu" else 1)


if __name__ == "__main__":
    # others train: this process must not take an accelerator's memory for itself
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    cli.run_command(main)
