"""Whether runs that are there already are those that a study needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.provenance import code_version, read_provenance
from emrld_jax.runs.saved import load_config
from emrld_jax.runs.setup import set_up
from emrld_jax.runs.usage import leaves
from emrld_jax.runs.variants import variants
from emrld_jax.settings import value
from emrld_jax.study.programs import Program

FREE = ("runs", "seed", "checkpoint_every")


def check_runs(programs: Sequence[Program], configured: Callable[[Program], TrainConfig]) -> str:
    """Refuses runs of other settings than the study's.

    Args:
        programs: of the study.
        configured: a program's configuration, as its command line says.

    Returns:
        A note, if runs that have begun are of other commits than the present one; else nothing.

    Raises:
        ConfigError: a run differs; names the setting, what it is there and what it should be.
    """
    begun = [p for p in programs if any(folder.config.is_file() for folder in p.folders)]
    for program in begun:
        _check_settings(program, configured(program))
    paths = [f.path for p in begun for f in p.folders if f.config.is_file()]
    now = code_version().get("commit")
    other = sorted({str(c)[:10] for path in paths if (c := _commit(path)) != now})
    if not other:
        return ""
    return f"note: some runs are of other commits of the code: {', '.join(other)}"


def _check_settings(program: Program, config: TrainConfig) -> None:
    wanted = {
        program.folder(own.seed, tuple(value(own, number) for number, _ in program.grid)).path: own
        for own in (variant.config for variant in variants(set_up(config).config))
    }
    for path, own in wanted.items():
        if not (path / "config.yaml").is_file():
            continue
        there = load_config(path / "config.yaml")
        for name in leaves(own):
            if name not in FREE and value(there, name) != value(own, name):
                raise ConfigError(
                    f"{path} has {name}={value(there, name)}, but this study needs "
                    f"{value(own, name)}: take another folder with out=.., or move this run away"
                )


def _commit(path: Path) -> str | None:
    commit: str | None = read_provenance(path / "provenance.json")["code"].get("commit")
    return commit
