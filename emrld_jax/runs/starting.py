"""How runs begin, or go on: their folders, what is checked, and where they stand."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from emrld_jax.demos import DemoError, check_tasks
from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.config import RESUMABLE, ConfigError, TrainConfig
from emrld_jax.runs.episodes import drop_after
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder, new_run_folder, run_folders
from emrld_jax.runs.iteration import initial
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.progress import tell, tell_some
from emrld_jax.runs.provenance import provenance, read_provenance
from emrld_jax.runs.saved import load_config, save_config
from emrld_jax.runs.setup import Setup, set_up, with_config
from emrld_jax.runs.variants import alone, other_setting, variants
from emrld_jax.settings import value, with_values


class Plan(NamedTuple):
    """One of the runs of this command, before anything is written."""

    setup: Setup
    label: str  # what tells it from others of its seed; may be empty
    path: Path | None  # of the run that it continues; None for a new one


def planned(config: TrainConfig, label: str = "") -> list[Plan]:
    """The runs that the configuration asks for; a label comes before those of variants.

    Raises:
        ConfigError, DemoError: the configuration, a run or its demonstrations are refused.
    """
    first = set_up(config)
    if config.resume is None:
        new = variants(first.config)
        return [
            Plan(with_config(first, own), ",".join(filter(None, (label, numbers))), None)
            for numbers, own in new
        ]
    saved = {path: load_config(path / "config.yaml") for path in run_folders(config.resume)}
    before = next(iter(saved.values()))  # what was given differs from it, or makes no difference
    given = {name: new for name in RESUMABLE if (new := value(config, name)) != value(before, name)}
    own = {path: alone(with_values(each, given)) for path, each in saved.items()}
    unfinished = [
        path
        for path in saved
        if not RunFolder(path).finished or saved[path].meta.iterations < own[path].meta.iterations
    ]
    # where all are finished, the first one stands for them: it is told, and nothing is trained
    chosen = unfinished or list(saved)[:1]
    _check_together({path: own[path] for path in chosen})
    return [Plan(with_config(first, own[path]), "", path) for path in chosen]


def _check_together(configs: dict[Path, TrainConfig]) -> None:
    """Refuses runs that differ in more than one program can, naming what and how to go on.

    Raises:
        ConfigError: they do.
    """
    (first, expected), *others = configs.items()
    for path, own in others:
        if name := other_setting(expected, own):
            raise ConfigError(
                f"{first} and {path} cannot be continued together: {name} is "
                f"{value(expected, name)} and {value(own, name)}. Name those that can, joined by "
                f"{os.pathsep!r}, or one by one: {RunFolder(path).resume_command}"
            )


def folder_of(plan: Plan, console: Console) -> RunFolder:
    """The folder of the run to continue, or a new one."""
    if plan.path is not None:
        return RunFolder(plan.path)
    folder, note = new_run_folder(plan.setup.config, plan.label)
    if note:
        tell(console, note)
    return folder


def begin(
    plans: Sequence[Plan], folders: Sequence[RunFolder], console: Console
) -> list[Progressed]:
    """Writes what new runs begin with, or checks those that go on; where each stands.

    Raises:
        ConfigError, DemoError: a run cannot be continued; all stay as they are.
    """
    if plans[0].path is None:
        return [_start(plan.setup, folder) for plan, folder in zip(plans, folders, strict=True)]
    return _continue(plans, folders, console)


def tell_where(
    plans: Sequence[Plan], folders: Sequence[RunFolder], iteration: int, console: Console
) -> None:
    """Shows which runs begin or go on."""
    paths = [folder.path for folder in folders]
    if plans[0].path is not None:
        tell_some(console, "continuing {} after iteration " + str(iteration), paths)
        return
    tell_some(console, "run folder: {}", paths)
    setup = plans[0].setup
    try:
        check_tasks(setup.demos, setup.env)
    except DemoError as error:
        tell(console, f"note: tasks are those that {setup.demos_path} demonstrates ({error})")


def _start(setup: Setup, folder: RunFolder) -> Progressed:
    record = provenance(setup.demos_path, setup.outer_path)
    write_json(folder.provenance, {**record, "resumed": []})
    save_config(setup.config, folder.config)  # last: a folder that has it is a run
    return initial(setup)


def _continue(
    plans: Sequence[Plan], folders: Sequence[RunFolder], console: Console
) -> list[Progressed]:
    pairs = list(zip(plans, folders, strict=True))
    notes: dict[str, None] = {}  # each once
    now = provenance(plans[0].setup.demos_path, plans[0].setup.outer_path)
    first = [_checked_provenance(plan.setup, folder, now, notes) for plan, folder in pairs]
    restored = [_restored(plan.setup, folder, console) for plan, folder in pairs]
    # runs that were killed together may be a checkpoint apart
    common = min(progressed.iteration for progressed in restored)
    restored = [
        own if own.iteration == common else _restored(plan.setup, folder, console, common)
        for (plan, folder), own in zip(pairs, restored, strict=True)
    ]
    for note in notes:
        tell(console, note)
    iterations = plans[0].setup.config.meta.iterations
    if common > iterations:
        raise ConfigError(
            f"meta.iterations={iterations} is not allowed: {folders[0].path} has done "
            f"{common} already"
        )
    for (plan, folder), record in zip(pairs, first, strict=True):
        if not folder.finished or common < iterations:
            with Checkpoints(folder.checkpoints) as checkpoints:
                checkpoints.drop_after(common)
            drop_after(folder, common)
            folder.results.unlink(missing_ok=True)
            folder.diverged.unlink(missing_ok=True)
            save_config(plan.setup.config, folder.config)
            write_json(folder.provenance, {**record, "resumed": [*record["resumed"], now]})
    return restored


def _checked_provenance(setup: Setup, folder: RunFolder, now: dict, notes: dict[str, None]) -> dict:
    """How the run began, with notes on what is different now."""
    first = read_provenance(folder.provenance)
    for name, path in (("demos", setup.demos_path), ("outer_demos", setup.outer_path)):
        began, is_now = (record.get(name, {}).get("sha256") for record in (first, now))
        if began != is_now:
            raise ConfigError(
                f"{path} has changed since {folder.path} began: it cannot be continued"
            )
    for what in ("code", "packages"):
        if first[what] != now[what]:
            notes[f"note: not the same {what} as when the run began; results may differ"] = None
    return first


def _restored(
    setup: Setup, folder: RunFolder, console: Console, at_most: int | None = None
) -> Progressed:
    """The newest checkpoint of a run, or its start if it was stopped before the first one."""
    records = read_metrics(folder.metrics)  # first: a broken file is refused before any change
    start = initial(setup)
    with Checkpoints(folder.checkpoints) as checkpoints:
        note = lambda text: tell(console, f"note: {text}")  # noqa: E731
        restored = checkpoints.restore(start, note, at_most)
    if restored is None and records and at_most is None:
        raise ConfigError(
            f"{folder.checkpoints} has no checkpoint, though {folder.metrics.name} tells of "
            f"{len(records)} iterations: it cannot be continued"
        )
    progressed = restored or start
    if at_most is not None and progressed.iteration != at_most:
        raise ConfigError(
            f"{folder.path} has no checkpoint of iteration {at_most}, where other runs stand: "
            f"continue it alone ({folder.resume_command}) or with those as far as it, joined by "
            f"{os.pathsep!r}"
        )
    records = records[: progressed.iteration]
    told = [record["iteration"] for record in records if "adapt/return_0" in record]
    if told != list(range(progressed.iteration)):
        raise ConfigError(
            f"{folder.metrics} does not tell of the {progressed.iteration} iterations that the "
            "newest checkpoint has had, one a line: it cannot be continued"
        )
    return progressed
