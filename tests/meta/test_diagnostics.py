"""The terms of Theorem 3.2 as estimated from episodes, against sums written out in NumPy."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax.demos import replayed
from emrld_jax.meta.diagnostics import Estimates, Estimation, Shown, diagnose, estimate
from emrld_jax.meta.inner import InnerStep, enhanced_loss
from emrld_jax.meta.learner import MetaLearner, meta_learner
from emrld_jax.meta.outer_losses import adapted_surrogate
from emrld_jax.meta.trpo import trpo
from emrld_jax.policy import Policy, gaussian_policy, total_variation
from emrld_jax.sampling.rollouts import collector
from emrld_jax.types import Demos, Gaussian, Params, Played, Trajectory
from envs_jax import make
from envs_jax.point2d import Point2D
from tests.runs.straight import STEPS, straight_lines

HOW = Estimation(discount=0.9, gae_lambda=1.0, horizon=6)


def gaussian(mean: Any, std: Any) -> Gaussian:
    return Gaussian(jnp.asarray(mean, float), jnp.log(jnp.asarray(std, float)))


@pytest.mark.parametrize("distance", [0.0, 0.1, 1.0, 3.0])
def test_the_total_variation_of_equal_deviations_is_exact(distance: float) -> None:
    """Half the integral of |p - q|, in the plane."""
    x = np.linspace(-8, 8, 401)
    grid = np.stack(np.meshgrid(x, x), axis=-1)
    std, shift = np.array([0.5, 2.0]), distance * np.array([0.6, 0.8])

    def density(mean: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * np.sum((grid - mean) ** 2, axis=-1)) / (2 * np.pi)  # in deviations

    expected = 0.5 * np.sum(np.abs(density(np.zeros(2)) - density(shift))) * (x[1] - x[0]) ** 2
    found = total_variation(gaussian([0.0, 0.0], std), gaussian(shift * std, std))
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize(("shift", "ratio"), [(0.0, 1.2), (0.5, 0.7), (0.5, 1.1), (4.0, 3.0)])
def test_the_total_variation_of_other_deviations_is_bounded(shift: float, ratio: float) -> None:
    x = np.linspace(-30, 30, 60001)

    def density(mean: float, std: float) -> np.ndarray:
        return np.exp(-0.5 * ((x - mean) / std) ** 2) / (std * math.sqrt(2 * np.pi))

    exact = 0.5 * np.sum(np.abs(density(0.0, 1.0) - density(shift, ratio))) * (x[1] - x[0])
    found = float(total_variation(gaussian([0.0], [1.0]), gaussian([shift], [ratio])))
    assert exact <= found <= min(1.0, 2 * exact + 0.05)


def constant_policy(std: float) -> tuple[Policy, Params]:
    """A linear policy of two actions, and parameters of the mean 0."""
    policy = gaussian_policy(2, 2, hidden_sizes=(), std=std)
    return policy, jax.tree.map(jnp.zeros_like, policy.init(jax.random.key(0)))


def with_mean(params: Params, mean: Any) -> Params:
    return jax.tree.map(lambda x: jnp.asarray(mean, float) if x.ndim == 1 else x, params)


def episodes(rng: np.random.Generator, lengths: tuple[int, ...]) -> Trajectory:
    """Random episodes of these lengths, [E, 6, ..], that the environment ended if shorter."""
    shape = (len(lengths), HOW.horizon)
    mask = (np.arange(shape[1]) < np.array(lengths)[:, None]).astype(float)
    obs, action = rng.normal(size=(2, *shape, 2))
    reward = rng.normal(size=shape) * mask
    done = mask * (np.arange(shape[1]) == np.array(lengths)[:, None] - 1)
    none = np.zeros(shape)
    arrays = (obs, action, reward, done, none, none, mask, none)
    return Trajectory(*map(jnp.asarray, arrays))


def shown_steps(rng: np.random.Generator, length: int, padded: int, ended: bool) -> Shown:
    mask = (np.arange(padded) < length).astype(float)
    obs, action = rng.normal(size=(2, padded, 2))
    reward = rng.normal(size=padded)
    done = (np.arange(padded) == length - 1) * float(ended)
    arrays = (obs, action, reward, done, np.zeros(padded), mask, rng.normal(size=2))
    played = Played(*map(jnp.asarray, arrays))
    return Shown(Demos(played.obs, played.action, played.mask), played)


def features(obs: np.ndarray, t: int) -> np.ndarray:
    x = 0.01 * t
    return np.concatenate([obs, obs**2, [x, x**2, x**3, 1.0]])


def written_out(
    before: Any, after: Any, shown: Any, old: np.ndarray, new: np.ndarray, std: float
) -> dict[str, Any]:
    """`estimate` for policies of constant means, as loops over steps."""
    g = HOW.discount
    living = [(e, t) for e, t in np.ndindex(*before.mask.shape) if before.mask[e, t]]
    later = {
        (e, t): sum(
            g ** (k - t) * before.reward[e, k] for k in range(t, HOW.horizon) if before.mask[e, k]
        )
        for e, t in living
    }
    x = np.array([features(before.obs[e, t], t) for e, t in living])
    y = np.array([later[step] for step in living])
    w = np.linalg.solve(x.T @ x + 1e-5 * np.eye(x.shape[1]), x.T @ y)
    gain = {(e, t): later[e, t] - features(before.obs[e, t], t) @ w for e, t in living}
    number = before.mask.shape[0]

    def log_density(action: np.ndarray, mean: np.ndarray) -> float:
        return float(-0.5 * np.sum(((action - mean) / std) ** 2))

    def distance(p: np.ndarray, q: np.ndarray) -> float:
        return math.erf(np.linalg.norm((p - q) / std) / (2 * math.sqrt(2)))

    surrogate = 0.0
    for e, t in living:
        a = before.action[e, t]
        ratio = math.exp(log_density(a, new) - log_density(a, old))
        surrogate += g**t * (ratio - 1) * gain[e, t] / number
    n = int(shown.played.mask.sum())
    states = [*shown.played.obs[:n], shown.played.last_obs]
    v: list[Any] = [features(state, t) @ w for t, state in enumerate(states)]
    if shown.played.done[n - 1] or n == HOW.horizon:
        v[n] = 0.0
    gains = [shown.played.reward[t] + g * v[t + 1] - v[t] for t in range(n)]

    def total(x: Any, discount: float) -> float:
        return float(np.mean(np.sum(x.reward * x.mask * discount ** np.arange(HOW.horizon), 1)))

    return {
        "surrogate": surrogate,
        "tv_old": sum(g**t * distance(old, new) for _, t in living) / number,
        "tv_demonstrator": sum(g**t * distance(new, shown.played.action[t]) for t in range(n)),
        "least_gain": min(gains),
        "total_gain": sum(g**t * shown.played.reward[t] for t in range(n))
        + g**n * v[n]
        - total(before, g),
        "largest": max(map(abs, [*gain.values(), *gains])),
        "steps_old": sum(g**t for _, t in living) / number,
        "steps_new": sum(g**t for e, t in np.ndindex(*after.mask.shape) if after.mask[e, t]) / 4,
        "steps_shown": sum(g**t for t in range(n)),
        "improvement": total(after, g) - total(before, g),
        "improvement_undiscounted": total(after, 1.0) - total(before, 1.0),
    }


@pytest.mark.parametrize(("length", "ended"), [(3, True), (3, False), (6, False), (7, False)])
def test_each_term_of_a_task_is_the_sum_it_says(length: int, ended: bool) -> None:
    """For demonstrations that end, stop early, and last to the horizon or longer (cut there)."""
    rng = np.random.default_rng(length)
    before, after = episodes(rng, (6, 4, 6, 5)), episodes(rng, (6, 6, 2, 1))
    shown = shown_steps(rng, min(length, HOW.horizon), 7, ended)
    policy, params = constant_policy(std=0.7)
    old, new = np.array([0.1, -0.2]), np.array([0.3, 0.25])
    adapted = (with_mean(params, mean) for mean in (old, new))
    found = jax.jit(lambda a, b: estimate(policy, HOW, a, before, b, after, shown))(*adapted)
    first, then, demonstration = (jax.tree.map(np.asarray, x) for x in (before, after, shown))
    expected = written_out(first, then, demonstration, old, new, std=0.7)
    assert set(expected) == set(Estimates._fields)
    for name, value in expected.items():
        own = getattr(found, name)
        np.testing.assert_allclose(own, value, rtol=2e-3, atol=2e-4, err_msg=name)


def line_learner(rate: float) -> tuple[MetaLearner, Any, Estimation, Any, Shown]:
    """Behavior cloning of straight lines to three goals, in Point2D."""
    env = make("point2d", horizon=25, reward_radius=0.15)
    assert isinstance(env, Point2D)
    policy = gaussian_policy(2, 2, hidden_sizes=(8,), std=0.3)
    collect = collector(env, policy, 3, 0.9, 1.0)
    step = InnerStep(enhanced_loss(0.2, 1.0), rate, on_policy=True, first_order=False)
    learner = meta_learner(
        policy,
        (step,),
        collect,
        adapted_surrogate(),
        trpo(),
    )
    lines = straight_lines(env, env.train_tasks().goal[:3])
    shown = Shown(lines.demos, replayed(env, lines.tasks, lines.demos))
    return learner, collect, Estimation(0.9, 1.0, 25), lines, shown


def test_a_step_that_changes_nothing_improves_nothing_and_a_line_is_worth_its_return() -> None:
    learner, collect, how, lines, shown = line_learner(rate=0.0)
    params = learner.init(jax.random.key(0)).params
    found = jax.jit(lambda *x: diagnose(learner, collect, how, params, params, *x))(
        jax.random.key(1), lines.tasks, shown
    )
    for name in ("surrogate", "tv_old", "improvement", "improvement_undiscounted"):
        assert float(found[f"theory/{name}"]) == 0.0
    assert float(found["theory/steps_old"]) == float(found["theory/steps_new"])
    # no episode of a first policy sees the goal: the values are 0, and so are all steps' gains
    # but the last two: 0.1 m from the goal, and at it, which pays 25 - 19 - 1
    np.testing.assert_allclose(found["theory/delta"], 0.0, atol=1e-6)
    np.testing.assert_allclose(found["theory/c1"], 5.0, rtol=1e-5)
    rewards = 0.9 ** np.arange(STEPS) * np.array([0.0] * 18 + [0.9, 5.0])
    steps = np.sum(0.9 ** np.arange(STEPS))
    np.testing.assert_allclose(found["theory/delta_mean"], rewards.sum() / steps, rtol=1e-3)
    # what is published, from the parts
    tv, c1, long = (float(found[f"theory/{n}"]) for n in ("tv_demonstrator", "c1", "steps_new"))
    np.testing.assert_allclose(found["theory/bound"], -2 * c1 * long * tv, rtol=1e-4)


def test_policies_that_move_to_the_demonstrator_come_closer_and_earn_more() -> None:
    """Meta-parameters that were cloned from one line adapt better than random ones."""
    learner, collect, how, lines, shown = line_learner(rate=0.0)
    goal = jax.tree.map(lambda x: x[:1], (lines.tasks, shown))
    old = learner.init(jax.random.key(0)).params
    new = old
    cloning = jax.jit(
        jax.grad(
            lambda p: jnp.mean(
                (learner.policy.apply(p, shown.demos.obs[0]).mean - shown.demos.action[0]) ** 2
            )
        )
    )
    for _ in range(300):
        new = jax.tree.map(lambda p, g: p - 0.3 * g, new, cloning(new))
    measured = jax.jit(lambda a, b: diagnose(learner, collect, how, a, b, jax.random.key(1), *goal))
    there, back = measured(old, new), measured(new, old)
    assert float(there["theory/improvement"]) > 0
    assert float(there["theory/improvement"]) == pytest.approx(-float(back["theory/improvement"]))
    assert float(there["theory/tv_demonstrator"]) < float(back["theory/tv_demonstrator"]) / 2
    assert float(there["theory/delta_mean"]) > float(back["theory/delta_mean"])
    assert "theory/improvement_se" not in there  # of one task
