"""Learning curves of groups of runs: each seed's, and their interquartile mean with intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emrld_jax import algorithms
from emrld_jax.analysis.groups import Group
from emrld_jax.analysis.loading import Run
from emrld_jax.analysis.statistics import pointwise
from emrld_jax.runs.metrics import last_stage

AXES = ("iterations", "env_steps", "seconds")  # what a curve may be drawn against
POINTS = 120  # of a curve, at the most


class Curve(NamedTuple):
    """A group's curve; arrays are [X], but for each seed's own."""

    x: np.ndarray
    value: np.ndarray
    low: np.ndarray  # NaN if there is one seed
    high: np.ndarray
    seeds: tuple[int, ...]
    each: np.ndarray  # [seeds, X]


def axis(run: Run, name: str) -> np.ndarray:
    """Where a run stood after each meta-iteration: iterations, environment steps or seconds.

    Raises:
        ValueError: no such axis.
    """
    if name == "iterations":
        return run.metrics["iteration"] + 1.0
    if name == "env_steps":
        return run.metrics["sampling/env_steps"]
    if name == "seconds":
        return np.cumsum(run.metrics["time/iteration_s"])
    raise ValueError(f"{name!r} is not an axis; there are {', '.join(AXES)}")


def curve(
    group: Group,
    measure: str = "return",
    when: str = "after",
    against: str = "iterations",
) -> Curve:
    """What the group's runs collected while they trained, on the training tasks.

    Each run's line is read at common places, linearly between its own, over the part of the axis
    that all runs have.

    Args:
        group: runs that differ in their seed.
        measure: "return" or "success".
        when: "before" adaptation or "after" all its steps.
        against: one of AXES.

    Raises:
        ValueError: no such axis, or no episodes before adaptation (`algorithms.starts_plain`).
    """
    if when == "before" and not algorithms.starts_plain(group.algorithm):
        raise ValueError(f"{group.algorithm} collects nothing before adaptation")
    places = [axis(run, against) for run in group.runs]
    x = _common(places)
    stages = [0 if when == "before" else last_stage(run.metrics) for run in group.runs]
    each = np.array(
        [
            np.interp(x, own, run.metrics[f"adapt/{measure}_{stage}"])
            for own, run, stage in zip(places, group.runs, stages, strict=True)
        ]
    )
    return Curve(x, *pointwise(each), group.seeds, each)


def _common(places: list[np.ndarray]) -> np.ndarray:
    """Places that lie within all runs' axes; their own, thinned, if they are the same."""
    start, end = max(own[0] for own in places), min(own[-1] for own in places)
    if all(np.array_equal(own, places[0]) for own in places):
        count = min(POINTS, len(places[0]))
        index = np.linspace(0, len(places[0]) - 1, count).round().astype(int)
        return places[0][index]
    return np.linspace(start, max(start, end), min(POINTS, max(map(len, places))))
