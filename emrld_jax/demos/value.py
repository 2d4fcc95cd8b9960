"""The experts' value network: one for all tasks, of observation, task and time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from emrld_jax.meta.inner import masked_mean
from emrld_jax.policy import MLP
from emrld_jax.sampling.advantages import discounted_sum
from emrld_jax.types import Params, Task, Trajectory


class ValueState(NamedTuple):
    """A value network in training."""

    params: Params
    opt_state: optax.OptState


class ValueNetwork(NamedTuple):
    """A value network as functions."""

    init: Callable[[jax.Array], ValueState]  # (key)
    # (state, observations [E, T, O] of one task, task) -> values [E, T]
    predict: Callable[[ValueState, jax.Array, Task], jax.Array]
    # (state, episodes [M, E, T, ..], tasks [M])
    fit: Callable[[ValueState, Trajectory, Task], ValueState]


def task_vector(task: Task) -> jax.Array:
    """All numbers that tell a task from others, [K]."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(task)])


def append_task(obs: jax.Array, task: Task) -> jax.Array:
    """Observations with the task's vector appended. [.., O] -> [.., O + K]."""
    vector = task_vector(task)
    return jnp.concatenate([obs, jnp.broadcast_to(vector, (*obs.shape[:-1], vector.size))], axis=-1)


def value_inputs(obs: jax.Array, task: Task) -> jax.Array:
    """What the value network sees of one task's episodes. [E, T, O] -> [E, T, O + K + 1]."""
    horizon = obs.shape[-2]
    time = jnp.broadcast_to((jnp.arange(horizon) / horizon)[None, :, None], (*obs.shape[:-1], 1))
    return jnp.concatenate([append_task(obs, task), time], axis=-1)


def value_network(
    width: int,
    hidden_sizes: Sequence[int],
    discount: float,
    learning_rate: float,
    num_steps: int,
    every: int,
    squash: bool,
) -> ValueNetwork:
    """A network that is fitted to discounted returns by full-batch Adam.

    Args:
        width: size of its inputs, O + K + 1.
        num_steps: of Adam, a fit.
        squash: it sees arcsinh of its inputs.
        every: a fit sees each of these steps of an episode.
    """
    network = MLP((*hidden_sizes, 1), "tanh")
    scale = 1.0 / (1.0 - discount)  # returns are of this size; the network's outputs then of size 1
    adam = optax.adam(learning_rate)

    def init(key: jax.Array) -> ValueState:
        params = network.init(key, jnp.zeros(width))
        return ValueState(params, adam.init(params))

    def outputs(params: Params, inputs: jax.Array) -> jax.Array:
        seen = jnp.arcsinh(inputs) if squash else inputs
        return cast(jax.Array, network.apply(params, seen))[..., 0]

    def predict(state: ValueState, obs: jax.Array, task: Task) -> jax.Array:
        return scale * outputs(state.params, value_inputs(obs, task))

    def fit(state: ValueState, episodes: Trajectory, tasks: Task) -> ValueState:
        per_episode = jax.vmap(jax.vmap(lambda r: discounted_sum(r, discount)))
        targets = per_episode(episodes.reward * episodes.mask)[..., ::every] / scale
        inputs = jax.vmap(value_inputs)(episodes.obs, tasks)[..., ::every, :]
        mask = episodes.mask[..., ::every]

        def loss(params: Params) -> jax.Array:
            return masked_mean((outputs(params, inputs) - targets) ** 2, mask)

        def step(state: ValueState, _: None) -> tuple[ValueState, None]:
            updates, opt_state = adam.update(jax.grad(loss)(state.params), state.opt_state)
            return ValueState(optax.apply_updates(state.params, updates), opt_state), None

        return jax.lax.scan(step, state, length=num_steps)[0]

    return ValueNetwork(init, predict, fit)
