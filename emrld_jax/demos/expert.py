"""Goal-conditioned experts: one policy for all tasks, trained by TRPO (supplement, section C).

The task's vector is appended to the observation; a value network, which also sees the time, gives
the advantages. Training starts on the dense reward, which shows the way from anywhere, and may go
on with the sparse one, which asks for speed and precision.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.demos.value import ValueState, append_task, task_vector, value_network
from emrld_jax.meta.outer import Metrics, Objective, OuterOptimizer
from emrld_jax.meta.outer_losses import surrogate_objective
from emrld_jax.meta.trpo import trpo
from emrld_jax.policy import Policy, gaussian_policy
from emrld_jax.sampling.advantages import gae, normalize
from emrld_jax.sampling.rollouts import (
    episode,
    episode_divergences,
    episode_returns,
    episode_successes,
)
from emrld_jax.types import Gaussian, Params, Rollout, Task, Trajectory
from envs_jax import Env

HIDDEN_SIZES = (128, 128)
EVERY = 4  # the curvature and the value network see each of these steps


class ExpertState(NamedTuple):
    """An expert in training."""

    policy: Params
    value: ValueState


class Expert(NamedTuple):
    """What trains an expert, as functions."""

    policy: Policy  # of an observation with the task's vector appended
    init: Callable[[jax.Array], ExpertState]  # (key)
    # (state, key, tasks [M]): one iteration
    update: Callable[[ExpertState, jax.Array, Task], tuple[ExpertState, Metrics]]


def conditioned(policy: Policy, task: Task) -> Policy:
    """The expert's policy for one task: a function of the environment's observation alone."""
    return Policy(policy.init, lambda params, obs: policy.apply(params, append_task(obs, task)))


def expert(
    env: Env,
    *,
    num_episodes: int = 4,
    squash: bool = False,
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
        squash: the networks see arcsinh of the observation.
        std: standard deviation at the start, in policy units; it is learned.
        value_steps: full-batch Adam steps of the value network an iteration.
    """
    width = env.observation_size + task_vector(env.sample_task(jax.random.key(0))).size
    policy = gaussian_policy(
        width,
        env.action_size,
        hidden_sizes=HIDDEN_SIZES,
        std=std,
        squash=squash,
        learn_std=True,
    )
    value = value_network(
        width + 1,
        HIDDEN_SIZES,
        discount,
        value_learning_rate,
        value_steps,
        every=EVERY,
        squash=squash,
    )
    optimizer = trpo(max_kl=max_kl, backtrack_ratio=0.7)

    def init(key: jax.Array) -> ExpertState:
        policy_key, value_key = jax.random.split(key)
        return ExpertState(policy.init(policy_key), value.init(value_key))

    def collect(state: ExpertState, key: jax.Array, task: Task) -> tuple[Trajectory, jax.Array]:
        """One task's episodes, [E, T, ..], and their advantages, [E, T]."""
        keys = jax.random.split(key, num_episodes)
        own = conditioned(policy, task)
        episodes = jax.vmap(lambda k: episode(env, own, state.policy, k, task))(keys)
        values = value.predict(state.value, episodes.obs, task) * episodes.mask
        reward = episodes.reward * episodes.mask
        return episodes, jax.vmap(lambda r, v: gae(r, v, discount, gae_lambda))(reward, values)

    @jax.jit
    def update(state: ExpertState, key: jax.Array, tasks: Task) -> tuple[ExpertState, Metrics]:
        keys = jax.random.split(key, jax.tree.leaves(tasks)[0].shape[0])
        batch, advantage = jax.vmap(partial(collect, state))(keys, tasks)
        rollouts = Rollout(batch, normalize(advantage, batch.mask))
        new_policy, outer = improve_policy(policy, optimizer, state.policy, rollouts, tasks)
        metrics = {
            "expert/return": jnp.mean(episode_returns(batch)),
            "expert/success": jnp.mean(episode_successes(batch)),
            "expert/diverged": jnp.mean(episode_divergences(batch)),
            "expert/length": jnp.mean(jnp.sum(batch.mask, axis=-1)),
        }
        return ExpertState(new_policy, value.fit(state.value, batch, tasks)), {**metrics, **outer}

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
