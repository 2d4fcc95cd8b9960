"""One score of each run, and what groups of runs achieve: the numbers of tables.

A run's score is its mean over tasks (and their episodes) in the final evaluation. Tasks of a run
share one meta-policy, so they are no independent samples: runs are drawn, never single tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from emrld_jax.analysis.groups import Group
from emrld_jax.analysis.loading import SPARSE, SPLITS, Run
from emrld_jax.analysis.statistics import Estimate, aggregate

MEASURES = ("return", "success")
LAST = -1  # the stage after all adaptation steps


def score(run: Run, split: str, measure: str = "return", stage: int = LAST) -> float | None:
    """A run's mean over the split's tasks; None if it has none of them or no such stage.

    Args:
        run: the run.
        split: "train" or "test", the held-out tasks.
        measure: "return" (undiscounted) or "success" (0 to 1).
        stage: after how many adaptation steps; -1 for all.
    """
    stages = run.stages(split)
    return float(stages[stage][measure]) if -len(stages) <= stage < len(stages) else None


def scores(group: Group, split: str, measure: str = "return", stage: int = LAST) -> np.ndarray:
    """The scores of those of the group's runs that have one, [N]."""
    found = (score(run, split, measure, stage) for run in group.runs)
    return np.array([value for value in found if value is not None])


def demonstrated(run: Run, split: str, measure: str = "return") -> float | None:
    """The demonstrations' mean return or success on the split's tasks.

    None if the run has none of them, or tells what they return by another reward than its own:
    versions of before kept the sparse one in any case.
    """
    if not (results := run.results.get(split)):
        return None
    shown = results["demonstrations"]
    same = shown.get("reward", SPARSE) == run.reward
    return float(shown.get(measure, np.nan)) if same else None


def references(groups: Iterable[Group], split: str) -> dict[str, float]:
    """What returns are divided by to be compared between environments, by environment.

    The best mean return of demonstrations among these runs, if it is positive: those that are bad
    on purpose return next to nothing, and a multiple of that would say nothing.
    """
    best: dict[str, float] = {}
    for group in groups:
        for run in group.runs:
            value = demonstrated(run, split)
            if value is not None and value > max(best.get(group.environment, 0.0), 0.0):
                best[group.environment] = value
    return best


class Cell(NamedTuple):
    """A figure of a group: the interquartile mean over its runs, with the interval."""

    estimate: Estimate
    seeds: int


def cell(values: np.ndarray) -> Cell | None:
    """The figure of these runs' scores; None if there are none."""
    return Cell(aggregate([values]), len(values)) if len(values) else None


class Row(NamedTuple):
    """A line of the headline table."""

    group: Group
    cells: dict[tuple[str, str, str], Cell]  # by split, measure and "before" or "after"
    demonstrated: dict[str, float]  # return of the demonstrations, by split
    seconds: float  # of training, mean over runs
    env_steps: float  # mean over runs


def headline(groups: Sequence[Group]) -> list[Row]:
    """What each group achieves before and after adaptation, on both splits."""
    return [_row(group) for group in groups]


def _row(group: Group) -> Row:
    cells = {}
    for split in SPLITS:
        for measure in MEASURES:
            for when, stage in (("before", 0), ("after", LAST)):
                if found := cell(scores(group, split, measure, stage)):
                    cells[split, measure, when] = found
    shown = {split: demonstrated(group.runs[0], split) for split in SPLITS}
    return Row(
        group,
        cells,
        {split: value for split, value in shown.items() if value is not None},
        float(np.mean([run.seconds for run in group.runs])),
        float(np.mean([run.metrics["sampling/env_steps"][-1] for run in group.runs])),
    )


class Adaptation(NamedTuple):
    """Figures after 0, 1, .. adaptation steps."""

    split: str
    source: str  # "final table", or the name of an evaluation
    steps: list[int]
    cells: dict[str, list[Cell]]  # by measure


def adaptations(group: Group) -> list[Adaptation]:
    """Of the final table, and of each evaluation that some of the group's runs have."""
    found = []
    for split in SPLITS:
        tables = [stages for run in group.runs if (stages := run.stages(split))]
        if tables:
            found.append(_adaptation(split, "final table", tables))
    names = dict.fromkeys(name for run in group.runs for name in run.evaluations)
    for name in names:
        entries = [run.evaluations[name] for run in group.runs if name in run.evaluations]
        split = entries[0]["configuration"]["tasks"]
        found.append(_adaptation(split, name, [entry["stages"] for entry in entries]))
    return found


def adaptation_of(group: Group, split: str, is_meant: Callable[[str], bool]) -> Adaptation | None:
    """Of one evaluation of each of the group's runs that has some whose names are meant.

    Args:
        group: runs that differ in their seed.
        split: "train" or "test", of the evaluations.
        is_meant: told an evaluation's name; of several the first one by name counts.
    """
    found = [[own for name, own in run.evaluations.items() if is_meant(name)] for run in group.runs]
    tables = [own[0]["stages"] for own in found if own]
    return _adaptation(split, "evaluations", tables) if tables else None


def _adaptation(split: str, source: str, tables: list[list[dict[str, Any]]]) -> Adaptation:
    count = min(map(len, tables))
    cells = {
        measure: [
            Cell(aggregate([[table[k][measure] for table in tables]]), len(tables))
            for k in range(count)
        ]
        for measure in MEASURES
    }
    return Adaptation(split, source, list(range(count)), cells)
