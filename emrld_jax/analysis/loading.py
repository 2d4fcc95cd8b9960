"""Run folders, read to be compared: whole ones only; the others are named, with the reason."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from emrld_jax import algorithms
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.provenance import read_provenance
from emrld_jax.runs.saved import by_full_name

NONE = "none"  # in place of demonstrations, of algorithms that take none
SPARSE = "sparse"  # the reward of all runs that do not say another
SPLITS = ("train", "test")  # training and held-out tasks
PARTS = ("config.yaml", "metrics.jsonl", "results.json", "provenance.json")  # of a run folder
NEEDED = ("algo", "demos", "seed", "env.name", "meta.iterations", "adapt.num_steps")


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
        return str(self.settings["algo"])

    @property
    def demonstrations(self) -> str:
        """The quality of shipped demonstrations, or the name of a file; NONE if it takes none."""
        taken = algorithms.takes_demonstrations(self.algorithm)
        return Path(str(self.settings["demos"])).stem if taken else NONE

    @property
    def seed(self) -> int:
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
    """A folder that is left out."""

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
                runs.append(load_run(path))
            except ConfigError as error:
                skipped.append(Skipped(path, str(error)))
    return Loaded(runs, skipped)


def _candidates(folder: Path) -> Iterator[Path]:
    """Folders that look like runs; nothing is looked for inside of them."""
    for place, inside, files in os.walk(folder):
        if any(part in files for part in PARTS):
            inside.clear()
            yield Path(place)
        inside[:] = sorted(name for name in inside if not name.startswith("."))


def load_run(path: Path) -> Run:
    """Reads a run folder.

    Raises:
        ConfigError: it is not that of a finished run, or a file is damaged; says which.
    """
    folder = RunFolder(path)
    settings = _settings(folder)
    iterations = settings["meta.iterations"]
    columns = _columns(folder)
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
    results = _results(folder.results)
    return Run(
        path, settings, columns, results, _evaluations(folder, iterations), _provenance(folder)
    )


def commit(code: dict[str, Any]) -> str:
    """A commit in short, with a plus if files differed from it."""
    return str(code.get("commit", "unknown"))[:10] + "+" * bool(code.get("dirty"))


def _settings(folder: RunFolder) -> dict[str, Any]:
    """All settings by full name. Other versions had others, so they are not checked further."""
    if not folder.config.is_file():
        raise ConfigError("not a run folder of emrld_jax.train: it has no config.yaml")
    try:
        settings = by_full_name(yaml.safe_load(folder.config.read_text()))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"config.yaml cannot be read: {str(error).splitlines()[0]}") from error
    if missing := [name for name in NEEDED if name not in settings]:
        raise ConfigError(
            f"not a run folder of emrld_jax.train: config.yaml lacks {', '.join(missing)}"
        )
    for name in ("seed", "meta.iterations", "adapt.num_steps"):
        if type(settings[name]) is not int:
            raise ConfigError(f"config.yaml: {name}={settings[name]} is not a whole number")
    return settings


def _columns(folder: RunFolder) -> dict[str, np.ndarray]:
    """Metrics that every iteration has, by name."""
    records = read_metrics(folder.metrics)
    if [record["iteration"] for record in records] != list(range(len(records))):
        raise ConfigError("metrics.jsonl does not tell of one iteration after the other")
    names = set.intersection(*(set(record) for record in records)) if records else set()
    columns = {name: _numbers(name, [record[name] for record in records]) for name in sorted(names)}
    for name in ("adapt/return_0", "adapt/success_0", "sampling/env_steps", "time/iteration_s"):
        if records and name not in columns:
            raise ConfigError(f"metrics.jsonl: {name} is missing in some lines")
    return columns


def _numbers(name: str, values: list[Any]) -> np.ndarray:
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise ConfigError(f"metrics.jsonl: {name} is not a finite number in some lines")
    return np.array(values, float)


def _results(path: Path) -> dict[str, Any]:
    """The final table, checked."""
    results = _json(path)
    if not any(results.get(split) for split in SPLITS):
        raise ConfigError(f"{path.name} has results of neither {' nor '.join(SPLITS)}")
    for split in SPLITS:
        if results.get(split) is not None:
            _check_stages(path, results[split])
            if not _is_number(results[split].get("demonstrations", {}).get("return")):
                raise ConfigError(f"{path.name} lacks the demonstrations' return")
    return results


def _check_stages(path: Path, entry: Any) -> None:
    """Refuses what is not a list of stages with finite returns and successes."""
    stages = entry.get("stages") if isinstance(entry, dict) else None
    fits = isinstance(stages, list) and bool(stages)
    for k, stage in enumerate(stages if fits and stages else ()):
        fits = fits and isinstance(stage, dict) and stage.get("adaptation_steps") == k
        fits = fits and _is_number(stage.get("return")) and _is_number(stage.get("success"))
    if not fits:
        raise ConfigError(
            f"{path.name} lacks a finite return or success after 0, 1, .. adaptation steps"
        )


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _evaluations(folder: RunFolder, iterations: int) -> dict[str, dict[str, Any]]:
    """Evaluations of the finished policy; those of earlier checkpoints tell of another one."""
    found = {}
    for path in sorted(folder.evaluations.glob("*/evaluation.json")):
        try:
            entry = _json(path)
            _check_stages(path, entry)
        except ConfigError:  # a damaged one takes nothing from the run itself
            continue
        if entry.get("iteration") == iterations and isinstance(entry.get("configuration"), dict):
            found[path.parent.name] = entry
    return found


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path.name} cannot be read: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path.name} is not a table of names and values")
    return value


def _provenance(folder: RunFolder) -> dict[str, Any]:
    record = read_provenance(folder.provenance)
    whole = [each for each in (record, *record["resumed"]) if isinstance(each, dict)]
    if not all(isinstance(each.get("code"), dict) for each in whole) or len(whole) != 1 + len(
        record["resumed"]
    ):
        raise ConfigError("provenance.json lacks the code's commit")
    return record
