"""Programs carried out side by side, one a core: started, continued, or skipped if finished."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from emrld_jax.runs.launch import HUGE_PAGES
from emrld_jax.runs.signals import StopSignals
from emrld_jax.study.programs import Program

POLL_S = 0.2


class Outcome(NamedTuple):
    """How carrying out programs ended."""

    failed: list[tuple[Program, Path]]  # with the file that says why
    exit_code: int  # of a signal that stopped it; else 0


class _Job:
    """A program that goes on, on one core."""

    def __init__(self, program: Program, core: int | None) -> None:
        self.program, self.core = program, core
        self.log = log_of(program)
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self._left = program.commands()
        self._start()

    def _start(self) -> None:
        pinned = ["taskset", "-c", str(self.core)] if self.core is not None else []
        # a program that shares its one core with nobody is faster than two that share two
        alone = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"} if pinned else {}
        with self.log.open("a") as out:
            self._process = subprocess.Popen(
                [*pinned, *self._left.pop(0)],
                env=HUGE_PAGES | os.environ | alone,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,  # Ctrl-C reaches it through this process alone
            )

    def ended(self) -> int | None:
        """Its exit code; None while it goes on."""
        code = self._process.poll()
        if code == 0 and self._left:
            self._start()
            return None
        return code

    def stop(self) -> None:
        """Asks it to save and end."""
        self._left = []
        with suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGTERM)


def log_of(program: Program) -> Path:
    """Where a program's output goes."""
    first = program.folders[0].path.relative_to(program.runs)
    return program.runs / "logs" / ("-".join(first.parts) + ".log")


def run_all(
    programs: Sequence[Program], watch: Callable[[Sequence[Program], float], None]
) -> Outcome:
    """Carries out the programs that are not finished, as many at a time as there are cores.

    Args:
        watch: is told now and then which go on, and how many seconds have passed.
    """
    waiting = [program for program in programs if not program.finished]
    cores = _cores()
    jobs: list[_Job] = []
    failed: list[tuple[Program, Path]] = []
    start = time.monotonic()
    with StopSignals() as stop:
        while (waiting or jobs) and stop.received is None:
            while waiting and cores:
                jobs.append(_Job(waiting.pop(0), cores.pop(0)))
            time.sleep(POLL_S)
            watch([job.program for job in jobs], time.monotonic() - start)
            for job in [job for job in jobs if job.ended() is not None]:
                jobs.remove(job)
                cores.append(job.core)
                if job.ended() or not job.program.finished:
                    failed.append((job.program, job.log))
        for job in jobs:
            job.stop()
        while any(job.ended() is None for job in jobs):
            time.sleep(POLL_S)
    return Outcome(failed, stop.exit_code)


def _cores() -> list[int | None]:
    """A core for each program at a time; where none can be bound, one that is not."""
    if not hasattr(os, "sched_getaffinity"):
        return [None]
    return [*sorted(os.sched_getaffinity(0))]
