"""Statistics against worked numbers, enumeration of all resamples, and identities.

Where a comment says so, the numbers were also computed with rliable 1.2.0 (which needs pandas below
3, so it is no dependency).
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from emrld_jax.analysis.statistics import (
    aggregate,
    iqm,
    performance_profile,
    pointwise,
    probability_of_improvement,
)

# scores of 5 and 4 runs in two columns; as lists of columns
X = [[0.1, 0.4, 0.7, 0.3, 0.6], [0.9, 0.5, 0.2, 0.8, 0.6]]
Y = [[0.2, 0.4, 0.5, 0.1], [0.7, 0.4, 0.3, 0.9]]


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([4.0, 1.0, 2.0, 100.0], 3.0),  # (2 + 4) / 2
        ([1.0, 2.0, 60.0], 21.0),  # too few to leave any out
        ([9.0, 1.0, 2.0, 3.0, 4.0], 3.0),  # one at each end: (2 + 3 + 4) / 3
        (list(range(12)), 5.5),  # 3 to 8
        ([7.0], 7.0),
    ],
)
def test_the_interquartile_mean(scores: list[float], expected: float) -> None:
    assert iqm(scores) == expected


def test_the_interquartile_mean_of_two_columns() -> None:
    # ten scores: 0.3, 0.4, 0.5, 0.6, 0.6, 0.7 stay; rliable gives 0.51667 and 0.4
    assert aggregate(X).value == pytest.approx(3.1 / 6)
    assert aggregate(Y).value == pytest.approx((0.3 + 0.4 + 0.4 + 0.5) / 4)


def test_no_scores_are_refused() -> None:
    with pytest.raises(ValueError, match="no scores"):
        iqm([])
    with pytest.raises(ValueError, match="each column needs a score"):
        aggregate([[1.0], []])


@pytest.mark.parametrize("place", [0, 3])
def test_a_score_that_is_no_number_is_not_hidden(place: int) -> None:
    """Sorted to an end, or compared, it would go unseen."""
    scores = [1.0, 2.0, 3.0, 4.0]
    scores[place] = np.nan
    for figure in (
        lambda: iqm(scores),
        lambda: iqm(np.array([scores, [1.0, 2.0, 3.0, 4.0]])),
        lambda: aggregate([[1.0, 2.0], scores]),
        lambda: performance_profile([scores], [0.5]),
        lambda: probability_of_improvement([[1.0, 2.0]], [scores]),
        lambda: pointwise(np.array(scores)[:, None]),
    ):
        with pytest.raises(ValueError, match=r"1 of \d scores is NaN"):
            figure()


def test_an_interval_is_that_of_all_possible_resamples() -> None:
    """Of 4 runs there are 256 equally probable resamples, whose middle two count."""
    scores = [0.0, 1.0, 3.0, 7.0]
    middles = [np.mean(sorted(drawn)[1:3]) for drawn in product(scores, repeat=4)]
    low, high = np.percentile(middles, [10, 90])
    found = aggregate([scores], seed=3, resamples=40_000, level=0.8)
    assert found.value == 2.0  # (1 + 3) / 2
    assert (found.low, found.high) == pytest.approx((low, high))


def test_an_interval_is_near_that_of_another_implementation() -> None:
    # rliable, 20000 resamples: 0.3333 to 0.6833
    found = aggregate(X, seed=1, resamples=20_000)
    assert (found.low, found.high) == pytest.approx((0.3333, 0.6833), abs=0.02)


def test_the_bootstrap_is_stratified() -> None:
    """Columns without spread leave no doubt, however far they are from each other."""
    found = aggregate([[0.0, 0.0, 0.0], [10.0, 10.0, 10.0]])
    assert tuple(map(float, found)) == (5.0, 5.0, 5.0)


def test_a_seed_makes_intervals_repeatable() -> None:
    assert aggregate(X, seed=5) == aggregate(X, seed=5)
    assert aggregate(X, seed=5, resamples=50) != aggregate(X, seed=6, resamples=50)


def test_of_one_run_there_is_no_interval() -> None:
    for found in (
        aggregate([[3.0]]),
        aggregate([[3.0], [1.0, 2.0]]),
        performance_profile([[3.0, 4.0], [1.0]], [2.0]),
        probability_of_improvement([[3.0, 4.0]], [[1.0]]),
        pointwise(np.array([[1.0, 2.0]])),
    ):
        assert np.isfinite(found.value).all()
        assert np.isnan(found.low).all()
        assert np.isnan(found.high).all()


def test_columns_may_differ_in_length() -> None:
    found = aggregate([[1.0, 1.0], [3.0, 5.0, 7.0, 9.0]])
    assert found.value == 4.0  # one is left out at each end: (1 + 3 + 5 + 7) / 4
    assert found.low < found.value < found.high


def test_intervals_of_curves_are_those_of_their_points() -> None:
    curves = np.array([[0.0, 5.0, 1.0], [2.0, 5.0, 3.0], [4.0, 5.0, 8.0]])
    found = pointwise(curves, seed=2)
    np.testing.assert_allclose(found.value, [2.0, 5.0, 4.0])
    assert (found.low[1], found.high[1]) == (5.0, 5.0)
    assert (found.low[0], found.high[0]) == (0.0, 4.0)  # each of 1 in 27 resamples: 3.7 %

    apart = np.array([[0.0], [0.0], [0.0], [4.0]])
    shares = pointwise(apart, lambda x: np.asarray(x.mean(axis=-1)))
    assert shares.value == [1.0]  # where the interquartile mean is 0
    assert (shares.low[0], shares.high[0]) == (0.0, 3.0)  # four of the last: 0.4 %; three: 5 %


def test_a_performance_profile() -> None:
    # above 0.25: 4 of 5 and 4 of 5; above 0.55: 2 of 5 and 3 of 5 (rliable: 0.8, 0.5)
    found = performance_profile(X, [0.0, 0.25, 0.55, 0.9], resamples=20_000)
    np.testing.assert_allclose(found.value, [1.0, 0.8, 0.5, 0.0])
    # of rliable, 20000 resamples
    np.testing.assert_allclose(found.low[1:3], [0.5, 0.2], atol=0.1)
    np.testing.assert_allclose(found.high[1:3], [1.0, 0.8], atol=0.1)
    assert (found.low[3], found.high[3]) == (0.0, 0.0)  # a score is not above itself


def test_the_probability_of_improvement() -> None:
    # wins and half ties of 20 pairs: 12.5 and 11 (rliable: 0.5875, with 0.3125 to 0.85)
    found = probability_of_improvement(X, Y, resamples=20_000)
    assert found.value == pytest.approx((12.5 + 11.0) / 40)
    assert (found.low, found.high) == pytest.approx((0.3125, 0.85), abs=0.03)


def test_improvements_of_each_over_the_other_add_up_to_one() -> None:
    forth, back = probability_of_improvement(X, Y), probability_of_improvement(Y, X)
    assert forth.value + back.value == pytest.approx(1.0)
    assert probability_of_improvement(X, X).value == pytest.approx(0.5)
    sure = probability_of_improvement([[2.0, 3.0]], [[0.0, 1.0]])
    assert tuple(map(float, sure)) == (1.0, 1.0, 1.0)


def test_improvement_needs_the_same_columns() -> None:
    with pytest.raises(ValueError, match="2 columns of the first, 1 of the second"):
        probability_of_improvement(X, [[1.0]])
