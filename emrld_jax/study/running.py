"""Programs carried out side by side, one a core: started, continued, or skipped if finished."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from emrld_jax.runs.launch import HUGE_PAGES
from emrld_jax.runs.signals import StopSignals
from emrld_jax.study.programs import Program

POLL_S = 0.2
LEDGER = "compute.jsonl"  # in the folder of the runs: what each process took
ALONE = "--xla_cpu_multi_thread_eigen=false"  # faster for a program that has one core to itself
SOON = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # compiled in half the time: all that fast ones do


class Outcome(NamedTuple):
    """How carrying out programs ended."""

    failed: Sequence[tuple[Program, Path | None]]  # with the file that says why, if it was tried
    exit_code: int  # of a signal that stopped it; else 0


class _Job:
    """A program that goes on, on one core or, without one, on all of them."""

    def __init__(self, program: Program, core: int | None) -> None:
        self.program, self.core = program, core
        self.log = log_of(program)
        self.log.parent.mkdir(parents=True, exist_ok=True)
        program.clear()
        self._left, self._diverged = program.commands(), len(program.diverged)
        self._process: subprocess.Popen | None = None
        self._next()

    def _next(self) -> None:
        """Starts the next of its commands, if there is one."""
        self._process = None
        if not self._left:
            return
        command, self._began = self._left.pop(0), time.monotonic()
        with self.log.open("a") as out:
            self._process = subprocess.Popen(
                command,
                env=HUGE_PAGES | os.environ | self._flags(),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,  # Ctrl-C reaches it through this process alone
            )
        if self.core is not None:
            with suppress(ProcessLookupError):
                os.sched_setaffinity(self._process.pid, {self.core})

    def _flags(self) -> dict[str, str]:
        own = dict(SOON) if self.program.fast else {}
        if self.core is not None:
            own["XLA_FLAGS"] = f"{ALONE} {os.environ.get('XLA_FLAGS', '')}".strip()
        return own

    def ended(self) -> bool:
        """Whether all of its commands have ended, or one has failed."""
        if self._process is None:
            return True
        pid, status, usage = os.wait4(self._process.pid, os.WNOHANG)
        if not pid:
            return False
        self._process.returncode = os.waitstatus_to_exitcode(status)
        self._note(usage.ru_utime + usage.ru_stime)
        if self._process.returncode:
            self._left = self._without_diverged()
        self._next()
        return self._process is None

    def _without_diverged(self) -> list[list[str]]:
        """What is left after a failure: of runs side by side, those that did not diverge go on."""
        known, self._diverged = self._diverged, len(self.program.diverged)
        return self.program.commands() if self._diverged > known else []

    def _note(self, cpu_s: float) -> None:
        """Adds what a process took to the ledger."""
        took = {"program": self.program.name, "wall_s": time.monotonic() - self._began}
        with (self.program.runs.parent / LEDGER).open("a") as ledger:
            ledger.write(json.dumps({**took, "cpu_s": cpu_s}) + "\n")

    def stop(self) -> None:
        """Asks it to save and end."""
        self._left, self._diverged = [], len(self.program.folders)
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)


def took(runs: Path, programs: Sequence[Program]) -> tuple[dict[str, float], int]:
    """Hours that processes took for programs, trainings and evaluations together.

    Also of those that were stopped or failed; each was on a core of its own, or on all. What a
    launcher or a command of another kind has trained is not known.

    Args:
        runs: the folder of the programs' folders, with the ledger.
        programs: whose time is wanted; others of the folder are not counted.

    Returns:
        The hours, and of how many of the programs they are.
    """
    names = {program.name for program in programs}
    ledger = runs / LEDGER
    lines = ledger.read_text().splitlines() if ledger.is_file() else []
    entries = [entry for line in lines if (entry := _entry(line)) is not None]
    entries = [entry for entry in entries if entry.get("program") in names]
    hours = {
        "process_hours": sum(entry["wall_s"] for entry in entries) / 3600,
        "cpu_hours": sum(entry["cpu_s"] for entry in entries) / 3600,
    }
    return hours, len({entry["program"] for entry in entries})


def _entry(line: str) -> dict | None:
    """A line of the ledger; None for one that a kill cut in half, which no figure may fail of."""
    try:
        entry: dict = json.loads(line)
        return entry if {"wall_s", "cpu_s"} <= set(entry) else None
    except (ValueError, TypeError):
        return None


def log_of(program: Program) -> Path:
    """Where a program's output goes."""
    first = program.folders[0].path.relative_to(program.runs)
    return program.runs / "logs" / ("-".join(first.parts) + ".log")


def run_all(
    programs: Sequence[Program],
    watch: Callable[[Sequence[Program], float], None],
    at_once: int | None = None,
) -> Outcome:
    """Carries out the programs that are not finished, as many at a time as there are cores.

    However it ends, none of them goes on afterwards, unless this process is killed: then they go on
    to their end.

    Args:
        programs: what to carry out.
        watch: is told now and then which go on, and how many seconds have passed.
        at_once: how many at a time, at the most; with one it has all cores.
    """
    waiting = [program for program in programs if not program.finished]
    cores = _cores(at_once)
    jobs: list[_Job] = []
    failed: list[tuple[Program, Path]] = []
    start = time.monotonic()
    with StopSignals() as stop, _hang_up_raises(), _ending(jobs):
        while (waiting or jobs) and stop.received is None:
            while waiting and cores:
                jobs.append(_Job(waiting.pop(0), cores.pop(0)))
            time.sleep(POLL_S)
            watch([job.program for job in jobs], time.monotonic() - start)
            for job in [job for job in jobs if job.ended()]:
                jobs.remove(job)
                cores.append(job.core)
                if not job.program.finished:
                    failed.append((job.program, job.log))
    return Outcome(failed, stop.exit_code)


@contextmanager
def _ending(jobs: list[_Job]) -> Iterator[None]:
    """Stops the jobs that go on at the end, and waits for them."""
    try:
        yield
    finally:
        for job in jobs:
            job.stop()
        while not all(job.ended() for job in jobs):
            time.sleep(POLL_S)


@contextmanager
def _hang_up_raises() -> Iterator[None]:
    """Lets the closing of the terminal end the process in order, unless that is ignored."""

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = signal.getsignal(signal.SIGHUP)
    if before is signal.SIG_IGN:  # as nohup has it
        yield
        return
    signal.signal(signal.SIGHUP, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def _cores(at_once: int | None) -> list[int | None]:
    """A core for each program at a time; where none can be bound, or for one, none of its own."""
    cores: list[int | None] = [None]
    if at_once != 1 and hasattr(os, "sched_getaffinity"):
        cores = [*sorted(os.sched_getaffinity(0))]
    return cores[:at_once]
