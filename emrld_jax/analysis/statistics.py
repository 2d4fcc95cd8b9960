"""Statistics of few runs (Agarwal et al., Deep RL at the Edge of the Statistical Precipice, 2021).

A score is one number of one run. Scores stand in columns, one a task or environment; columns may
have different numbers of runs. The bootstrap is stratified: it draws runs with replacement within
each column. Intervals are percentiles of what the resamples give; a seed makes them repeatable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

RESAMPLES = 2000  # of a bootstrap
PIECE = 16  # points of a curve that are resampled at a time: all would need much memory
LEVEL = 0.95  # probability that an interval should hold the true value

Column = np.ndarray | Sequence[float]  # [N], the scores of N runs


class Estimate(NamedTuple):
    """A number with its interval; of arrays, one at each point."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def iqm(scores: np.ndarray | Sequence[float], axis: int = -1) -> np.ndarray:
    """The interquartile mean: that of the middle half of the scores.

    A quarter of them, rounded down, is left out at each end, so of fewer than four none is and it
    is their mean.

    Raises:
        ValueError: there are none, or one is NaN (it would be sorted to the end and left out).
    """
    ordered = np.sort(np.moveaxis(np.asarray(scores, float), axis, -1), axis=-1)
    count = ordered.shape[-1]
    if not count:
        raise ValueError("no scores")
    _refuse_nan(ordered)
    cut = count // 4
    return ordered[..., cut : count - cut].mean(axis=-1)


def aggregate(
    columns: Sequence[Column],
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> Estimate:
    """The interquartile mean of all scores together, with its stratified bootstrap interval.

    A column of more runs weighs more. If a column has one run, its spread is not known, and the
    interval is NaN.

    Raises:
        ValueError: a column has no score, or one that is NaN.
    """
    arrays = _arrays(columns)
    value = iqm(np.concatenate(arrays))
    if min(map(len, arrays)) < 2:
        return Estimate(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    generator = np.random.default_rng(seed)
    drawn = [column[_draws(generator, len(column), resamples)] for column in arrays]
    return Estimate(value, *_bounds(iqm(np.concatenate(drawn, axis=1)), level))


def pointwise(
    curves: np.ndarray,
    statistic: Callable[[np.ndarray], np.ndarray] = iqm,
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> Estimate:
    """A statistic over runs at each point of their curves, [N, X], with intervals, [X].

    Whole curves are drawn. Of one run the intervals are NaN.

    Args:
        curves: [N, X].
        statistic: of the last axis, [.., N] -> [..].

    Raises:
        ValueError: of the interquartile mean, if there is no curve or one has a NaN.
    """
    value = statistic(curves.T)
    if len(curves) < 2:
        return Estimate(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    index = _draws(np.random.default_rng(seed), len(curves), resamples)
    pieces = np.array_split(curves, -(-curves.shape[1] // PIECE), axis=1)
    drawn = np.concatenate([statistic(piece.T[:, index]) for piece in pieces])  # [X, R]
    return Estimate(value, *_bounds(drawn.T, level))


def performance_profile(
    columns: Sequence[Column],
    thresholds: np.ndarray | Sequence[float],
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> Estimate:
    """The share of runs whose score is above each threshold, averaged over columns, [X].

    Intervals as `aggregate`'s.

    Raises:
        ValueError: a column has no score, or one that is NaN.
    """
    arrays, above = _arrays(columns), np.asarray(thresholds, float)
    shares = [(column[:, None] > above).astype(float) for column in arrays]
    value = np.mean([share.mean(axis=0) for share in shares], axis=0)
    if min(map(len, arrays)) < 2:
        return Estimate(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    generator = np.random.default_rng(seed)
    drawn = [_counts(generator, len(share), resamples) @ share / len(share) for share in shares]
    return Estimate(value, *_bounds(np.mean(drawn, axis=0), level))


def probability_of_improvement(
    first: Sequence[Column],
    second: Sequence[Column],
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> Estimate:
    """How probably a run of the first has a higher score than one of the second; a tie is half.

    The share of pairs, averaged over columns, which are the same ones of both (Mann-Whitney's U,
    divided by the number of pairs). Intervals as `aggregate`'s.

    Raises:
        ValueError: the numbers of columns differ, or a column has no score, or one that is NaN.
    """
    if len(first) != len(second):
        raise ValueError(f"{len(first)} columns of the first, {len(second)} of the second")
    pairs = list(zip(_arrays(first), _arrays(second), strict=True))
    wins = [(x[:, None] > y) + 0.5 * (x[:, None] == y) for x, y in pairs]  # [N, N'] each
    value = np.mean([own.mean() for own in wins])
    if min(min(own.shape) for own in wins) < 2:
        return Estimate(value, np.array(np.nan), np.array(np.nan))
    generator = np.random.default_rng(seed)
    drawn = []
    for own in wins:
        rows, columns = (_counts(generator, size, resamples) for size in own.shape)
        drawn.append(np.sum((rows @ own) * columns, axis=1) / own.size)
    return Estimate(value, *_bounds(np.mean(drawn, axis=0), level))


def _arrays(columns: Sequence[Column]) -> list[np.ndarray]:
    arrays = [np.asarray(column, float) for column in columns]
    if not arrays or not all(array.ndim == 1 and len(array) for array in arrays):
        raise ValueError("each column needs a score, and there must be a column")
    for array in arrays:
        _refuse_nan(array)  # which no threshold and no other score is below
    return arrays


def _refuse_nan(scores: np.ndarray) -> None:
    if count := int(np.isnan(scores).sum()):
        raise ValueError(f"{count} of {scores.size} scores {'is' if count == 1 else 'are'} NaN")


def _draws(generator: np.random.Generator, count: int, resamples: int) -> np.ndarray:
    """Which runs each resample draws, [R, N]."""
    return generator.integers(count, size=(resamples, count))


def _counts(generator: np.random.Generator, count: int, resamples: int) -> np.ndarray:
    """How often each resample draws each run, [R, N]."""
    chosen = _draws(generator, count, resamples)
    flat = (np.arange(resamples)[:, None] * count + chosen).ravel()
    return np.bincount(flat, minlength=resamples * count).reshape(resamples, count).astype(float)


def _bounds(values: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """The interval that holds the middle part of the resamples, [R, ..] -> [..] each."""
    tail = 50 * (1 - level)
    low, high = np.percentile(values, [tail, 100 - tail], axis=0)
    return low, high
