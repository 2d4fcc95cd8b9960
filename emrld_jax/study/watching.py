"""How far a study is: read from the runs' own files, so that it holds wherever they compute."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import last_stage, read_metrics
from emrld_jax.runs.progress import clock, tell
from emrld_jax.study.programs import Program

EVERY_S = 30.0  # between lines

# CPU seconds of a meta-iteration, roughly: what the time left is shared out by before it is known
WEIGHT = {"point2d": 0.6, "two_wheeled": 1.2, "two_wheeled_drift": 1.0, "half_cheetah": 1.4}


class Watch:
    """Tells now and then how many meta-iterations of a study are done, and the time left."""

    def __init__(
        self,
        programs: Sequence[Program],
        iterations: Callable[[Program], int],
        console: Console,
    ) -> None:
        """Notes where all stand.

        Args:
            programs: of the study.
            iterations: how many meta-iterations each of a program's runs has.
            console: where it is told.
        """
        self._console, self._told = console, -EVERY_S
        self._programs = {program: iterations(program) for program in programs}
        self._total = sum(map(self._weight, self._programs))
        self._before = self._done()

    def __call__(self, going: Sequence[Program], seconds: float) -> None:
        """Tells, if the last time is a while ago."""
        if seconds - self._told < EVERY_S:
            return
        self._told = seconds
        done = self._done()
        finished = sum(program.finished for program in self._programs)
        text = f"{finished}/{len(self._programs)} programs finished, {done / self._total:.0%}"
        if done > self._before:
            left = (self._total - done) * seconds / (done - self._before)
            text += f", about {clock(left)} of training left" if left else ", evaluating"
        tell(self._console, text)
        for program in going:
            tell(self._console, f"  {program.name}: {self._standing(program)}")

    def _weight(self, program: Program) -> float:
        return WEIGHT.get(program.env, 1.0) * self._programs[program] * len(program.folders)

    def _done(self) -> float:
        """Weight of the iterations that are done."""
        return sum(
            WEIGHT.get(program.env, 1.0) * min(_lines(folder.metrics), iterations)
            for program, iterations in self._programs.items()
            for folder in program.folders
        )

    def _standing(self, program: Program) -> str:
        """Of the first of its runs that is not finished, in words."""
        for folder in program.folders:
            if not folder.finished:
                return f"{_standing(folder)} of {self._programs[program]} meta-iterations"
        return "trained, being evaluated" if program.steps else "finished"


def _standing(folder: RunFolder) -> str:
    records = read_metrics(folder.metrics)
    if not records:
        return "0"
    last = records[-1]
    return f"return {last[f'adapt/return_{last_stage(last)}']:.1f} after {len(records)}"


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.is_file() else 0
