"""Run folders, read to be compared: whole ones only; the others are named, with the reason."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emrld_jax import algorithms
from emrld_jax.analysis.run_files import (
    SPLITS,
    read_columns,
    read_evaluations,
    read_origin,
    read_results,
    read_settings,
)
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.folder import RunFolder

__all__ = ["NONE", "SPARSE", "SPLITS", "Loaded", "Run", "Skipped", "load_run", "load_runs"]

NONE = "none"  # in place of demonstrations, of algorithms that take none
SPARSE = "sparse"  # the reward of all runs that do not say another
PARTS = ("config.yaml", "metrics.jsonl", "results.json", "provenance.json")  # of a run folder


class Run(NamedTuple):
    """A finished run."""

    path: Path
    settings: dict[str, Any]  # by full name, as its version of the code had them
    metrics: dict[str, np.ndarray]  # by name, [iterations]
    results: dict[str, Any]  # the final table, by split; None for a split without tasks
    evaluations: dict[str, dict[str, Any]]  # what emrld_jax.evaluate wrote, by its folder's name
    provenance: dict[str, Any]

    @property
    def environment(self) -> str:
        """Its name, and the reward if it is not sparse: returns are then no others' equals."""
        name = str(self.settings["env.name"])
        return name if self.reward == SPARSE else f"{name} ({self.reward} reward)"

    @property
    def reward(self) -> str:
        """The kind of reward."""
        return str(self.settings.get("env.reward", SPARSE))

    @property
    def algorithm(self) -> str:
        """Its name, as `algo` has it."""
        return str(self.settings["algo"])

    @property
    def demonstrations(self) -> str:
        """The quality of shipped demonstrations, or the name of a file; NONE if it takes none."""
        taken = algorithms.takes_demonstrations(self.algorithm)
        return Path(str(self.settings["demos"])).stem if taken else NONE

    @property
    def seed(self) -> int:
        """What the run's random numbers come from."""
        return int(self.settings["seed"])

    @property
    def commits(self) -> tuple[str, ...]:
        """Commits of the code that trained it, in order; more than one if it was resumed."""
        records = (self.provenance, *self.provenance["resumed"])
        return tuple(dict.fromkeys(commit(record["code"]) for record in records))

    @property
    def seconds(self) -> float:
        """Wall-clock time of its iterations; of all runs together that trained side by side."""
        return float(np.sum(self.metrics["time/iteration_s"]))

    def stages(self, split: str) -> list[dict[str, Any]]:
        """The final table's entries after 0, 1, .. adaptation steps; none without such tasks."""
        found = self.results.get(split)
        return found["stages"] if found else []


class Skipped(NamedTuple):
    """A folder that is left out: a run, or an evaluation of one that stays."""

    path: Path
    reason: str


class Loaded(NamedTuple):
    """What was found below some folders."""

    runs: list[Run]
    skipped: list[Skipped]


def load_runs(folders: Sequence[str | Path]) -> Loaded:
    """Reads all run folders among these folders and below them.

    Raises:
        ConfigError: a folder is not there.
    """
    runs: list[Run] = []
    skipped: list[Skipped] = []
    seen: set[Path] = set()
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise ConfigError(f"{folder}: there is no such folder")
        candidates = list(_candidates(folder))
        if not candidates:
            skipped.append(Skipped(folder, "no run folder is in it"))
        for path in candidates:
            if (place := path.resolve()) in seen:  # folders may be given along with those in them
                continue
            seen.add(place)
            try:
                run, damaged = load_run(path)
            except ConfigError as error:
                skipped.append(Skipped(path, str(error)))
                continue
            runs.append(run)
            skipped += damaged
    return Loaded(runs, skipped)


def _candidates(folder: Path) -> Iterator[Path]:
    """Folders that look like runs; nothing is looked for inside of them."""
    for place, inside, files in os.walk(folder):
        if any(part in files for part in PARTS):
            inside.clear()
            yield Path(place)
        inside[:] = sorted(name for name in inside if not name.startswith("."))


def load_run(path: Path) -> tuple[Run, list[Skipped]]:
    """Reads a run folder; also names evaluations in it that are damaged, and left out.

    Raises:
        ConfigError: it is not that of a finished run, or a file is damaged; says which.
    """
    folder = RunFolder(path)
    settings = read_settings(folder)
    iterations = settings["meta.iterations"]
    columns = read_columns(folder)
    done = len(columns.get("iteration", ()))
    if not folder.finished:
        raise ConfigError(
            f"interrupted or still training: no results.json, {done} of {iterations} "
            "meta-iterations are done"
        )
    if done != iterations:
        raise ConfigError(
            f"half-written: metrics.jsonl tells of {done} of {iterations} meta-iterations"
        )
    results, origin = read_results(folder.results), read_origin(folder)
    evaluations, damaged = read_evaluations(folder, iterations)
    run = Run(path, settings, columns, results, evaluations, origin)
    return run, [Skipped(place, reason) for place, reason in damaged.items()]


def commit(code: dict[str, Any]) -> str:
    """A commit in short, with a plus if files differed from it."""
    return str(code.get("commit", "unknown"))[:10] + "+" * bool(code.get("dirty"))
