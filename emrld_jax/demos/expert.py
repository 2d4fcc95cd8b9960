"""Goal-conditioned experts: one policy for all tasks, trained by TRPO (supplement, section C).

The task's vector is appended to the observation; a value network, which also sees the time, gives
the advantages. Training starts on the dense reward, which shows the way from anywhere, and may go
on with the sparse one, which asks for speed and precision.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from emrld_jax.meta.inner import masked_mean
from emrld_jax.meta.outer import Metrics, Objective, OuterOptimizer, surrogate_objective
from emrld_jax.meta.trpo import trpo
from emrld_jax.policy import MLP, Policy, gaussian_policy
from emrld_jax.sampling.advantages import discounted_sum, gae, normalize
from emrld_jax.sampling.rollouts import episode, episode_returns, episode_successes
from emrld_jax.types import Gaussian, Params, Rollout, Task, Trajectory
from envs_jax import Env

HIDDEN_SIZES = (128, 128)
EVERY = 4  # the curvature and the value network see each of these steps


class ExpertState(NamedTuple):
    """An expert in training."""

    policy: Params
    value: Params
    value_optimizer: optax.OptState


class Expert(NamedTuple):
    """What trains an expert, as functions."""

    policy: Policy  # of an observation with the task's vector appended
    init: Callable[[jax.Array], ExpertState]  # (key)
    # (state, key, tasks [M]): one iteration
    update: Callable[[ExpertState, jax.Array, Task], tuple[ExpertState, Metrics]]


def task_vector(task: Task) -> jax.Array:
    """All numbers that tell a task from others, [K]."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(task)])


def append_task(obs: jax.Array, task: Task) -> jax.Array:
    """Observations with the task's vector appended. [.., O] -> [.., O + K]."""
    vector = task_vector(task)
    return jnp.concatenate([obs, jnp.broadcast_to(vector, (*obs.shape[:-1], vector.size))], axis=-1)


def conditioned(policy: Policy, task: Task) -> Policy:
    """The expert's policy for one task: a function of the environment's observation alone."""
    return Policy(policy.init, lambda params, obs: policy.apply(params, append_task(obs, task)))


def value_inputs(obs: jax.Array, task: Task) -> jax.Array:
    """What the value network sees of one task's episodes. [E, T, O] -> [E, T, O + K + 1]."""
    horizon = obs.shape[-2]
    time = jnp.broadcast_to((jnp.arange(horizon) / horizon)[None, :, None], (*obs.shape[:-1], 1))
    return jnp.concatenate([append_task(obs, task), time], axis=-1)


def expert(
    env: Env,
    *,
    num_episodes: int = 4,
    std: float = 0.6,
    max_kl: float = 0.02,
    discount: float = 0.99,
    gae_lambda: float = 0.97,
    value_learning_rate: float = 3e-3,
    value_steps: int = 30,
) -> Expert:
    """Assembles an expert for an environment with the reward that it has.

    Args:
        num_episodes: episodes a task and iteration.
        std: standard deviation at the start, in policy units; it is learned.
        value_steps: full-batch Adam steps of the value network an iteration.
    """
    width = env.observation_size + task_vector(env.sample_task(jax.random.key(0))).size
    policy = gaussian_policy(
        width, env.action_size, hidden_sizes=HIDDEN_SIZES, std=std, learn_std=True
    )
    network = MLP((*HIDDEN_SIZES, 1), "tanh")
    scale = 1.0 / (1.0 - discount)  # returns are of this size; the network's outputs then of size 1
    adam = optax.adam(value_learning_rate)
    optimizer = trpo(max_kl=max_kl, backtrack_ratio=0.7)

    def init(key: jax.Array) -> ExpertState:
        policy_key, value_key = jax.random.split(key)
        value = network.init(value_key, jnp.zeros(width + 1))
        return ExpertState(policy.init(policy_key), value, adam.init(value))

    def values(params: Params, obs: jax.Array, task: Task) -> jax.Array:
        outputs = cast(jax.Array, network.apply(params, value_inputs(obs, task)))
        return scale * outputs[..., 0]

    def collect(state: ExpertState, key: jax.Array, task: Task) -> tuple[Trajectory, jax.Array]:
        """One task's episodes, [E, T, ..], and their advantages, [E, T]."""
        keys = jax.random.split(key, num_episodes)
        own = conditioned(policy, task)
        episodes = jax.vmap(lambda k: episode(env, own, state.policy, k, task))(keys)
        value = values(state.value, episodes.obs, task) * episodes.mask
        reward = episodes.reward * episodes.mask
        return episodes, jax.vmap(lambda r, v: gae(r, v, discount, gae_lambda, jnp.zeros(())))(
            reward, value
        )

    def fit_value(state: ExpertState, batch: Trajectory, tasks: Task) -> ExpertState:
        """Fits the value network to the discounted returns of the episodes, [M, E, T]."""
        per_episode = jax.vmap(jax.vmap(lambda r: discounted_sum(r, discount)))
        targets = per_episode(batch.reward * batch.mask)[..., ::EVERY] / scale
        inputs = jax.vmap(value_inputs)(batch.obs, tasks)[..., ::EVERY, :]

        def loss(params: Params) -> jax.Array:
            outputs: jax.Array = network.apply(params, inputs)  # type: ignore[assignment]
            return masked_mean((outputs[..., 0] - targets) ** 2, batch.mask[..., ::EVERY])

        def step(carry: tuple[Params, optax.OptState], _: None) -> tuple[tuple, None]:
            params, opt_state = carry
            updates, opt_state = adam.update(jax.grad(loss)(params), opt_state)
            return (optax.apply_updates(params, updates), opt_state), None

        start = (state.value, state.value_optimizer)
        (value, opt_state), _ = jax.lax.scan(step, start, length=value_steps)
        return state._replace(value=value, value_optimizer=opt_state)

    @jax.jit
    def update(state: ExpertState, key: jax.Array, tasks: Task) -> tuple[ExpertState, Metrics]:
        keys = jax.random.split(key, jax.tree.leaves(tasks)[0].shape[0])
        batch, advantage = jax.vmap(partial(collect, state))(keys, tasks)
        rollouts = Rollout(batch, normalize(advantage, batch.mask))
        new_policy, outer = improve_policy(policy, optimizer, state.policy, rollouts, tasks)
        metrics = {
            "expert/return": jnp.mean(episode_returns(batch)),
            "expert/success": jnp.mean(episode_successes(batch)),
            "expert/length": jnp.mean(jnp.sum(batch.mask, axis=-1)),
        }
        return fit_value(state, batch, tasks)._replace(policy=new_policy), {**metrics, **outer}

    return Expert(policy, init, update)


def improve_policy(
    policy: Policy, optimizer: OuterOptimizer, params: Params, rollouts: Rollout, tasks: Task
) -> tuple[Params, Metrics]:
    """One TRPO step on the episodes of all tasks, [M, E, T, ..]."""

    def objective(every: int) -> Objective:
        flat = jax.tree.map(lambda x: x.reshape(x.shape[0], -1, *x.shape[3:]), rollouts)
        steps = jax.tree.map(lambda x: x[:, ::every], flat)

        def policies(params: Params) -> Gaussian:
            def of_task(obs: jax.Array, task: Task) -> Gaussian:
                return policy.apply(params, append_task(obs, task))

            return jax.vmap(of_task)(steps.trajectory.obs, tasks)

        return surrogate_objective(policies, steps)

    new_params, _, metrics = optimizer.update(objective(1), objective(EVERY), params, ())
    return new_params, metrics
