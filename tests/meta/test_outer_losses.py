"""The outer losses against NumPy loops, their gradients against finite differences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from emrld_jax.meta.adaptation import readapt
from emrld_jax.meta.inner import InnerStep, demonstrations, likelihood_ratio, policy_gradient
from emrld_jax.meta.learner import MetaLearner, meta_learner
from emrld_jax.meta.outer import Objective, OuterLoss
from emrld_jax.meta.outer_losses import (
    adapted_demonstrations,
    clipped_surrogate,
    distance_to_adapted,
    exploring_surrogate,
)
from emrld_jax.meta.trpo import trpo
from emrld_jax.policy import Policy
from emrld_jax.types import Experience, Gaussian, OuterDemos, Rollout
from tests.meta.problems import TASKS, random_demos, random_rollout, small_policy, stacked

DEMOS = stacked([random_demos(m) for m in range(TASKS)])


@pytest.fixture(autouse=True)
def _float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def same(own: Any) -> Any:
    """The average over devices where there is one."""
    return own


def rollouts(seed: int) -> Rollout:
    """Of all tasks, with rewards and with the densities of whoever collected them."""
    rng = np.random.default_rng(seed)
    found = stacked([random_rollout(seed + m) for m in range(TASKS)])
    reward, density = rng.normal(size=(2, *found.advantage.shape))
    steps = found.trajectory._replace(reward=jnp.asarray(reward), log_prob=jnp.asarray(density))
    return found._replace(trajectory=steps)


def gaussians(seed: int, like: jax.Array) -> Gaussian:
    rng = np.random.default_rng(seed)
    mean, log_std = 0.3 * rng.normal(size=(2, *like.shape))
    return Gaussian(jnp.asarray(mean), jnp.asarray(log_std))


def density(gaussian: Gaussian, action: Any, m: int, s: int) -> float:
    mean, log_std = np.asarray(gaussian.mean)[m, s], np.asarray(gaussian.log_std)[m, s]
    z = (np.asarray(action)[m, s] - mean) / np.exp(log_std)
    return float(np.mean(-0.5 * z**2 - log_std - 0.5 * np.log(2 * np.pi)))


def kl(p: Gaussian, q: Gaussian, m: int, s: int) -> float:
    """KL(p || q), mean over action dimensions."""
    difference = np.asarray(p.mean)[m, s] - np.asarray(q.mean)[m, s]
    log_p, log_q = np.asarray(p.log_std)[m, s], np.asarray(q.log_std)[m, s]
    ratio = np.exp(2 * (log_p - log_q))
    shift = difference**2 / np.exp(2 * log_q)
    return float(np.mean(log_q - log_p + 0.5 * (ratio + shift - 1)))


def mean_over_steps(of_step: Any, mask: Any, m: int) -> float:
    living = np.flatnonzero(np.asarray(mask)[m])
    return float(np.mean([of_step(m, s) for s in living]))


def test_the_demonstration_loss_is_that_of_the_policies_at_the_demonstrations() -> None:
    new = gaussians(0, DEMOS.action)
    loss = adapted_demonstrations().loss(new, new, None, DEMOS, same)  # type: ignore[arg-type]
    expected = [
        mean_over_steps(lambda m, s: density(new, DEMOS.action, m, s), DEMOS.mask, m)
        for m in range(TASKS)
    ]
    np.testing.assert_allclose(loss, -np.mean(expected), rtol=1e-12)


def test_the_clipped_surrogate_with_its_penalty() -> None:
    inner, outer = rollouts(20), rollouts(50)
    before = [gaussians(seed, inner.trajectory.obs) for seed in (1, 2)]
    after = [gaussians(seed, outer.trajectory.obs) for seed in (3, 4)]
    new, old = (((b,), a) for b, a in zip(before, after, strict=True))
    loss = clipped_surrogate(clip=0.2, kl_penalty=0.7).loss(
        new, old, Experience((inner,), outer), DEMOS, same
    )
    ratios: list[float] = []

    def gain(m: int, s: int) -> float:
        action, advantage = outer.trajectory.action, float(outer.advantage[m, s])
        # densities are means over the two dimensions; the ratio is that of whole actions
        ratio = np.exp(2 * (density(after[0], action, m, s) - density(after[1], action, m, s)))
        ratios.append(ratio)
        return min(ratio * advantage, float(np.clip(ratio, 0.8, 1.2)) * advantage) / 2

    def strayed(m: int, s: int) -> float:
        return kl(before[1], before[0], m, s)

    expected = [
        0.7 * mean_over_steps(strayed, inner.trajectory.mask, m)
        - mean_over_steps(gain, outer.trajectory.mask, m)
        for m in range(TASKS)
    ]
    np.testing.assert_allclose(loss, np.mean(expected), rtol=1e-10)
    assert min(ratios) < 0.8  # or the test would say nothing about clipping
    assert max(ratios) > 1.2


def test_what_was_collected_counts_by_the_return_that_comes_after() -> None:
    inner, outer = rollouts(20), rollouts(50)
    before = [gaussians(seed, inner.trajectory.obs) for seed in (1, 2)]
    after = [gaussians(seed, outer.trajectory.obs) for seed in (3, 4)]
    new, old = (((b,), a) for b, a in zip(before, after, strict=True))
    loss = exploring_surrogate().loss(new, old, Experience((inner,), outer), DEMOS, same)
    rewards = np.asarray(outer.trajectory.reward) * np.asarray(outer.trajectory.mask)
    returns = rewards.sum(axis=1)
    score = (returns - returns.mean()) / returns.std()

    def ratio(policies: list[Gaussian], of: Rollout, m: int, s: int) -> float:
        action = of.trajectory.action
        return float(
            np.exp(density(policies[0], action, m, s) - density(policies[1], action, m, s))
        )

    expected = [
        -mean_over_steps(
            lambda m, s: ratio(after, outer, m, s) * float(outer.advantage[m, s]),
            outer.trajectory.mask,
            m,
        )
        - score[m]
        * mean_over_steps(lambda m, s: ratio(before, inner, m, s), inner.trajectory.mask, m)
        for m in range(TASKS)
    ]
    np.testing.assert_allclose(loss, np.mean(expected), rtol=1e-6)


def test_equal_returns_leave_the_surrogate_alone() -> None:
    inner, outer = rollouts(20), rollouts(50)
    steps = outer.trajectory._replace(reward=jnp.ones_like(outer.trajectory.reward))
    outer = outer._replace(trajectory=steps)
    before = [gaussians(seed, inner.trajectory.obs) for seed in (1, 2)]
    after = gaussians(3, outer.trajectory.obs)
    losses = [
        exploring_surrogate().loss(
            ((b,), after), ((before[0],), after), Experience((inner,), outer), DEMOS, same
        )
        for b in before
    ]
    np.testing.assert_allclose(losses[0], losses[1], rtol=1e-12)


def learner(loss: OuterLoss, step: InnerStep) -> tuple[MetaLearner, Any]:
    """A meta-learner that is given its experience, and parameters for it."""
    policy, params = small_policy()

    def nothing(*_: Any) -> Any:
        raise AssertionError("no episode is collected here")

    return meta_learner(policy, (step,), nothing, loss, trpo()), params


def objective_of(
    loss: OuterLoss, step: InnerStep, outer_demos: OuterDemos = None
) -> tuple[Objective, Any]:
    meta, params = learner(loss, step)
    inner = rollouts(20) if step.on_policy else None
    experience = Experience((inner,), rollouts(50))
    size = DEMOS.mask.shape[1] * 2
    sizes: Any = Experience((size,) if step.on_policy else (None,), size)
    wide = jax.tree.map(lambda x: x[:, None], experience)  # as one episode a task
    return meta.halves.objective(wide, DEMOS, outer_demos, sizes, None, 1), params


GRADIENT = InnerStep(policy_gradient(), 0.3, on_policy=True, first_order=False)


@pytest.mark.parametrize(
    ("loss", "step"),
    [
        (adapted_demonstrations(), InnerStep(demonstrations(), 0.3, False, False)),
        (adapted_demonstrations(), GRADIENT),
        (clipped_surrogate(0.9, 0.5), InnerStep(likelihood_ratio(), 0.1, True, False)),
        (exploring_surrogate(), GRADIENT),
    ],
    ids=["meta_bc", "gmps", "promp", "emaml"],
)
def test_meta_gradients_go_through_the_adaptation(loss: OuterLoss, step: InnerStep) -> None:
    objective, params = objective_of(loss, step)
    flat, unravel = ravel_pytree(params)
    old = objective.outputs(params)
    away = flat + 0.02 * np.random.default_rng(3).normal(size=flat.shape)

    @jax.jit
    def of(x: jax.Array) -> jax.Array:
        return objective.loss(objective.outputs(unravel(x)), old)

    gradient = jax.grad(of)(away)
    for i in np.random.default_rng(4).choice(flat.size, 8, replace=False):
        h = 1e-5 * np.eye(flat.size)[i]
        numeric = (of(away + h) - of(away - h)) / 2e-5
        np.testing.assert_allclose(gradient[i], numeric, rtol=1e-4, atol=1e-8)
    held = jax.tree.map(jax.lax.stop_gradient, step.learning_rate)
    first_order = step._replace(learning_rate=held, first_order=True)
    other, _ = objective_of(loss, first_order)
    shortened = jax.grad(lambda x: other.loss(other.outputs(unravel(x)), old))(away)
    assert np.abs(np.asarray(shortened - gradient)).max() > 1e-4


@pytest.mark.parametrize(
    "step", [InnerStep(demonstrations(), 0.3, False, False), GRADIENT], ids=["meta_bc", "gmps"]
)
def test_the_outer_loss_sees_its_own_demonstrations(step: InnerStep) -> None:
    """Adaptation sees the others, which have another number of steps."""
    policy, _ = small_policy()
    others = stacked([random_demos(7 + m, size=8, living=7 - m) for m in range(TASKS)])
    objective, params = objective_of(adapted_demonstrations(), step, others)
    new = objective.outputs(params)
    inner = (rollouts(20),) if step.on_policy else (None,)
    expected = []
    for m in range(TASKS):
        own, demo, shown = jax.tree.map(lambda x, m=m: x[m], (inner, DEMOS, others))
        adapted = readapt(policy, (step,), params, own, demo)[-1]
        gaussian = jax.tree.map(lambda x: x[None], policy.apply(adapted, shown.obs))
        action = shown.action[None]
        of_steps = [density(gaussian, action, 0, s) for s in range(7 - m)]
        expected.append(-np.mean(of_steps))
    np.testing.assert_allclose(objective.loss(new, new), np.mean(expected), rtol=1e-10)
    plain, _ = objective_of(adapted_demonstrations(), step)
    old = plain.outputs(params)
    assert abs(float(plain.loss(old, old)) - np.mean(expected)) > 1e-3


def test_reptiles_gradient_is_the_way_back_from_the_adapted_parameters() -> None:
    objective, params = objective_of(distance_to_adapted(), GRADIENT)
    policy, _ = small_policy()
    inner = rollouts(20)
    gradient = jax.grad(lambda p: objective.loss(objective.outputs(p), None))(params)
    adapted = [
        readapt(policy, (GRADIENT,), params, (jax.tree.map(lambda x, m=m: x[m], inner),), demo)[-1]
        for m, demo in enumerate([jax.tree.map(lambda x, m=m: x[m], DEMOS) for m in range(TASKS)])
    ]
    mean = jax.tree.map(lambda *x: np.mean(x, axis=0), *adapted)
    expected = jax.tree.map(lambda p, a: np.asarray(p) - a, params, mean)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-10), gradient, expected)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(expected)) > 1e-3


def test_the_likelihood_ratio_has_the_gradient_of_the_policy_gradient_and_more_curvature() -> None:
    """Half the Hessian of -E[advantage * ratio] of whole actions of two dimensions."""
    policy, params = small_policy(())
    rollout, demos = random_rollout(3), random_demos(0)
    flat, unravel = ravel_pytree(params)
    steps = rollout.trajectory

    def densities(x: jax.Array) -> jax.Array:
        gaussian = policy.apply(unravel(x), steps.obs)
        z = (steps.action - gaussian.mean) / jnp.exp(gaussian.log_std)
        return jnp.sum(-0.5 * z**2 - gaussian.log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    collected = rollout._replace(trajectory=steps._replace(log_prob=densities(flat) / 2))

    def of(loss: Any) -> Any:
        return lambda x: loss(policy, unravel(x), collected, demos)

    ratio, plain = of(likelihood_ratio()), of(policy_gradient())
    np.testing.assert_allclose(jax.grad(ratio)(flat), jax.grad(plain)(flat), atol=1e-12)
    slopes = np.asarray(jax.jacobian(densities)(flat))
    weight = np.asarray(rollout.advantage * steps.mask) / float(jnp.sum(steps.mask))
    expected = -np.einsum("s,si,sj->ij", weight, slopes, slopes) / 2
    difference = jax.hessian(ratio)(flat) - jax.hessian(plain)(flat)
    np.testing.assert_allclose(difference, expected, atol=1e-10)
    assert np.abs(expected).max() > 1e-2


def test_the_likelihood_ratios_hessian_is_that_of_the_expected_return() -> None:
    """Of the mean of a Gaussian policy, with a quadratic return of actions of two dimensions.

    J(mean) = E[-a' C a / 2] = -mean' C mean / 2 + a constant, so its Hessian is -C.
    """
    curvature = np.array([[2.0, -0.5], [-0.5, 1.0]])
    mean, std = np.array([0.3, -0.2]), 0.7
    noise = np.random.default_rng(0).normal(size=(200_000, 2))
    actions = np.concatenate([mean + std * noise, mean - std * noise])  # antithetic
    value = -0.5 * np.einsum("si,ij,sj->s", actions, curvature, actions)
    z = (actions - mean) / std
    density = np.mean(-0.5 * z**2 - np.log(std) - 0.5 * np.log(2 * np.pi), axis=-1)

    def apply(params: Any, obs: jax.Array) -> Gaussian:
        wide = jnp.broadcast_to(params, (*obs.shape[:-1], 2))
        return Gaussian(wide, jnp.full_like(wide, np.log(std)))

    policy = Policy(lambda key: jnp.zeros(2), apply)
    like = random_rollout(0)
    ones = jnp.ones(len(actions))
    steps = like.trajectory._replace(
        obs=jnp.zeros((len(actions), 1)),
        action=jnp.asarray(actions),
        mask=ones,
        log_prob=jnp.asarray(density),
    )
    rollout = Rollout(steps, jnp.asarray(value - value.mean()))
    loss = likelihood_ratio()
    hessian = jax.hessian(lambda m: loss(policy, m, rollout, random_demos(0)))(jnp.asarray(mean))
    np.testing.assert_allclose(2 * hessian, curvature, atol=0.06)
    plain = jax.hessian(lambda m: policy_gradient()(policy, m, rollout, random_demos(0)))
    assert np.abs(2 * np.asarray(plain(jnp.asarray(mean))) - curvature).max() > 0.5


def test_the_likelihood_ratio_is_to_whoever_collected() -> None:
    policy, params = small_policy()
    rollout, demos = random_rollout(3), random_demos(0)
    density = np.random.default_rng(0).normal(size=rollout.advantage.shape)
    steps = rollout.trajectory._replace(log_prob=jnp.asarray(density))
    collected = rollout._replace(trajectory=steps)
    gaussian = policy.apply(params, rollout.trajectory.obs)
    z = (rollout.trajectory.action - gaussian.mean) / np.exp(gaussian.log_std)
    own = np.mean(-0.5 * z**2 - gaussian.log_std - 0.5 * np.log(2 * np.pi), axis=-1)
    weight = np.asarray(rollout.trajectory.mask)
    expected = -np.sum(weight * rollout.advantage * np.exp(2 * (own - density))) / weight.sum() / 2
    result = likelihood_ratio()(policy, params, collected, demos)
    np.testing.assert_allclose(result, expected, rtol=1e-10)
    with pytest.raises(ValueError, match="on-policy"):
        likelihood_ratio()(policy, params, None, demos)
