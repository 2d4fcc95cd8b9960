"""Trainings that share one program, where their runs are, and what finishes them."""

from __future__ import annotations

import os
import sys
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from emrld_jax.runs.folder import RunFolder


class Program(NamedTuple):
    """Runs of `emrld_jax.train` that differ in their seeds, and perhaps in one number."""

    runs: Path  # folder that the run folders are made in
    env: str
    demos: str
    algo: str
    seeds: tuple[int, ...]
    settings: tuple[str, ...] = ()  # more of the command line
    varied: str = ""  # the number that they differ in
    values: tuple[float, ...] = ()  # of it

    @property
    def name(self) -> str:
        """What tells it from others, in words."""
        words = [self.env, self.algo, *[f"{self.demos} demonstrations"], *self.settings]
        return ", ".join([*words, *[f"each {self.varied}"] * bool(self.varied)])

    def folder(self, seed: int, value: float | None = None) -> RunFolder:
        """Of one of its runs."""
        label = "" if value is None else f"{self.varied}={value:g}"
        parent = self.runs / self.env / f"{self.algo}-{Path(self.demos).stem}" / label
        return RunFolder(parent / f"seed{seed}")

    @property
    def folders(self) -> list[RunFolder]:
        """Of all its runs."""
        values = self.values or (None,)
        return [self.folder(seed, value) for seed in self.seeds for value in values]

    @property
    def finished(self) -> bool:
        return all(folder.finished for folder in self.folders)

    def commands(self) -> list[list[str]]:
        """The command lines that finish it: of what has begun, and of what has not."""
        train = [sys.executable, "-m", "emrld_jax.train"]
        begun = [f for f in self.folders if f.config.is_file() and not f.finished]
        paths = os.pathsep.join(str(folder.path) for folder in begun)
        resumed = [[*train, f"resume={paths}"]] if begun else []
        return [*resumed, *([*train, *self.arguments(first, n)] for first, n in self._new())]

    def arguments(self, seed: int, num_seeds: int) -> list[str]:
        """Of `emrld_jax.train`, for some seeds in a row."""
        chosen = [f"env={self.env}", f"demos={self.demos}", f"algo={self.algo}"]
        chosen += [f"seed={seed}", f"runs={self.runs}", *self.settings]
        if num_seeds > 1:
            chosen.append(f"num_seeds={num_seeds}")
        if self.varied:
            chosen.append(f"vmap.{self.varied}=[{','.join(f'{x:g}' for x in self.values)}]")
        return chosen

    def _new(self) -> list[tuple[int, int]]:
        """Seeds of which no run has begun, as the first and the number of those in a row."""
        values = self.values or (None,)
        new = [s for s in self.seeds if not any(self._begun(s, value) for value in values)]
        rows = [list(row) for _, row in groupby(enumerate(new), lambda pair: pair[1] - pair[0])]
        return [(row[0][1], len(row)) for row in rows]

    def _begun(self, seed: int, value: float | None) -> bool:
        return self.folder(seed, value).config.is_file()
