"""Theorem 3.2 where everything is exact: random problems, and one that is worked by hand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from emrld_jax.theory import tabular
from emrld_jax.theory.cases import KINDS, Case, random_case
from emrld_jax.theory.tabular import Problem

ROUNDING = 1e-10


def cases(number: int, ending: float = 0.0) -> Iterator[Case]:
    """So many of each kind."""
    for kind in KINDS:
        for seed in range(number):
            yield random_case(seed, kind, ending)


def bandit(share: float, discount: float, gain: float = 2.0) -> Case:
    """One state that never ends, two actions of reward +-gain, of which the first is shown.

    The old policy takes both equally; the new one is this share of the way to the demonstrator.
    """
    problem = Problem(
        np.ones((1, 2, 1)), np.array([[gain, -gain]]), np.ones(1), discount, np.ones(1)
    )
    old, dem = np.array([[0.5, 0.5]]), np.array([[1.0, 0.0]])
    return Case([problem], [old], [(1 - share) * old + share * dem], [dem])


def test_values_and_visits_of_a_problem_worked_by_hand() -> None:
    """Two states: the first pays 1 and leads to the second, which pays 0 and stays."""
    transition = np.zeros((2, 1, 2))
    transition[:, :, 1] = 1.0
    problem = Problem(transition, np.array([[1.0], [0.0]]), np.array([1.0, 0.0]), 0.9, np.ones(2))
    policy = np.ones((2, 1))
    v, q = tabular.values(problem, policy)
    np.testing.assert_allclose(v, [1.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(q, v[:, None], atol=ROUNDING)
    np.testing.assert_allclose(tabular.visitation(problem, policy), [0.1, 0.9], atol=ROUNDING)
    assert tabular.total_variation(np.array([0.2, 0.8]), np.array([0.5, 0.5])) == pytest.approx(0.3)


def test_visits_and_returns_are_those_of_the_sum_over_time() -> None:
    case = random_case(0, "random policies")
    problem, policy = case.problems[0], case.old[0]
    step = np.einsum("sa,sat->st", policy, problem.transition)
    state, visits, total = problem.start, np.zeros_like(problem.start), 0.0
    for t in range(2000):
        weight = problem.discount**t
        visits += (1 - problem.discount) * weight * state
        total += weight * np.sum(state[:, None] * policy * problem.reward)
        state = state @ step
    np.testing.assert_allclose(tabular.visitation(problem, policy), visits, atol=ROUNDING)
    np.testing.assert_allclose(tabular.performance(problem, policy), total, rtol=1e-9)


def test_the_performance_difference_lemma_is_an_identity() -> None:
    """J(new) - J(old) is the old advantage over the new visits: of each task, and of the mean."""
    for case in [*cases(50), *cases(20, ending=0.2)]:
        totals = []
        for problem, old, new, _ in zip(*case, strict=True):
            gain = np.sum(new * tabular.advantage(problem, old), axis=1)
            expected = tabular.visitation(problem, new) @ gain / (1 - problem.discount)
            found = tabular.performance(problem, new) - tabular.performance(problem, old)
            np.testing.assert_allclose(found, expected, atol=ROUNDING)
            totals.append(expected)
        np.testing.assert_allclose(case.improvement, np.mean(totals), atol=ROUNDING)


@pytest.mark.parametrize("ending", [0.0, 0.2])
@pytest.mark.parametrize("kind", KINDS)
def test_the_bound_holds(kind: str, ending: float) -> None:
    """With episodes that end too, as steps after the end are not counted."""
    for seed in range(150):
        case = random_case(seed, kind, ending)
        assert case.improvement >= case.terms.bound - ROUNDING


def test_the_surrogates_part_is_never_positive() -> None:
    """|E_new A| = |E_new A - E_old A| <= 2 C_1 D_TV: the published bound is below the other part.

    So that part alone is a bound too, and a tighter one.
    """
    for case in [*cases(50), *cases(20, ending=0.2)]:
        assert case.terms.surrogate_part <= ROUNDING
        assert case.improvement >= case.terms.demonstrator_part - ROUNDING


@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_the_factors_are_the_smallest_possible(share: float, discount: float) -> None:
    """The improvement is the bound exactly: share * gain a step; half the L1 distance, times 2."""
    case = bandit(share, discount)
    steps = 1 / (1 - discount)
    assert case.improvement == pytest.approx(share * 2.0 * steps)
    assert case.terms.bound == pytest.approx(case.improvement)
    assert case.terms.delta == pytest.approx(2.0)
    assert case.terms.tv_old == pytest.approx(share / 2)
    assert case.terms.tv_demonstrator == pytest.approx((1 - share) / 2)


@pytest.mark.parametrize(
    "dropped", [("tv_old",), ("tv_demonstrator",), ("tv_old", "tv_demonstrator")]
)
def test_without_a_total_variation_term_it_is_no_bound(dropped: tuple[str, ...]) -> None:
    violated = [
        case.improvement < case.terms._replace(**dict.fromkeys(dropped, 0.0)).bound - 1e-3
        for case in cases(50)
    ]
    assert 0 < sum(violated) < len(violated)


@pytest.mark.parametrize("kept", ["tv_old", "tv_demonstrator"])
def test_half_of_a_factor_is_too_little(kept: str) -> None:
    """The bandit at its bound: with C_1 in place of 2 C_1 for either distance it is violated."""
    case = bandit(0.5, 0.9)
    halved = case.terms._replace(**{kept: getattr(case.terms, kept) / 2})
    assert case.improvement < halved.bound - 1e-3


def test_the_surrogates_part_alone_is_no_bound() -> None:
    """It does not know where the new policy goes: to a state that the old one never saw.

    The new one goes there with probability 0.2 a step and pays 1 a step for ever; the old one would
    pay nothing there. New visits of the first state are 0.1 / (1 - 0.9 * 0.8) = 0.357.
    """
    transition = np.zeros((2, 2, 2))
    transition[0, 0, 0] = transition[0, 1, 1] = 1.0
    transition[1, :, 1] = 1.0
    reward = np.array([[0.0, 0.0], [0.0, -1.0]])
    problem = Problem(transition, reward, np.array([1.0, 0.0]), 0.9, np.ones(2))
    old, new = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[0.8, 0.2], [0.0, 1.0]])
    case = Case([problem], [old], [new], [old])
    assert case.improvement == pytest.approx(-10 * (1 - 0.1 / 0.28))  # -6.4
    assert case.terms.surrogate_part == pytest.approx(-10 * 2 * 0.2)  # -4.0
    assert case.improvement >= case.terms.bound


def without_demonstrator(case: Case) -> float:
    """A bound that knows no demonstrator (Achiam et al. 2017, corollary 1): of one task.

    The visits change by at most 2 discount / (1 - discount) E[D_TV], in half of which the new
    policy's advantage is at most its largest expectation.
    """
    (problem,), (old,), (new,), _ = case
    gain = np.abs(np.sum(new * tabular.advantage(problem, old), axis=1)).max()
    steps = 1 / (1 - problem.discount)
    penalty = 2 * gain * problem.discount * steps**2 * case.terms.tv_old
    return float(case.terms.surrogate - penalty)


def test_a_good_demonstrator_makes_the_bound_tighter_close_to_it() -> None:
    """Delta is positive; the larger lower bound is the demonstrator's."""
    better = 0
    found = [random_case(seed, "near the demonstrator") for seed in range(200)]
    found = [case for case in found if len(case.problems) == 1 and case.problems[0].discount > 0.5]
    for case in found:
        assert case.terms.delta > 0
        assert case.improvement >= without_demonstrator(case) - ROUNDING
        better += case.terms.bound > without_demonstrator(case)
    assert better > 0.9 * len(found) > 20

    exact = bandit(0.9, 0.9)
    assert exact.terms.bound == pytest.approx(exact.improvement)
    assert exact.terms.demonstrator_part > 0 > without_demonstrator(exact)


def test_an_episode_that_ends_counts_delta_for_its_steps_only() -> None:
    """One step, and the end: Delta / (1 - discount), as published, would promise ten times it."""
    transition = np.zeros((2, 2, 2))
    transition[:, :, 1] = 1.0
    reward = np.array([[2.0, -2.0], [0.0, 0.0]])
    problem = Problem(transition, reward, np.array([1.0, 0.0]), 0.9, np.array([1.0, 0.0]))
    old, dem = np.full((2, 2), 0.5), np.array([[1.0, 0.0], [1.0, 0.0]])
    case = Case([problem], [old], [dem], [dem])
    assert case.improvement == pytest.approx(2.0)
    assert (case.terms.steps_new, case.terms.delta) == pytest.approx((1.0, 2.0))
    assert case.terms.bound == pytest.approx(2.0)
    assert case.terms._replace(steps_new=10.0).bound > 2 * case.improvement


def test_an_optimal_demonstrator_need_not_meet_the_assumption() -> None:
    """What an optimal policy does may be bad for who goes on as a bad one: Delta is below 0."""
    signs = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        problem = tabular.random_problem(rng, 4, 3, 0.95)
        best, old = tabular.optimal(problem), tabular.random_policy(rng, 4, 3)
        assert tabular.performance(problem, best) >= tabular.performance(problem, old)
        signs.append(tabular.terms([problem], [old], [best], [best]).delta > 0)
    assert np.mean(signs) == pytest.approx(0.83)  # docs/theory.md


def test_the_inner_step_is_a_gradient_step() -> None:
    """Against finite differences of J and of the demonstrations' expected log-probability."""
    rng = np.random.default_rng(3)
    problem = tabular.random_problem(rng, 4, 3, 0.8)
    dem, theta = tabular.random_policy(rng, 4, 3), rng.normal(size=(4, 3))

    def objective(logits: np.ndarray) -> float:
        policy = tabular.softmax(logits)
        cloned = tabular.visitation(problem, dem) @ np.sum(dem * np.log(policy), axis=1)
        return 0.3 * (1 - 0.8) * tabular.performance(problem, policy) + 0.7 * cloned

    shifts = 1e-6 * np.eye(12).reshape(12, 4, 3)
    slopes = [(objective(theta + s) - objective(theta - s)) / 2e-6 for s in shifts]
    step = tabular.adapt(problem, dem, theta, 0.5, 0.3, 0.7) - theta
    np.testing.assert_allclose(step.ravel(), 0.5 * np.array(slopes), atol=1e-8)
