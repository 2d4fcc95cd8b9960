"""The files of one run folder, read and checked: each is whole, or refused with the reason."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import last_stage, read_metrics
from emrld_jax.runs.provenance import read_provenance
from emrld_jax.runs.saved import by_full_name

SPLITS = ("train", "test")  # training and held-out tasks
NEEDED = ("algo", "demos", "seed", "env.name", "meta.iterations", "adapt.num_steps")


def read_settings(folder: RunFolder) -> dict[str, Any]:
    """All settings by full name. Other versions had others, so they are not checked further.

    Raises:
        ConfigError: the file cannot be read, or lacks what the comparison needs.
    """
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


def read_columns(folder: RunFolder) -> dict[str, np.ndarray]:
    """Metrics that every iteration has, by name, [iterations].

    Raises:
        ConfigError: an iteration is missing, or has no finite number where one is needed.
    """
    records = read_metrics(folder.metrics)
    if [record["iteration"] for record in records] != list(range(len(records))):
        raise ConfigError("metrics.jsonl does not tell of one iteration after the other")
    if not records:
        return {}
    names = sorted(set.intersection(*map(set, records)))
    columns = {name: _numbers(name, [record[name] for record in records]) for name in names}
    needed = ["adapt/return_0", "adapt/success_0", "sampling/env_steps", "time/iteration_s"]
    last = last_stage({"adapt/return_0": 0, **dict.fromkeys(set().union(*records))})
    needed += [f"adapt/return_{last}", f"adapt/success_{last}"]
    for name in needed:
        if name not in columns:
            raise ConfigError(f"metrics.jsonl: {name} is missing in some lines")
    return columns


def _numbers(name: str, values: list[Any]) -> np.ndarray:
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise ConfigError(f"metrics.jsonl: {name} is not a finite number in some lines")
    return np.array(values, float)


def read_results(path: Path) -> dict[str, Any]:
    """The final table, by split; None for a split without tasks.

    Raises:
        ConfigError: the file cannot be read, or lacks finite figures of all stages.
    """
    results = _json(path)
    if not any(results.get(split) for split in SPLITS):
        raise ConfigError(f"{path.name} has results of neither {' nor '.join(SPLITS)}")
    for split in SPLITS:
        if results.get(split) is not None:
            _check_stages(path, results[split])
            shown = results[split].get("demonstrations")
            if not isinstance(shown, dict) or not _is_number(shown.get("return")):
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


def read_evaluations(
    folder: RunFolder, iterations: int
) -> tuple[dict[str, dict[str, Any]], dict[Path, str]]:
    """Evaluations of the finished policy; those of earlier checkpoints tell of another one.

    Returns:
        What is in them, by the names of their folders, and reasons why others cannot be used, by
        their folders: a damaged evaluation takes nothing from the run itself.
    """
    found, damaged = {}, {}
    for path in sorted(folder.evaluations.glob("*/evaluation.json")):
        try:
            entry = read_evaluation(path)
        except ConfigError as error:
            damaged[path.parent] = str(error)
            continue
        if entry["iteration"] == iterations:
            found[path.parent.name] = entry
    return found, damaged


def read_evaluation(path: Path) -> dict[str, Any]:
    """An `evaluation.json`.

    Raises:
        ConfigError: the file cannot be read, or lacks something.
    """
    entry = _json(path)
    _check_stages(path, entry)
    if type(entry.get("iteration")) is not int:
        raise ConfigError(f"{path.name} does not say after how many iterations, a whole number")
    configuration = entry.get("configuration")
    if not isinstance(configuration, dict) or configuration.get("tasks") not in SPLITS:
        raise ConfigError(f"{path.name}: configuration.tasks is neither {' nor '.join(SPLITS)}")
    return entry


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path.name} cannot be read: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path.name} is not a table of names and values")
    return value


def read_origin(folder: RunFolder) -> dict[str, Any]:
    """Where the run comes from, with the commit of the code at its start and at each resume.

    Raises:
        ConfigError: the file cannot be read, or lacks something.
    """
    record = read_provenance(folder.provenance)
    whole = [each for each in (record, *record["resumed"]) if isinstance(each, dict)]
    if not all(isinstance(each.get("code"), dict) for each in whole) or len(whole) != 1 + len(
        record["resumed"]
    ):
        raise ConfigError("provenance.json lacks the code's commit")
    return record
