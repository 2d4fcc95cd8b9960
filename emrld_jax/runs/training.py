"""A training run: set-up, the loop, and how it stops, fails, ends or goes on."""

from __future__ import annotations

import math
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

from emrld_jax.demos import DemoError, check_tasks
from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.config import ConfigError, TrainConfig, save_config
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder, new_run_folder
from emrld_jax.runs.metrics import MetricsLog, Record, read_metrics
from emrld_jax.runs.progress import ProgressView, figures, tell
from emrld_jax.runs.provenance import provenance, read_provenance
from emrld_jax.runs.report import report
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.runs.signals import StopSignals

PATIENCE = 5  # iterations without a meta-gradient before the user is told
NO_REWARD = (
    f"note: no reward after adaptation in {PATIENCE} iterations, so there is no meta-gradient and "
    "nothing is learned. Another seed may find the first one; so may other demonstrations, or what "
    "lets them move the first policy more: a larger adapt.learning_rate or policy.output_scale, a "
    "smaller policy.std. docs/tuning.md tells what helped where."
)


class DivergenceError(RuntimeError):
    """Training made a number that is not finite."""


def train(config: TrainConfig, console: Console) -> int:
    """Trains as configured, or continues a run.

    Returns:
        The exit code: 0, 1 if training diverged, or that of the signal that stopped it.

    Raises:
        ConfigError, DemoError: the configuration or its demonstrations are refused.
    """
    setup = set_up(config)
    folder = _folder(setup, console)
    with folder.locked():
        with StopSignals() as stop:
            begin = _start if config.resume is None else _continue
            progressed = begin(setup, folder, console)
            if folder.finished:
                tell(console, f"{folder.path} is finished: {progressed.iteration} meta-iterations.")
                tell(console, f"To go on: {folder.resume_command} meta.iterations=MORE")
                tell(console, f"To evaluate: python -m emrld_jax.evaluate run={folder.path}")
                return 0
            try:
                progressed = _loop(setup, folder, progressed, stop, console)
            except DivergenceError as error:
                tell(Console(stderr=True), f"error: {error}")
                return 1
        if stop.received is not None:
            tell(console, f"Stopped after iteration {progressed.iteration}; all is saved.")
            tell(console, f"To go on: {folder.resume_command}")
            return stop.exit_code
        return _finish(setup, folder, progressed, console)


def _finish(setup: Setup, folder: RunFolder, progressed: Progressed, console: Console) -> int:
    """Evaluates, draws and writes results.json. A signal ends it; the run can then be resumed."""
    tell(console, "evaluating and drawing (all is saved)")
    try:
        report(setup, folder, progressed.state.params, streams(progressed.key)[2], console)
    except KeyboardInterrupt:
        tell(console, "Stopped before the final table; all is saved.")
        tell(console, f"To go on: {folder.resume_command}")
        return 128 + signal.SIGINT
    return 0


def streams(key_data: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A run's keys: of the first parameters, the iterations (folded in), the final evaluation."""
    init_key, loop_key, evaluation_key = jax.random.split(jax.random.wrap_key_data(key_data), 3)
    return init_key, loop_key, evaluation_key


def initial(setup: Setup) -> Progressed:
    """A run before its first iteration."""
    key_data = jax.random.key_data(jax.random.key(setup.config.seed))
    return Progressed(setup.learner.init(streams(key_data)[0]), key_data, 0, 0)


def iterate(setup: Setup, progressed: Progressed) -> tuple[Progressed, dict[str, float]]:
    """One meta-iteration; a function of its arguments alone, so that a resumed run is the same run.

    Raises:
        DivergenceError: a metric or a parameter is not finite.
    """
    state, key_data, i, env_steps = progressed
    key = jax.random.fold_in(streams(key_data)[1], i)
    tasks, demos = setup.demos.train.tasks, setup.demos.train.demos
    state, arrays = setup.learner.update(state, key, tasks, demos)
    metrics = {name: float(value) for name, value in jax.device_get(arrays).items()}
    _check_finite(i, metrics, state.params)
    episodes = demos.mask.shape[0] * setup.config.adapt.num_episodes
    lengths = (value for name, value in metrics.items() if name.startswith("adapt/length_"))
    env_steps += sum(round(length * episodes) for length in lengths)
    return Progressed(state, key_data, i + 1, env_steps), metrics


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


def _loop(
    setup: Setup, folder: RunFolder, progressed: Progressed, stop: StopSignals, console: Console
) -> Progressed:
    """Iterates until the last iteration or a signal; the state that it returns is saved."""
    config, start = setup.config, progressed.iteration
    with (
        Checkpoints(folder.checkpoints) as checkpoints,
        MetricsLog(folder.metrics, folder.tensorboard, start) as log,
        ProgressView(console, start, config.meta.iterations) as view,
    ):
        checkpoints.save(progressed)  # so that iterations never are without a checkpoint
        unrewarded = 0  # iterations in a row
        try:
            while progressed.iteration < config.meta.iterations and stop.received is None:
                began = time.perf_counter()
                progressed, metrics = iterate(setup, progressed)
                record = _record(progressed, metrics, time.perf_counter() - began)
                log.write(record)
                view.show(progressed.iteration, figures(record), record["time/iteration_s"])
                unrewarded = 0 if record["outer/gradient_norm"] else unrewarded + 1
                if unrewarded == PATIENCE:
                    tell(console, NO_REWARD)
                if progressed.iteration % config.checkpoint_every == 0:
                    checkpoints.save(progressed)
        finally:  # also where it diverged: `progressed` is then the last good state
            checkpoints.save(progressed)
    return progressed


def _record(progressed: Progressed, metrics: dict[str, float], seconds: float) -> Record:
    return {
        "iteration": progressed.iteration - 1,
        **metrics,
        "sampling/env_steps": progressed.env_steps,
        "time/iteration_s": seconds,
    }


def _check_finite(i: int, metrics: dict[str, float], params: Any) -> None:
    wrong = [name for name, value in metrics.items() if not math.isfinite(value)]
    if not all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(params)):
        wrong.append("a parameter")
    if wrong:
        raise DivergenceError(
            f"iteration {i + 1} made {', '.join(wrong)} infinite or NaN; the state before it is "
            "saved. A smaller adapt.learning_rate or meta.max_kl may help, in a new run."
        )
