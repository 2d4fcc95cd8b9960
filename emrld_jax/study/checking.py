"""Whether runs that are there already are those that a study needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from emrld_jax.analysis import groups
from emrld_jax.demos import DemoError
from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.provenance import code_version, read_provenance, sha256
from emrld_jax.runs.saved import load_config
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.runs.usage import leaves
from emrld_jax.runs.variants import variants
from emrld_jax.settings import value
from emrld_jax.study.programs import Program
from envs_jax.physics.models import MissingPackageError

FREE = (*groups.FREE, "evaluation_episodes")


def check_runs(
    programs: Sequence[Program], configured: Callable[[Program], TrainConfig]
) -> list[str]:
    """Refuses runs of other settings than the study's.

    Args:
        programs: of the study.
        configured: a program's configuration, as its command line says.

    Returns:
        What to know of the runs that are there: which cannot be read, and which are of another
        commit, of other demonstrations, or of code with changes that were not committed.

    Raises:
        ConfigError: a run differs; names the setting, what it is there and what it should be. Or a
            finished run's settings are not known.
    """
    notes: list[str] = []
    for program in programs:
        for folder in program.folders:
            if folder.finished and not folder.config.is_file():
                raise ConfigError(
                    f"{folder.path} is finished, but has no config.yaml, so it is not known what "
                    "was trained: move it away, and it is trained again"
                )
        if any(folder.config.is_file() for folder in program.folders):
            notes += _check(program, configured(program))
    return notes


def other_runs(
    programs: Sequence[Program],
    needed: Sequence[Program],
    configured: Callable[[Program], TrainConfig],
) -> dict[Path, str]:
    """Runs that are there, which a study does not need and cannot be shown beside, and why.

    Args:
        programs: all that figures and tables may show.
        needed: of the study; `check_runs` tells of theirs.
        configured: a program's configuration, as its command line says.
    """
    own = {folder.path for program in needed for folder in program.folders}
    found: dict[Path, str] = {}
    for program in programs:
        begun = {folder.path for folder in program.folders if folder.config.is_file()} - own
        if not begun:
            continue
        try:
            pairs = _expected(program, set_up(configured(program)))
        except (ConfigError, DemoError, MissingPackageError) as error:
            found |= dict.fromkeys(begun, f"it cannot be checked here: {error}")
            continue
        for folder, config in pairs:
            if folder.path in begun:
                try:
                    _check_settings(folder.path, load_config(folder.config), config)
                except ConfigError as error:
                    found[folder.path] = str(error)
    return found


def _expected(program: Program, setup: Setup) -> list[tuple[RunFolder, TrainConfig]]:
    """A program's run folders, and what should be the configuration in each."""
    configs = [variant.config for variant in variants(setup.config)]
    points = [tuple(value(own, number) for number, _ in program.grid) for own in configs]
    folders = [program.folder(own.seed, p) for own, p in zip(configs, points, strict=True)]
    return list(zip(folders, configs, strict=True))


def _check(program: Program, config: TrainConfig) -> list[str]:
    """Refuses a program's runs, or tells of them."""
    setup, notes = set_up(config), []
    now = code_version(), sha256(setup.demos_path)
    for folder, own in _expected(program, setup):
        if not folder.config.is_file():
            continue
        try:
            there, record = load_config(folder.config), read_provenance(folder.provenance)
        except ConfigError as error:
            notes.append(f"cannot be used: {error}")
            continue
        _check_settings(folder.path, there, own)
        notes += _origin(folder.path, record, *now)
    return notes


def _check_settings(path: Path, there: TrainConfig, wanted: TrainConfig) -> None:
    for name in leaves(wanted):
        if name not in FREE and value(there, name) != value(wanted, name):
            raise ConfigError(
                f"{path} has {name}={value(there, name)}, but this study needs "
                f"{value(wanted, name)}: take another folder with out=.., or move this run away"
            )


def _origin(path: Path, record: dict, code: dict, demos: str) -> list[str]:
    """What differs between how a run began and now."""
    notes = []
    if record["demos"]["sha256"] != demos:
        notes.append(
            f"{path}: of other demonstrations than {record['demos'].get('path')} holds now"
        )
    for began in (record, *record["resumed"]):
        if (own := began["code"]) != code:
            words = f"{str(own.get('commit'))[:10]}{'+' * bool(own.get('dirty'))}"
            notes.append(f"{path}: of another version of the code, {words}")
    return notes
