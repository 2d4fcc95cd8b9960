"""Problems with few states and actions, on which each term of the theorem is exact (NumPy).

S states, A actions. Policies are tables [S, A] whose rows sum to 1. float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emrld_jax.theory.bound import Terms


class Problem(NamedTuple):
    """A Markov decision problem: one task."""

    transition: np.ndarray  # [S, A, S], probabilities of the next state
    reward: np.ndarray  # [S, A]
    start: np.ndarray  # [S], probabilities of the first state
    discount: float  # below 1
    living: np.ndarray  # [S], 1; 0 for a state that is an episode's end (stays, rewards 0)


def random_problem(
    rng: np.random.Generator, states: int, actions: int, discount: float, ending: float = 0.0
) -> Problem:
    """Random transitions (Dirichlet), rewards (normal) and first states (Dirichlet).

    With `ending` above 0 the last state is the end, which each step leads to with this probability.
    """
    transition = rng.dirichlet(np.full(states, 0.5), (states, actions))
    reward = rng.normal(size=(states, actions))
    start, living = rng.dirichlet(np.ones(states)), np.ones(states)
    if ending:
        living[-1] = start[-1] = 0.0
        transition[..., -1] = 0.0
        transition *= (1.0 - ending) / transition.sum(-1, keepdims=True)
        transition[..., -1] = ending
        transition[-1], reward[-1] = np.eye(states)[-1], 0.0
    return Problem(transition, reward, start / start.sum(), discount, living)


def random_policy(rng: np.random.Generator, states: int, actions: int) -> np.ndarray:
    """Rows that are uniform over all distributions. [S, A]."""
    return rng.dirichlet(np.ones(actions), states)


def visitation(problem: Problem, policy: np.ndarray) -> np.ndarray:
    """d = (1 - discount) sum_t discount^t P(s_t = .), which sums to 1. [S]."""
    matrix = np.eye(len(problem.start)) - problem.discount * _step(problem, policy).T
    return (1.0 - problem.discount) * np.linalg.solve(matrix, problem.start)


def values(problem: Problem, policy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V [S] and Q [S, A] of the policy."""
    matrix = np.eye(len(problem.start)) - problem.discount * _step(problem, policy)
    v = np.linalg.solve(matrix, np.sum(policy * problem.reward, axis=1))
    return v, problem.reward + problem.discount * problem.transition @ v


def advantage(problem: Problem, policy: np.ndarray) -> np.ndarray:
    """Q - V of the policy. [S, A]."""
    v, q = values(problem, policy)
    return q - v[:, None]


def performance(problem: Problem, policy: np.ndarray) -> float:
    """J: the expected discounted return from the first state."""
    return float(problem.start @ values(problem, policy)[0])


def total_variation(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Half the sum of |p - q| over actions, which is 0 to 1. [.., A] -> [..]."""
    return 0.5 * np.abs(p - q).sum(axis=-1)


def terms(
    problems: Sequence[Problem],
    old: Sequence[np.ndarray],
    new: Sequence[np.ndarray],
    demonstrators: Sequence[np.ndarray],
) -> Terms:
    """The terms of the bound for tasks that are equally likely and as much discounted.

    Delta is the best one that Assumption 3.1 allows: the least over tasks and living states of the
    demonstrator's expected advantage over the old adapted policy. It may be negative.

    Args:
        problems: one a task.
        old: the policies adapted from the old meta-parameters, [S, A] each.
        new: from the new ones.
        demonstrators: what demonstrations are of.
    """
    gains = [advantage(*pair) for pair in zip(problems, old, strict=True)]
    steps_old = [_steps(*pair) for pair in zip(problems, old, strict=True)]
    steps_new = [_steps(*pair) for pair in zip(problems, new, strict=True)]
    shown = zip(problems, demonstrators, gains, strict=True)
    total_old, total_new = np.sum(steps_old), np.sum(steps_new)
    changes = zip(steps_old, new, old, strict=True)
    misses = zip(steps_new, new, demonstrators, strict=True)
    return Terms(
        surrogate=np.mean(
            [w @ np.sum(n * a, axis=1) for w, n, a in zip(steps_old, new, gains, strict=True)]
        ),
        tv_old=sum(w @ total_variation(n, o) for w, n, o in changes) / total_old,
        tv_demonstrator=sum(w @ total_variation(n, d) for w, n, d in misses) / total_new,
        delta=min(np.sum(d * a, axis=1)[p.living > 0].min() for p, d, a in shown),
        c1=max(np.abs(a).max() for a in gains),
        steps_old=total_old / len(problems),
        steps_new=total_new / len(problems),
    )


def softmax(logits: np.ndarray) -> np.ndarray:
    """The policy of these logits. [S, A] -> [S, A]."""
    powers = np.exp(logits - logits.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def adapt(
    problem: Problem,
    demonstrator: np.ndarray,
    logits: np.ndarray,
    learning_rate: float,
    w_rl: float,
    w_bc: float,
) -> np.ndarray:
    """EMRLD's inner step on a softmax policy's logits, with exact gradients. [S, A] -> [S, A].

    The policy gradient is the expectation over the policy's own steps, the demonstrations' gradient
    that over the demonstrator's, as the means over steps are that adaptation samples.
    """
    policy = softmax(logits)
    own = visitation(problem, policy) * problem.living
    shown = visitation(problem, demonstrator) * problem.living
    policy_gradient = own[:, None] * policy * advantage(problem, policy)
    cloning = shown[:, None] * (demonstrator - policy)
    return logits + learning_rate * (w_rl * policy_gradient + w_bc * cloning)


def greedy(table: np.ndarray) -> np.ndarray:
    """The policy that takes the action of the largest entry. [S, A] -> [S, A]."""
    return np.eye(table.shape[1])[table.argmax(axis=1)]


def optimal(problem: Problem) -> np.ndarray:
    """A policy of the largest value, by policy iteration. [S, A]."""
    policy = greedy(problem.reward)
    while not np.array_equal(better := greedy(values(problem, policy)[1].round(12)), policy):
        policy = better
    return policy


def _step(problem: Problem, policy: np.ndarray) -> np.ndarray:
    """Transition probabilities under the policy, [S, S]."""
    return np.einsum("sa,sat->st", policy, problem.transition)


def _steps(problem: Problem, policy: np.ndarray) -> np.ndarray:
    """The discounted number of steps in each living state. [S]."""
    return visitation(problem, policy) * problem.living / (1.0 - problem.discount)
