"""Algorithms compared: on one problem, and over the problems that they share."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from emrld_jax.analysis.groups import Group, on_each_problem
from emrld_jax.analysis.scores import references, scores
from emrld_jax.analysis.statistics import (
    Estimate,
    aggregate,
    performance_profile,
    probability_of_improvement,
)

Problem = tuple[str, str]  # environment and demonstrations

THRESHOLDS = np.linspace(0.0, 1.2, 61)  # of a performance profile
SHARES = {"return": "return / reference", "success": "success"}


class Competitor(NamedTuple):
    """An algorithm's scores on the problems of a comparison."""

    label: str
    seeds: tuple[int, ...]  # how many of each problem
    score: Estimate  # interquartile mean
    profile: Estimate  # share of runs above each of THRESHOLDS


class Improvement(NamedTuple):
    """How probably one algorithm is better than another."""

    first: str
    second: str
    probability: Estimate


class Comparison(NamedTuple):
    """Algorithms on the same problems, by one measure and on one split."""

    problems: tuple[Problem, ...]
    split: str
    measure: str
    references: dict[str, float]  # what returns are divided by, by environment
    competitors: list[Competitor]
    improvements: list[Improvement]


def compare(groups: Sequence[Group], split: str, measure: str) -> list[Comparison]:
    """Over all shared problems, if they are several, then on each problem alone.

    Algorithms without demonstrations stand beside those with each set of them.
    Returns are divided by the environment's reference (`scores.references`); an environment that
    has none is left out.
    """
    groups = on_each_problem(groups)
    found = references(groups, split) if measure == "return" else {}
    table: dict[str, dict[Problem, np.ndarray]] = {}  # by label
    for group in groups:
        values = scores(group, split, measure)
        if len(values) and (measure == "success" or group.environment in found):
            values = values / found.get(group.environment, 1.0)
            table.setdefault(group.label, {})[group.problem] = values
    problems = list(dict.fromkeys(p for group in groups for p in [group.problem]))
    problems = [p for p in problems if any(p in own for own in table.values())]
    sets = [shared(table), *((p,) for p in problems)]
    return [
        _compare(own, table, split, measure, found)
        for own in dict.fromkeys(sets)
        if own and (len(own) > 1 or own in sets[1:])
    ]


def shared(table: dict[str, dict[Problem, np.ndarray]]) -> tuple[Problem, ...]:
    """All problems if two algorithms or more have all, else those that every algorithm has."""
    every = tuple(dict.fromkeys(problem for own in table.values() for problem in own))
    if sum(len(own) == len(every) for own in table.values()) > 1:
        return every
    return tuple(problem for problem in every if all(problem in own for own in table.values()))


def _compare(
    problems: tuple[Problem, ...],
    table: dict[str, dict[Problem, np.ndarray]],
    split: str,
    measure: str,
    found: dict[str, float],
) -> Comparison:
    columns = {
        label: [own[problem] for problem in problems]
        for label, own in table.items()
        if all(problem in own for problem in problems)
    }
    return Comparison(
        problems,
        split,
        measure,
        {environment: found[environment] for environment, _ in problems if environment in found},
        [
            Competitor(
                label,
                tuple(map(len, own)),
                aggregate(own),
                performance_profile(own, THRESHOLDS),
            )
            for label, own in columns.items()
        ],
        [
            Improvement(first, second, probability_of_improvement(columns[first], columns[second]))
            for first, second in combinations(columns, 2)
        ],
    )
