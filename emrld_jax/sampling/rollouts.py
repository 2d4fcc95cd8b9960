"""Episodes of a policy in an environment, as one scan; and their living steps, gathered."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emrld_jax.policy import Policy, sample, sample_log_prob
from emrld_jax.sampling.advantages import advantages
from emrld_jax.types import Collect, Params, Rollout, Task, Trajectory
from envs_jax import Env, State


def episode(env: Env, policy: Policy, params: Params, key: jax.Array, task: Task) -> Trajectory:
    """One episode of `env.horizon` steps; steps after its end have mask 0. Fields [T, ..]."""
    reset_key, noise_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (env.horizon, env.action_size))

    def step(carry: tuple[State, jax.Array], noise: jax.Array) -> tuple[tuple, Trajectory]:
        state, alive = carry
        gaussian = policy.apply(params, state.obs)
        action = sample(gaussian, noise)
        following = env.step(state, action)
        success, diverged = following.metrics["success"], following.metrics["diverged"]
        outcome = (following.reward, following.done, success, diverged)
        density = sample_log_prob(gaussian, noise)
        record = Trajectory(state.obs, action, *outcome, alive, density)
        return (following, alive * (1.0 - following.done)), record

    start = (env.reset(reset_key, task), jnp.ones(()))
    return jax.lax.scan(step, start, noise)[1]


def collector(
    env: Env, policy: Policy, num_episodes: int, discount: float, gae_lambda: float
) -> Collect:
    """What collects a task's episodes, [E, T, ..], with their advantages."""

    def collect(params: Params, key: jax.Array, task: Task) -> Rollout:
        keys = jax.random.split(key, num_episodes)
        episodes = jax.vmap(lambda k: episode(env, policy, params, k, task))(keys)
        return Rollout(episodes, advantages(episodes, discount, gae_lambda))

    return collect


def episode_returns(trajectory: Trajectory) -> jax.Array:
    """Undiscounted return of each episode. [.., T] -> [..]."""
    return jnp.sum(trajectory.reward * trajectory.mask, axis=-1)


def episode_successes(trajectory: Trajectory) -> jax.Array:
    """1 for each episode with a step that was a success, else 0. [.., T] -> [..]."""
    return jnp.max(trajectory.success * trajectory.mask, axis=-1)


def episode_divergences(trajectory: Trajectory) -> jax.Array:
    """1 for each episode whose simulation broke down, else 0. [.., T] -> [..]."""
    return jnp.max(trajectory.diverged * trajectory.mask, axis=-1)


def living_steps(rollout: Rollout) -> jax.Array:
    """How many steps of a task's episodes exist, []; of a batch of tasks [M, E, T]: [M]."""
    return jnp.sum(rollout.trajectory.mask, axis=(-2, -1)).astype(jnp.int32)


def without_idle_steps(rollout: Rollout) -> Rollout:
    """The same policy gradient from fewer steps: those of advantage 0 are masked out.

    Advantages are scaled by the share of steps that stay, so that a mean over steps, each weighed
    by its advantage, is what it was. Without any reward nothing stays. [E, T, ..].
    """
    mask = rollout.trajectory.mask
    weighs = mask * (rollout.advantage != 0)
    share = jnp.sum(weighs) / jnp.maximum(jnp.sum(mask), 1.0)
    return Rollout(rollout.trajectory._replace(mask=weighs), rollout.advantage * share)


def gather_living(rollout: Rollout, size: int, every: int = 1) -> Rollout:
    """One task's existing steps, in order, padded to `size` with mask 0. [E, T, ..] -> [size, ..].

    Sums and means over steps do not change, and steps after an episode's end cost nothing any more.
    With `every` above 1, only each of these steps is taken, as a sample.
    """
    mask = rollout.trajectory.mask.reshape(-1)
    (index,) = jnp.nonzero(mask, size=size * every, fill_value=0)
    index = index[::every]
    exists = (every * jnp.arange(size) < jnp.sum(mask)).astype(mask.dtype)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[index], rollout)
    return flat._replace(trajectory=flat.trajectory._replace(mask=exists))
