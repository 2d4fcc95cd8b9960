"""Random tasks with policies before and after a change, of several kinds; all exact."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emrld_jax.theory import tabular
from emrld_jax.theory.bound import Terms
from emrld_jax.theory.tabular import Problem

KINDS = ("random policies", "adapted policies", "meta-gradient", "near the demonstrator")
LEARNING_RATE, W_RL, W_BC = 2.0, 0.2, 1.0  # of the inner step

Policies = list[np.ndarray]  # [S, A] each


class Case(NamedTuple):
    """Tasks, the adapted policies before and after a change, and the demonstrators."""

    problems: list[Problem]
    old: Policies
    new: Policies
    demonstrators: Policies

    @property
    def terms(self) -> Terms:
        """What the bound is made of."""
        return tabular.terms(*self)

    @property
    def improvement(self) -> float:
        """J_meta(new) - J_meta(old)."""
        return _mean_performance(self.problems, self.new) - _mean_performance(
            self.problems, self.old
        )


def random_case(seed: int, kind: str, ending: float = 0.0) -> Case:
    """One to three tasks of two to five states and two to four actions.

    Args:
        seed: of all random numbers, with the kind.
        kind: of KINDS. Of "random policies" all are unrelated. "adapted policies" make EMRLD's
            inner step from meta-parameters that change at random, "meta-gradient" from ones that
            climb. "near the demonstrator" goes at least nine tenths of the way to a demonstrator
            whose advantage over the old policy is positive everywhere.
        ending: probability that a step ends the episode.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    states, actions, tasks = (int(rng.integers(*span)) for span in ((2, 6), (2, 5), (1, 4)))
    discount = rng.choice([0.3, 0.8, 0.95])
    problems = [
        tabular.random_problem(rng, states, actions, discount, ending) for _ in range(tasks)
    ]
    policies = [[tabular.random_policy(rng, states, actions) for _ in problems] for _ in range(3)]
    if kind == "random policies":
        return Case(problems, *policies)
    if kind == "near the demonstrator":
        return _near(problems, policies[0], share=rng.uniform(0.9, 1.0))
    imperfect = zip(problems, policies[0], strict=True)
    demonstrators = [0.9 * tabular.optimal(problem) + 0.1 * noise for problem, noise in imperfect]
    theta, direction = rng.normal(size=(2, states, actions))
    if kind == "meta-gradient":
        direction = _meta_gradient(problems, demonstrators, theta)
    change = rng.choice([0.01, 0.3, 3.0]) * direction / np.linalg.norm(direction)
    before, after = (_adapted(problems, demonstrators, t) for t in (theta, theta + change))
    return Case(problems, before, after, demonstrators)


def _near(problems: list[Problem], old: Policies, share: float) -> Case:
    """Policies that move this share of the way to the best action against the old ones."""
    pairs = zip(problems, old, strict=True)
    demonstrators = [tabular.greedy(tabular.advantage(*pair)) for pair in pairs]
    ways = zip(demonstrators, old, strict=True)
    return Case(problems, old, [share * d + (1 - share) * o for d, o in ways], demonstrators)


def _adapted(problems: list[Problem], demonstrators: Policies, theta: np.ndarray) -> Policies:
    """The policies that one inner step from the meta-parameters leads to."""
    pairs = zip(problems, demonstrators, strict=True)
    steps = [tabular.adapt(p, d, theta, LEARNING_RATE, W_RL, W_BC) for p, d in pairs]
    return [tabular.softmax(logits) for logits in steps]


def _meta_gradient(
    problems: list[Problem], demonstrators: Policies, theta: np.ndarray
) -> np.ndarray:
    """Of J_meta in the meta-parameters, through the adaptation, by central differences."""

    def value(shift: np.ndarray) -> float:
        """J_meta where the meta-parameters are shifted."""
        return _mean_performance(problems, _adapted(problems, demonstrators, theta + shift))

    shifts = 1e-5 * np.eye(theta.size).reshape(-1, *theta.shape)
    slopes = [(value(shift) - value(-shift)) / 2e-5 for shift in shifts]
    return np.array(slopes).reshape(theta.shape)


def _mean_performance(problems: list[Problem], policies: Policies) -> float:
    pairs = zip(problems, policies, strict=True)
    return float(np.mean([tabular.performance(*pair) for pair in pairs]))
