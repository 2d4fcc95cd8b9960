"""Training runs: set-up, the loop, and how they stop, fail, end or go on."""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from emrld_jax.demos import DemoError, check_tasks
from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.config import ConfigError, TrainConfig, save_config
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder, new_run_folder
from emrld_jax.runs.iteration import DivergenceError, initial, iterate, streams
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.progress import ProgressView, figures, tell
from emrld_jax.runs.provenance import provenance, read_provenance
from emrld_jax.runs.recording import Recording
from emrld_jax.runs.report import report
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.runs.signals import StopSignals


class Run(NamedTuple):
    """A run that goes on: what it works with, where it writes, how far it is."""

    setup: Setup
    folder: RunFolder
    progressed: Progressed


def train(config: TrainConfig, console: Console) -> int:
    """Trains as configured, each seed as a run of its own, or continues a run.

    Returns:
        The exit code: 0, 1 if training diverged, or that of the signal that stopped it.

    Raises:
        ConfigError, DemoError: the configuration or its demonstrations are refused.
    """
    setups = _of_seeds(set_up(config))
    folders = [_folder(setup, console) for setup in setups]
    begin = _start if config.resume is None else _continue
    with ExitStack() as locks:
        for folder in folders:
            locks.enter_context(folder.locked())
        with StopSignals() as stop:
            pairs = zip(setups, folders, strict=True)
            runs = [Run(setup, folder, begin(setup, folder, console)) for setup, folder in pairs]
            if folders[0].finished:  # a run that is resumed; new ones are not
                _tell_finished(runs[0], console)
                return 0
            try:
                runs = _loop(runs, stop, console)
            except DivergenceError as error:
                tell(Console(stderr=True), f"error: {error}")
                if len(runs) > 1:  # the others may go on alone
                    _tell_how_to_go_on(runs, console)
                return 1
        if stop.received is not None:
            tell(console, f"Stopped after iteration {runs[0].progressed.iteration}; all is saved.")
            _tell_how_to_go_on(runs, console)
            return stop.exit_code
        return _finish(runs, console)


def _of_seeds(setup: Setup) -> list[Setup]:
    """A set-up for each seed; from its folder, such a run looks as if it was the only one."""
    config = setup.config
    seeds = range(config.seed, config.seed + config.num_seeds)
    return [setup._replace(config=replace(config, seed=seed, num_seeds=1)) for seed in seeds]


def _finish(runs: Sequence[Run], console: Console) -> int:
    """Evaluates, draws and writes results.json. A signal ends it; runs can then be resumed."""
    tell(console, "evaluating and drawing (all is saved)")
    try:
        for setup, folder, progressed in runs:
            report(setup, folder, progressed.state.params, streams(progressed.key)[2], console)
    except KeyboardInterrupt:
        tell(console, "Stopped before the final table; all is saved.")
        _tell_how_to_go_on([run for run in runs if not run.folder.finished], console)
        return 128 + signal.SIGINT
    return 0


def _tell_finished(run: Run, console: Console) -> None:
    folder = run.folder
    tell(console, f"{folder.path} is finished: {run.progressed.iteration} meta-iterations.")
    tell(console, f"To go on: {folder.resume_command} meta.iterations=MORE")
    tell(console, f"To evaluate: python -m emrld_jax.evaluate run={folder.path}")


def _tell_how_to_go_on(runs: Sequence[Run], console: Console) -> None:
    for run in runs:
        tell(console, f"To go on: {run.folder.resume_command}")


def _folder(setup: Setup, console: Console) -> RunFolder:
    """The folder of the run to continue, or a new one."""
    if setup.config.resume is not None:
        return RunFolder(Path(setup.config.resume))
    folder, note = new_run_folder(setup.config)
    if note:
        tell(console, note)
    return folder


def _start(setup: Setup, folder: RunFolder, console: Console) -> Progressed:
    save_config(setup.config, folder.config)
    write_json(folder.provenance, {**provenance(setup.demos_path), "resumed": []})
    tell(console, f"run folder: {folder.path}")
    try:
        check_tasks(setup.demos, setup.env)
    except DemoError as error:
        tell(console, f"note: tasks are those that {setup.demos_path} demonstrates ({error})")
    return initial(setup)


def _continue(setup: Setup, folder: RunFolder, console: Console) -> Progressed:
    first, now = read_provenance(folder.provenance), provenance(setup.demos_path)
    if first["demos"]["sha256"] != now["demos"]["sha256"]:
        raise ConfigError(
            f"{setup.demos_path} has changed since {folder.path} began: it cannot be continued"
        )
    for what in ("code", "packages"):
        if first[what] != now[what]:
            tell(console, f"note: not the same {what} as when the run began; results may differ")
    progressed = _restored(setup, folder, console)
    iterations = setup.config.meta.iterations
    if progressed.iteration > iterations:
        raise ConfigError(
            f"meta.iterations={iterations} is not allowed: {folder.path} has done "
            f"{progressed.iteration} already"
        )
    if not folder.finished or progressed.iteration < iterations:
        folder.results.unlink(missing_ok=True)
        save_config(replace(setup.config, resume=None), folder.config)
        write_json(folder.provenance, {**first, "resumed": [*first["resumed"], now]})
        tell(console, f"continuing {folder.path} after iteration {progressed.iteration}")
    return progressed


def _restored(setup: Setup, folder: RunFolder, console: Console) -> Progressed:
    """The newest checkpoint of a run, or its start if it was stopped before the first one."""
    records = read_metrics(folder.metrics)  # first: a broken file is refused before any change
    progressed = initial(setup)
    with Checkpoints(folder.checkpoints) as checkpoints:
        restored = checkpoints.restore(progressed, lambda text: tell(console, f"note: {text}"))
    if restored is None and records:
        raise ConfigError(
            f"{folder.checkpoints} has no checkpoint, though {folder.metrics.name} tells of "
            f"{len(records)} iterations: it cannot be continued"
        )
    progressed = restored or progressed
    records = records[: progressed.iteration]
    told = [record["iteration"] for record in records if "adapt/return_0" in record]
    if told != list(range(progressed.iteration)):
        raise ConfigError(
            f"{folder.metrics} does not tell of the {progressed.iteration} iterations that the "
            "newest checkpoint has had, one a line: it cannot be continued"
        )
    return progressed


def _loop(runs: list[Run], stop: StopSignals, console: Console) -> list[Run]:
    """Iterates until the last iteration or a signal; where the runs then stand is saved."""
    end, start = runs[0].setup.config.meta.iterations, runs[0].progressed.iteration
    with ExitStack() as stack:
        view = stack.enter_context(ProgressView(console, start, end))
        recordings = [stack.enter_context(_recording(run, console)) for run in runs]
        done = start
        while done < end and stop.received is None:
            began = time.perf_counter()
            results = iterate(runs[0].setup, [run.progressed for run in runs])
            seconds = time.perf_counter() - began
            runs = [
                run._replace(progressed=progressed)
                for run, (progressed, _) in zip(runs, results, strict=True)
            ]
            records = [
                recording.add(*result, seconds)
                for recording, result in zip(recordings, results, strict=True)
            ]
            done += 1
            view.show(done, figures(records), seconds)
    return runs


def _recording(run: Run, console: Console) -> Recording:
    return Recording(run.folder, run.progressed, run.setup.config.checkpoint_every, console)
