"""Programs handed to a launcher of Hydra's, as sweeps over environments and algorithms."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from emrld_jax.runs.signals import StopSignals
from emrld_jax.study.programs import Program
from emrld_jax.study.running import POLL_S, Outcome, log_of, run_all


def sweeps(programs: Sequence[Program], launcher: str) -> list[list[str]]:
    """Arguments of `emrld_jax.sweep` that train these programs, none of which has begun."""
    columns: dict[Program, dict[str, list[str]]] = {}  # algorithms by environment
    for program in programs:
        same = program._replace(env="", algo="")
        columns.setdefault(same, {}).setdefault(program.env, []).append(program.algo)
    made = []
    for same, algos_of in columns.items():
        for algos in dict.fromkeys(map(tuple, algos_of.values())):
            envs = [env for env, own in algos_of.items() if tuple(own) == algos]
            made.append([f"hydra/launcher={launcher}", *_arguments(same, envs, algos)])
    return made


def _arguments(same: Program, envs: Sequence[str], algos: Sequence[str]) -> list[str]:
    program = same._replace(env=",".join(envs), algo=",".join(algos))
    alone = program._replace(grid=())
    varied = [f"{number}={','.join(f'{x:g}' for x in values)}" for number, values in program.grid]
    return [*alone.arguments(program.seeds[0], len(program.seeds)), *varied]


def launch_all(
    programs: Sequence[Program], launcher: str, watch: Callable[[Sequence[Program], float], None]
) -> Outcome:
    """Hands over what has not begun, all at once, and waits; what has begun is not continued.

    Then the runs are evaluated, here.
    """
    new = [p for p in programs if not any(folder.config.is_file() for folder in p.folders)]
    start = time.monotonic()
    with StopSignals() as stop, ExitStack() as ending:
        children = []
        for arguments in sweeps(new, launcher):
            child = subprocess.Popen(
                [sys.executable, "-m", "emrld_jax.sweep", *arguments], stdin=subprocess.DEVNULL
            )
            ending.callback(_end, child)
            children.append(child)
        while stop.received is None and any(child.poll() is None for child in children):
            time.sleep(POLL_S)
            watch(new, time.monotonic() - start)
    if stop.received is not None:
        return Outcome([], stop.exit_code)
    trained = [p for p in programs if all(folder.finished for folder in p.folders)]
    evaluated = run_all(trained, watch)
    left = [(p, log_of(p)) for p in programs if p not in trained]
    return Outcome([*evaluated.failed, *left], evaluated.exit_code)


def _end(child: subprocess.Popen) -> None:
    """Asks a sweep to stop, if it goes on, and waits for it."""
    if child.poll() is None:
        child.send_signal(signal.SIGTERM)
    child.wait()
