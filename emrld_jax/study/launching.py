"""Programs handed to a launcher of Hydra's, as sweeps over environments and algorithms."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from emrld_jax.runs.signals import StopSignals
from emrld_jax.study.programs import Program
from emrld_jax.study.running import POLL_S, Outcome, run_all


class Sweep(NamedTuple):
    """Programs that one command of `emrld_jax.sweep` trains."""

    programs: list[Program]
    arguments: list[str]


def sweeps(programs: Sequence[Program], launcher: str) -> list[Sweep]:
    """What trains these programs, none of which has begun."""
    columns: dict[Program, dict[str, list[str]]] = {}  # algorithms by environment
    for program in programs:
        same = program._replace(env="", algo="")
        columns.setdefault(same, {}).setdefault(program.env, []).append(program.algo)
    made = []
    for same, algos_of in columns.items():
        for algos in dict.fromkeys(map(tuple, algos_of.values())):
            envs = [env for env, own in algos_of.items() if tuple(own) == algos]
            arguments = [f"hydra/launcher={launcher}", *_arguments(same, envs, algos)]
            own = [same._replace(env=env, algo=algo) for env in envs for algo in algos]
            made.append(Sweep(own, arguments))
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

    Then the runs are evaluated, here. What a sweep says is in a log of its own.
    """
    new = [p for p in programs if not any(folder.config.is_file() for folder in p.folders)]
    start = time.monotonic()
    log_by_program: dict[Program, Path] = {}
    with StopSignals() as stop, ExitStack() as ending:
        children = []
        for number, sweep in enumerate(sweeps(new, launcher)):
            log = sweep.programs[0].runs / "logs" / f"sweep{number}.log"
            log_by_program |= dict.fromkeys(sweep.programs, log)
            children.append(child := _begin(sweep, log))
            ending.callback(_end, child)
        while stop.received is None and any(child.poll() is None for child in children):
            time.sleep(POLL_S)
            watch(new, time.monotonic() - start)
    if stop.received is not None:
        return Outcome([], stop.exit_code)
    trained = [p for p in programs if all(folder.finished for folder in p.folders)]
    evaluated = run_all(trained, watch)
    left = [(p, log_by_program.get(p)) for p in programs if p not in trained]
    return Outcome([*evaluated.failed, *left], evaluated.exit_code)


def _begin(sweep: Sweep, log: Path) -> subprocess.Popen:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "emrld_jax.sweep", *sweep.arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
        )


def _end(child: subprocess.Popen) -> None:
    """Asks a sweep to stop, if it goes on, and waits for it."""
    if child.poll() is None:
        child.send_signal(signal.SIGTERM)
    child.wait()
