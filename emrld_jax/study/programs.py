"""Trainings that share one program, where their runs are, and what finishes them."""

from __future__ import annotations

import os
import re
import shutil
import sys
from itertools import groupby, product
from pathlib import Path
from typing import NamedTuple

from emrld_jax.analysis.run_files import read_evaluation
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.folder import RunFolder

BEFORE_CONFIG = (".lock", "provenance.json")  # files of a run that has no config.yaml yet
MOST_SEEDS = 1000  # of a program
EPISODES, FAST_EPISODES = 50, 2  # a task, of an evaluation after several adaptation steps
FAST = (  # what makes a training short, and its results meaningless
    "meta.iterations=2",
    "adapt.num_episodes=2",
    "policy.hidden_sizes=[8,8]",
    "evaluation_episodes=2",
)

Grid = tuple[tuple[str, tuple[float, ...]], ...]  # numbers by name, and the values of each
Point = tuple[float, ...]  # of a grid: a value of each of its numbers


def is_evaluation(name: str, steps: int, *, fast: bool = False) -> bool:
    """Whether a folder of this name holds a study's evaluation after up to so many steps.

    A number is behind the name if an evaluation was stopped before.
    """
    episodes = FAST_EPISODES if fast else EPISODES
    return bool(re.fullmatch(rf"test-steps{steps}-episodes{episodes}-seed0(_\d+)?", name))


def _is_whole(evaluation: Path) -> bool:
    """Whether tables can be made of an evaluation: it is not cut off, say."""
    try:
        read_evaluation(evaluation)
    except ConfigError:
        return False
    return True


class Program(NamedTuple):
    """Runs of `emrld_jax.train` that differ in their seeds, and perhaps in some numbers."""

    runs: Path  # folder that the run folders are made in
    env: str
    demos: str
    algo: str
    seeds: tuple[int, ...]
    settings: tuple[str, ...] = ()  # more of the command line
    grid: Grid = ()  # of the numbers that they differ in
    steps: int = 0  # each run is evaluated after up to so many adaptation steps, too; 0: is not
    fast: bool = False  # with the settings of FAST

    @property
    def name(self) -> str:
        """What tells it from others, in words."""
        varied = [f"each {number}" for number, _ in self.grid]
        own = f"{self.demos} demonstrations"
        return ", ".join([self.env, self.algo, own, *self.settings, *varied, *["fast"] * self.fast])

    @property
    def points(self) -> list[Point]:
        """The combinations of the grid's values; one, of none, without a grid."""
        return list(product(*(values for _, values in self.grid)))

    def folder(self, seed: int, point: Point = ()) -> RunFolder:
        """Of one of its runs."""
        pairs = zip(self.grid, point, strict=True)
        label = ",".join(f"{number}={value:g}" for (number, _), value in pairs)
        parent = self.runs / self.env / f"{self.algo}-{Path(self.demos).stem}" / label
        return RunFolder(parent / f"seed{seed}")

    @property
    def folders(self) -> list[RunFolder]:
        """Of all its runs."""
        return [self.folder(seed, point) for seed in self.seeds for point in self.points]

    def with_seeds_there(self) -> Program:
        """With its seeds and those up to the last one that has a folder, too."""
        parents = {self.folder(0, point).path.parent for point in self.points}
        found = (re.fullmatch(r"seed(\d+)", p.name) for place in parents for p in place.glob("*"))
        there = [seed for each in found if each and (seed := int(each[1])) < MOST_SEEDS]
        return self._replace(seeds=tuple(range(max((*self.seeds, *there)) + 1)))

    @property
    def finished(self) -> bool:
        return all(folder.finished for folder in self.folders) and not self._unevaluated

    @property
    def diverged(self) -> list[RunFolder]:
        """Of its runs that cannot go on."""
        return [folder for folder in self.folders if folder.diverged.is_file()]

    def clear(self) -> None:
        """Removes what a killed process has left of runs that had not begun yet."""
        for folder in self.folders:
            if folder.path.is_dir() and not folder.config.is_file():
                left = list(folder.path.iterdir())
                if all(file.name in BEFORE_CONFIG for file in left):
                    shutil.rmtree(folder.path)

    def commands(self) -> list[list[str]]:
        """The command lines that finish it: of what has begun, and of what has not."""
        train = [sys.executable, "-m", "emrld_jax.train"]
        begun = [f for f in self.folders if f.config.is_file() and not f.finished]
        going = [str(folder.path) for folder in begun if not folder.diverged.is_file()]
        resumed = [[*train, f"resume={os.pathsep.join(going)}"]] if going else []
        new = [[*train, *self.arguments(first, n)] for first, n in self._new()]
        rest = [[*train, *self._one_point(p).arguments(seed, 1)] for seed, p in self._left_out()]
        return [*resumed, *new, *rest, *map(self._evaluation, self._unevaluated)]

    def arguments(self, seed: int, num_seeds: int) -> list[str]:
        """Of `emrld_jax.train`, for some seeds in a row."""
        chosen = [f"env={self.env}", f"demos={self.demos}", f"algo={self.algo}"]
        chosen += [f"seed={seed}", f"runs={self.runs}", *self.settings]
        chosen += FAST * self.fast
        if num_seeds > 1:
            chosen.append(f"num_seeds={num_seeds}")
        for number, values in self.grid:
            chosen.append(f"vmap.{number}=[{','.join(f'{x:g}' for x in values)}]")
        return chosen

    @property
    def _unevaluated(self) -> list[RunFolder]:
        """Runs that have no whole evaluation after `steps` adaptation steps."""
        there = [f for f in self.folders if self.steps and not f.diverged.is_file()]
        return [
            folder
            for folder in there
            if not any(
                is_evaluation(path.parent.name, self.steps, fast=self.fast) and _is_whole(path)
                for path in folder.evaluations.glob("*/evaluation.json")
            )
        ]

    def _evaluation(self, folder: RunFolder) -> list[str]:
        chosen = [f"run={folder.path}", "tasks=test", f"adapt.num_steps={self.steps}"]
        chosen.append(f"episodes={FAST_EPISODES if self.fast else EPISODES}")
        return [sys.executable, "-m", "emrld_jax.evaluate", *chosen]

    def _new(self) -> list[tuple[int, int]]:
        """Seeds of which no run has begun, as the first and the number of those in a row."""
        new = [seed for seed in self.seeds if not any(self._begun(seed, p) for p in self.points)]
        rows = [list(row) for _, row in groupby(enumerate(new), lambda pair: pair[1] - pair[0])]
        return [(row[0][1], len(row)) for row in rows]

    def _left_out(self) -> list[tuple[int, Point]]:
        """Points that have not begun, of seeds that have at others."""
        pairs = [
            (seed, [p for p in self.points if not self._begun(seed, p)]) for seed in self.seeds
        ]
        return [(s, p) for s, missing in pairs if len(missing) < len(self.points) for p in missing]

    def _one_point(self, point: Point) -> Program:
        """The same at one point of the grid."""
        numbers = (number for number, _ in self.grid)
        return self._replace(grid=tuple((n, (x,)) for n, x in zip(numbers, point, strict=True)))

    def _begun(self, seed: int, point: Point) -> bool:
        return self.folder(seed, point).config.is_file()
