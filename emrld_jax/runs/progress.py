"""What a run shows while it goes on: a bar on a terminal, else a line an iteration."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emrld_jax.runs.metrics import Record, last_stage

SHOWN = 3  # paths that are named, of many
RECENT = 15  # iterations that the time left is estimated from


class ProgressView:
    """Shows iterations `start` to `end`."""

    def __init__(self, console: Console, start: int, end: int) -> None:
        self._console, self._end = console, end
        self._recent: deque[float] | None = None  # s an iteration
        columns = (
            TextColumn("iteration"),
            MofNCompleteColumn(),
            BarColumn(bar_width=16),
            TextColumn("{task.fields[figures]}"),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("", total=end, completed=start, figures="compiling")

    def show(self, done: int, figures: str, seconds: float) -> None:
        """Tells that `done` iterations are done, the last in this time, with its figures."""
        if self._console.is_terminal:
            self._bar.update(self._task, completed=done, figures=figures)
            return
        line = f"iteration {done}/{self._end}  {figures}{self._left(done, seconds)}"
        tell(self._console, line)

    def _left(self, done: int, seconds: float) -> str:
        """The time left, in words; empty after the first iteration, which compiles."""
        if self._recent is None:
            self._recent = deque(maxlen=RECENT)
            return ""
        self._recent.append(seconds)
        left = (self._end - done) * median(self._recent)
        return f"  {clock(left)} left"

    def __enter__(self) -> Self:
        self._bar.start()
        if not self._console.is_terminal:
            tell(self._console, "compiling the first iteration")
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


def tell(console: Console, text: str) -> None:
    """Shows a text as it is: paths are not wrapped, and brackets are no markup."""
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def tell_some(console: Console, text: str, paths: Sequence[Path]) -> None:
    """Shows a text, in which {} is a path, for each; of many the first ones and how many more."""
    for path in paths[:SHOWN]:
        tell(console, text.format(path))
    if len(paths) > SHOWN:
        tell(console, f"  and {len(paths) - SHOWN} more, the last one {paths[-1]}")


def figures(records: Sequence[Record]) -> str:
    """What matters most of an iteration, in a few words: means over runs."""
    last = last_stage(records[0])

    def mean(name: str) -> float:
        return fmean(record[name] for record in records)

    stages = range(last + 1)
    # runs of older versions did not count them
    broken = fmean(r.get(f"adapt/diverged_{k}", 0.0) for r in records for k in stages)
    before = f"{mean('adapt/return_0'):.1f} -> " * (last > 0)
    return (
        f"return {before}{mean(f'adapt/return_{last}'):.1f}  "
        f"success {mean(f'adapt/success_{last}'):.0%}  KL {mean('outer/kl'):.4f}"
        + f"  {broken:.2%} of simulations broke down" * (broken > 0)
        + f"  (mean of {len(records)} runs)" * (len(records) > 1)
    )


def clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
