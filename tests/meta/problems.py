"""Small problems that the tests of meta-learning share: random episodes and demonstrations."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emrld_jax.meta.adaptation import InnerSteps, readapt
from emrld_jax.meta.inner import InnerStep, enhanced_loss
from emrld_jax.meta.outer import Objective
from emrld_jax.meta.outer_losses import surrogate_objective
from emrld_jax.policy import Policy, gaussian_policy
from emrld_jax.types import Demos, Gaussian, Params, Rollout, Trajectory

TASKS = 2


def random_rollout(seed: int, size: int = 12, living: int = 9) -> Rollout:
    """One task's gathered steps, [size, ..], of which the first `living` exist."""
    rng = np.random.default_rng(seed)
    obs, action = (jnp.asarray(rng.normal(size=(size, 2))) for _ in range(2))
    mask = jnp.asarray((np.arange(size) < living).astype(float))
    zero = jnp.zeros_like(mask)
    steps = Trajectory(obs, action, zero, zero, zero, zero, mask, zero)
    return Rollout(steps, jnp.asarray(rng.normal(size=size)) * mask)


def random_demos(seed: int, size: int = 6, living: int = 4) -> Demos:
    rng = np.random.default_rng(100 + seed)
    obs, action = (jnp.asarray(rng.normal(size=(size, 2))) for _ in range(2))
    return Demos(obs, action, jnp.asarray((np.arange(size) < living).astype(float)))


def stacked(items: list[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.stack(x), *items)


def small_policy(hidden_sizes: tuple[int, ...] = (4,)) -> tuple[Policy, Params]:
    """A policy with a learned standard deviation, and parameters in which no bias is zero."""
    policy = gaussian_policy(2, 2, hidden_sizes=hidden_sizes, std=0.7, learn_std=True)
    rng = np.random.default_rng(0)
    params = policy.init(jax.random.key(0))
    return policy, jax.tree.map(lambda x: jnp.asarray(x + 0.2 * rng.normal(size=x.shape)), params)


def enhanced_steps(number: int, learning_rate: float, first_order: bool = False) -> InnerSteps:
    step = InnerStep(enhanced_loss(0.7, 1.3), learning_rate, True, first_order)
    return (step,) * number


def adapted_objective(policy: Policy, steps: InnerSteps) -> tuple[Objective, Any, Any, Rollout]:
    """The surrogate through the adaptation on random episodes of TASKS tasks.

    Returns:
        The objective, and what it was made of: inner rollouts, demonstrations, outer rollouts.
    """
    inner = tuple(
        stacked([random_rollout(10 * k + m) for m in range(TASKS)]) for k in range(len(steps))
    )
    demos = stacked([random_demos(m) for m in range(TASKS)])
    outer = stacked([random_rollout(50 + m) for m in range(TASKS)])

    def policies(params: Params) -> Gaussian:
        def of_task(inner: Any, demos: Demos, obs: jax.Array) -> Gaussian:
            return policy.apply(readapt(policy, steps, params, inner, demos)[-1], obs)

        return jax.vmap(of_task)(inner, demos, outer.trajectory.obs)

    return surrogate_objective(policies, outer), inner, demos, outer
