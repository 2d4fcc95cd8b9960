"""Training runs: the loop, and how they stop, fail or end."""

from __future__ import annotations

import resource
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import NamedTuple

from rich.console import Console

from emrld_jax.runs import machines
from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.episodes import EpisodeKeeper
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder, resume_commands
from emrld_jax.runs.iteration import DivergenceError, Standing, Together, initial
from emrld_jax.runs.progress import ProgressView, figures, tell, tell_some
from emrld_jax.runs.recording import Recording
from emrld_jax.runs.report import report_all
from emrld_jax.runs.setup import Setup
from emrld_jax.runs.signals import StopSignals
from emrld_jax.runs.starting import Plan, begin, folder_of, planned, tell_where


class Runs(NamedTuple):
    """The runs of this command."""

    setups: list[Setup]
    together: Together
    iterations: int


class Step(NamedTuple):
    """What an iteration brought."""

    standing: Standing
    metrics: list[dict[str, float]]  # of each run
    seconds: float


def train(config: TrainConfig, console: Console, label: str = "") -> int:
    """Trains as configured, each variant as a run of its own, or continues runs.

    Of several processes the first writes all files; the others only compute.

    Args:
        config: all settings.
        console: where progress is shown.
        label: a folder for new runs between that of the algorithm and those of the seeds.

    Returns:
        The exit code: 0, 1 if training diverged, or that of the signal that stopped it.

    Raises:
        ConfigError, DemoError: the configuration or its demonstrations are refused.
    """
    devices = machines.join(config)
    plans = planned(config, label)
    setups = [plan.setup for plan in plans]
    runs = Runs(setups, Together(setups, devices), setups[0].config.meta.iterations)
    if not machines.is_first():
        return _assist(runs)
    with ExitStack() as locks:
        with StopSignals() as stop:
            with machines.refusals_told():
                folders = _folders(plans, locks, console)
                progressed = begin(plans, folders, console)
            standing = runs.together.begin(machines.from_first(progressed))
            if folders[0].finished:  # a run that is resumed; new ones are not
                _tell_finished(folders, standing, console)
                return 0
            tell_where(plans, folders, standing.iteration, console)
            try:
                standing = _loop(runs, folders, standing, stop, console)
            except DivergenceError as error:
                _tell_of_divergence(error, folders, console)
                return 1
            except machines.ProcessLostError:
                _tell_how_to_go_on(folders, console)
                raise
        if stop.received is not None:
            tell(console, f"Stopped after iteration {standing.iteration}; all is saved.")
            _tell_how_to_go_on(folders, console)
            return stop.exit_code
        return _finish(runs, folders, standing, console)


def _folders(plans: Sequence[Plan], locks: ExitStack, console: Console) -> list[RunFolder]:
    """The folders of the runs, new or to be continued, locked as long as the stack is open."""
    _allow_files(len(plans))
    folders = [folder_of(plan, console) for plan in plans]
    for folder in folders:
        locks.enter_context(folder.locked())
    return folders


def _assist(runs: Runs) -> int:
    """What a process does that writes nothing: it computes along, and ends as the first does."""
    machines.hear_of_refusals()
    start = machines.from_first([initial(setup) for setup in runs.setups])
    with StopSignals() as stop:
        try:
            for _ in _steps(runs, runs.together.begin(start), stop):
                pass
        except DivergenceError:  # the first one tells of it
            return 1
    return stop.exit_code


def _allow_files(runs: int) -> None:
    """Lets the process open as many files as so many runs write at a time.

    Raises:
        ConfigError: the system does not.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = 200 + 4 * runs  # lock, metrics and TensorBoard of each, and one being written
    if hard != resource.RLIM_INFINITY and needed > hard:
        raise ConfigError(
            f"{runs} runs at a time need {needed} open files, and the system allows {hard} "
            "(ulimit -Hn); take fewer num_seeds or values of vmap"
        )
    if soft != resource.RLIM_INFINITY and needed > soft:
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))


def _steps(runs: Runs, standing: Standing, stop: StopSignals) -> Iterator[Step]:
    """Iterations until the last one, or until any process has received a signal."""
    while standing.iteration < runs.iterations:
        with machines.losses_told():
            if number := machines.largest(stop.received or 0):
                stop.received = signal.Signals(number)
                return
            began = time.perf_counter()
            standing, metrics = runs.together.iterate(standing)
        yield Step(standing, metrics, time.perf_counter() - began)


def _loop(
    runs: Runs,
    folders: Sequence[RunFolder],
    standing: Standing,
    stop: StopSignals,
    console: Console,
) -> Standing:
    """Iterates, and keeps the runs' files up to date; where they then stand is saved."""
    every = runs.setups[0].config.checkpoint_every
    keeper = EpisodeKeeper(runs.setups, folders)
    with ExitStack() as stack:
        view = stack.enter_context(ProgressView(console, standing.iteration, runs.iterations))
        recordings = [
            stack.enter_context(Recording(folder, k, standing, every, console))
            for k, folder in enumerate(folders)
        ]
        waiting = [standing]  # for the first checkpoint, so that no compilation delays the start
        for step in _steps(runs, standing, stop):
            standing = step.standing
            records = [
                recording.add(standing, own, step.seconds)
                for recording, own in zip(recordings, step.metrics, strict=True)
            ]
            if standing.iteration % every == 0:
                for moment in (*waiting, standing):
                    keeper.keep(moment)
                waiting = []
            view.show(standing.iteration, figures(records), step.seconds)
    return standing


def _finish(runs: Runs, folders: Sequence[RunFolder], standing: Standing, console: Console) -> int:
    """Evaluates, draws and writes results.json. A signal ends it; runs can then be resumed."""
    tell(console, "evaluating and drawing (all is saved)")
    try:
        report_all(runs.setups, folders, standing, console)
    except KeyboardInterrupt:
        tell(console, "Stopped before the final table; all is saved.")
        _tell_how_to_go_on([folder for folder in folders if not folder.finished], console)
        return 128 + signal.SIGINT
    return 0


def _tell_finished(folders: Sequence[RunFolder], standing: Standing, console: Console) -> None:
    paths = [folder.path for folder in folders]
    tell_some(console, f"{{}} is finished: {standing.iteration} meta-iterations.", paths)
    tell(console, f"To go on: {folders[0].resume_command} meta.iterations=MORE")
    tell(console, f"To evaluate: python -m emrld_jax.evaluate run={paths[0]}")


def _tell_of_divergence(
    error: DivergenceError, folders: Sequence[RunFolder], console: Console
) -> None:
    """Which runs cannot go on, and how the others can."""
    for k in error.runs:
        write_json(folders[k].diverged, {"error": str(error)})
    if len(folders) > 1:
        paths = [folder.path for k, folder in enumerate(folders) if k in error.runs]
        tell_some(console, "{} diverged", paths)
    tell(Console(stderr=True), f"error: {error}")
    healthy = [folder for k, folder in enumerate(folders) if k not in error.runs]
    if healthy:
        _tell_how_to_go_on(healthy, console)


def _tell_how_to_go_on(folders: Sequence[RunFolder], console: Console) -> None:
    """One command for all of them: that of the folder which holds them, if it holds no others."""
    for command in resume_commands(folders):
        tell(console, f"To go on: {command}")
