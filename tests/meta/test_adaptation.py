"""Adaptation against finite differences in float64 and a gradient written by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import envs_jax
from emrld_jax.meta.adaptation import adapt, descend, readapt
from emrld_jax.meta.inner import InnerStep, enhanced_loss
from emrld_jax.policy import gaussian_policy
from emrld_jax.sampling.rollouts import collector
from emrld_jax.types import Params
from envs_jax.goals import GoalTask
from tests.meta.problems import (
    adapted_objective,
    enhanced_steps,
    random_demos,
    random_rollout,
    small_policy,
)

RATE = 0.3  # large, so that second derivatives weigh


@pytest.fixture(autouse=True)
def _float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


WARM_START = InnerStep(enhanced_loss(0.0, 1.0), RATE, on_policy=False, first_order=False)


def meta_loss(steps: int, first_order: bool = False, warm: bool = False) -> tuple[Callable, Params]:
    """The outer loss as a function of the meta-parameters; old outputs are those at `params`."""
    policy, params = small_policy()
    inner_steps = enhanced_steps(steps, RATE, first_order)
    objective = adapted_objective(policy, (WARM_START, *inner_steps) if warm else inner_steps)[0]
    shifted = jax.tree.map(lambda x: x + 0.05, params)  # so that ratios are not all 1
    old = jax.jit(objective.outputs)(params)
    return jax.jit(lambda p: objective.loss(objective.outputs(p), old)), shifted


def differences(loss: Callable, params: Params, step: float = 1e-5) -> np.ndarray:
    """The gradient by central differences, one parameter after the other."""
    flat, unravel = ravel_pytree(params)
    result = np.zeros(flat.size)
    for i in range(flat.size):
        ahead, behind = flat.at[i].add(step), flat.at[i].add(-step)
        result[i] = (loss(unravel(ahead)) - loss(unravel(behind))) / (2 * step)
    return result


@pytest.mark.parametrize(("steps", "warm"), [(1, False), (2, False), (1, True)])
def test_the_meta_gradient_is_that_of_finite_differences(steps: int, warm: bool) -> None:
    loss, params = meta_loss(steps, warm=warm)
    gradient = np.asarray(ravel_pytree(jax.jit(jax.grad(loss))(params))[0])
    assert gradient.dtype == np.float64
    expected = differences(loss, params)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-8)


def test_the_first_order_gradient_is_the_outer_one_at_the_adapted_parameters() -> None:
    policy, params = small_policy()
    (step,) = enhanced_steps(1, RATE, first_order=True)
    rollout, demos, outer = random_rollout(0), random_demos(0), random_rollout(1)

    def outer_loss(p: Params) -> jax.Array:
        return step.loss(policy, p, outer, demos)

    def through(p: Params) -> jax.Array:
        return outer_loss(readapt(policy, (step,), p, (rollout,), demos)[-1])

    gradient = ravel_pytree(jax.jit(jax.grad(through))(params))[0]
    adapted = readapt(policy, (step,), params, (rollout,), demos)[-1]
    np.testing.assert_allclose(gradient, ravel_pytree(jax.grad(outer_loss)(adapted))[0], rtol=1e-10)


def test_first_order_adapts_alike_but_has_another_gradient() -> None:
    (second, params), (first, _) = meta_loss(1), meta_loss(1, first_order=True)
    np.testing.assert_allclose(first(params), second(params), rtol=1e-12)
    gradients = [np.asarray(ravel_pytree(jax.jit(jax.grad(f))(params))[0]) for f in (first, second)]
    assert np.linalg.norm(gradients[0] - gradients[1]) > 0.05 * np.linalg.norm(gradients[1])


def test_one_inner_step_is_the_gradient_of_a_linear_policy_by_hand() -> None:
    w_rl, w_bc, rate, std = 0.7, 1.3, 0.1, 0.5
    policy = gaussian_policy(2, 2, hidden_sizes=(), std=std, learn_std=True)
    params = jax.tree.map(jnp.float64, policy.init(jax.random.key(0)))
    rollout, demos = random_rollout(0), random_demos(0)
    step = InnerStep(enhanced_loss(w_rl, w_bc), rate, True, False)
    result = descend(policy, step, params, rollout, demos)

    weights, bias = (np.asarray(params["params"]["layer_0"][k]) for k in ("kernel", "bias"))
    steps = rollout.trajectory
    data: list[tuple[Any, ...]] = [
        (steps.obs, steps.action, w_rl * rollout.advantage, steps.mask),
        (demos.obs, demos.action, w_bc * np.ones(len(demos.mask)), demos.mask),
    ]
    kernel_slope, bias_slope, log_std_slope = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
    for obs, action, factors, mask in data:
        living = int(np.sum(mask))
        for s in range(living):
            error = np.asarray(action[s]) - np.asarray(obs[s]) @ weights - bias
            mean_slope = -factors[s] * error / std**2 / 2 / living  # 2 action dimensions
            kernel_slope += np.outer(obs[s], mean_slope)
            bias_slope += mean_slope
            log_std_slope += -factors[s] * (error**2 / std**2 - 1) / 2 / living
    layer = result["params"]["layer_0"]
    np.testing.assert_allclose(layer["kernel"], weights - rate * kernel_slope, rtol=1e-6)
    np.testing.assert_allclose(layer["bias"], bias - rate * bias_slope, rtol=1e-6)
    expected = np.asarray(params["log_std"]) - rate * log_std_slope
    np.testing.assert_allclose(result["log_std"], expected, rtol=1e-6)


def test_what_the_masks_leave_out_changes_nothing() -> None:
    policy, params = small_policy()
    steps, rollout, demos = enhanced_steps(1, RATE), random_rollout(0), random_demos(0)
    garbage = random_rollout(7).trajectory
    away = rollout.trajectory.mask[:, None] == 0
    changed_steps = rollout.trajectory._replace(
        obs=jnp.where(away, 30 * garbage.obs, rollout.trajectory.obs),
        action=jnp.where(away, 30 * garbage.action, rollout.trajectory.action),
    )
    changed_demos = demos._replace(
        obs=jnp.where(demos.mask[:, None] == 0, 40.0, demos.obs),
        action=jnp.where(demos.mask[:, None] == 0, -40.0, demos.action),
    )
    expected = readapt(policy, steps, params, (rollout,), demos)[-1]
    changed = (rollout._replace(trajectory=changed_steps),)
    result = readapt(policy, steps, params, changed, changed_demos)[-1]
    jax.tree.map(np.testing.assert_array_equal, result, expected)


def test_adapting_again_on_the_stored_episodes_gives_the_same_parameters() -> None:
    env = envs_jax.make("point2d", reward="dense", horizon=6)
    policy, params = small_policy()
    warm = InnerStep(enhanced_loss(0.0, 1.0), 0.05, on_policy=False, first_order=False)
    steps = (warm, *enhanced_steps(2, 0.1))
    collect, demos = collector(env, policy, 3, 0.9, 1.0), random_demos(0)
    task, key = GoalTask(jnp.array([1.0, 1.0])), jax.random.key(2)
    adapted = adapt(policy, steps, collect, params, key, task, demos)

    assert adapted.rollouts[0] is None
    assert len(adapted.path) == len(steps) + 1
    jax.tree.map(np.testing.assert_array_equal, adapted.path[0], params)
    jax.tree.map(np.testing.assert_array_equal, adapted.path[-1], adapted.params)
    again = readapt(policy, steps, params, adapted.rollouts, demos)
    # the second time without compilation, which rounds differently
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), again, adapted.path)
    for k, own in enumerate(jax.random.split(key, len(steps))):
        if (rollout := adapted.rollouts[k]) is not None:  # collected where the step started
            expected = collect(adapted.path[k], own, task).trajectory.action
            np.testing.assert_allclose(rollout.trajectory.action, expected, rtol=1e-8)


def test_episodes_without_any_advantage_adapt_on_the_demonstrations_alone() -> None:
    policy, params = small_policy()
    steps, demos, rollout = enhanced_steps(1, RATE), random_demos(0), random_rollout(0)
    idle = rollout._replace(advantage=jnp.zeros_like(rollout.advantage))
    adapted = [
        adapt(policy, steps, lambda *_, r=r: r, params, jax.random.key(0), None, demos).params
        for r in (idle, rollout)
    ]
    alone = InnerStep(enhanced_loss(0.0, 1.3), RATE, on_policy=False, first_order=False)
    expected = readapt(policy, (alone,), params, (None,), demos)[-1]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), adapted[0], expected)
    flat = [ravel_pytree(own)[0] for own in adapted]
    assert float(jnp.max(jnp.abs(flat[0] - flat[1]))) > 1e-3
