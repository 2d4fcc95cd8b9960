"""What a meta-iteration is made of, alone: matrix products and environment steps."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import Row, rate, seconds
from emrld_jax.policy import Policy
from emrld_jax.precision import of_products
from emrld_jax.sampling.rollouts import episode
from emrld_jax.types import Params, Task
from envs_jax import Env, State


def matrix_rate(tasks: int, steps: int, wide: int, repetitions: int) -> Row:
    """Batched products of the hidden layer: forward, back to its input, and of its weights.

    With a product for each task, over the steps of its episodes.
    """
    layer = jnp.ones((tasks, steps, wide))
    weights = jnp.ones((tasks, wide, wide))
    flops = 2 * layer.size * wide * len(_PRODUCTS)
    calls = [partial(product, layer, weights) for product in _PRODUCTS]
    times = np.sum([seconds(call, 2 * repetitions) for call in calls], axis=0)
    return rate("batched matrix products of these shapes", "GFLOP/s", 1e-9 * flops, times)


@jax.jit
def _forward(steps: jax.Array, weights: jax.Array) -> jax.Array:
    return jnp.einsum("msi,mij->msj", steps, weights, precision=of_products())


@jax.jit
def _back(steps: jax.Array, weights: jax.Array) -> jax.Array:
    return jnp.einsum("msj,mij->msi", steps, weights, precision=of_products())


@jax.jit
def _of_weights(steps: jax.Array, weights: jax.Array) -> jax.Array:
    return jnp.einsum("msi,msj->mij", steps, steps, precision=of_products())


_PRODUCTS = (_forward, _back, _of_weights)


def rollouts(
    env: Env, policy: Policy, params: Params, tasks: Task, episodes: int, repetitions: int
) -> list[Row]:
    """Environment steps a second, episodes of full length."""
    number = jax.tree.leaves(tasks)[0].shape[0]
    keys = jax.random.split(jax.random.key(0), (number, episodes))

    @jax.jit
    def physics(keys: jax.Array) -> Any:
        return jax.vmap(lambda task, own: jax.vmap(lambda k: _random_walk(env, k, task))(own))(
            tasks, keys
        )

    @jax.jit
    def acting(keys: jax.Array) -> Any:
        one = lambda k, task: episode(env, policy, params, k, task)  # noqa: E731
        return jax.vmap(lambda task, own: jax.vmap(lambda k: one(k, task))(own))(tasks, keys)

    return [
        rate(
            f"environment steps, {what}", "million/s", 1e-6 * number * episodes * env.horizon, times
        )
        for what, times in (
            ("random actions", seconds(lambda: physics(keys), repetitions)),
            ("with the policy", seconds(lambda: acting(keys), repetitions)),
        )
    ]


def _random_walk(env: Env, key: jax.Array, task: Any) -> jax.Array:
    """The reward of an episode of random actions; the environment's steps and nothing else."""
    actions = jax.random.normal(key, (env.horizon, env.action_size))

    def step(state: State, action: jax.Array) -> tuple[State, jax.Array]:
        state = env.step(state, action)
        return state, state.reward

    return jnp.sum(jax.lax.scan(step, env.reset(key, task), actions)[1])
