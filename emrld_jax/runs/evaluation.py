"""What a meta-policy achieves after 0, 1, .. adaptation steps, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emrld_jax.meta.learner import MetaLearner
from emrld_jax.policy import mean_action
from emrld_jax.sampling.rollouts import (
    collector,
    episode,
    episode_divergences,
    episode_returns,
    episode_successes,
)
from emrld_jax.settings import AdaptSettings
from emrld_jax.types import Demos, Params, Task, Trajectory
from envs_jax import Env

RESAMPLES = 2000  # of the bootstrap


class Evaluation(NamedTuple):
    """Episodes of M tasks at S = 1 + adapt.num_steps stages."""

    returns: Any  # [M, S, E], undiscounted
    successes: Any  # [M, S, E], 0 or 1
    divergences: Any  # [M, S, E], 1 where the simulation broke down
    obs: Any  # [M, S, P, T, O], of the first P episodes
    mask: Any  # [M, S, P, T]
    rewards: Any  # [M, S, P, T]


Evaluate = Callable[[Params, jax.Array, Task, Demos], Evaluation]  # (params, key, tasks, demos)


def evaluator(
    env: Env,
    learner: MetaLearner,
    adapt: AdaptSettings,
    episodes: int,
    *,
    kept: int = 0,
    deterministic: bool = False,
) -> Evaluate:
    """What adapts to each task and then rolls out `episodes` episodes at every stage; compiled.

    Stage 0 is the meta-policy, stage k the policy after k adaptation steps; a warm start belongs to
    the first.

    Args:
        kept: episodes whose observations are kept, P.
        deterministic: roll out the mean action; adaptation samples its episodes all the same.
    """
    policy = learner.policy
    rolled = mean_action(policy) if deterministic else policy
    collect = collector(env, policy, adapt.num_episodes, adapt.discount, adapt.gae_lambda)

    def stage(params: Params, key: jax.Array, task: Task) -> Evaluation:
        keys = jax.random.split(key, episodes)
        rollouts = jax.vmap(lambda k: episode(env, rolled, params, k, task))(keys)
        return _seen(rollouts, kept)

    def of_task(params: Params, key: jax.Array, task: Task, demos: Demos) -> Evaluation:
        adapt_key, stage_key = jax.random.split(key)
        path = learner.adapt(params, adapt_key, task, demos, collect).path
        stages = (path[0], *path[-adapt.num_steps :])
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *stages)
        keys = jax.random.split(stage_key, len(stages))
        return jax.vmap(stage, in_axes=(0, 0, None))(stacked, keys, task)

    @jax.jit
    def evaluate(params: Params, key: jax.Array, tasks: Task, demos: Demos) -> Evaluation:
        keys = jax.random.split(key, demos.mask.shape[0])
        return jax.vmap(of_task, in_axes=(None, 0, 0, 0))(params, keys, tasks, demos)

    return evaluate


def _seen(rollouts: Trajectory, kept: int) -> Evaluation:
    """What is kept of a task's episodes at one stage: figures of all, paths of the first few."""
    return Evaluation(
        episode_returns(rollouts),
        episode_successes(rollouts),
        episode_divergences(rollouts),
        rollouts.obs[:kept],
        rollouts.mask[:kept],
        rollouts.reward[:kept],
    )


def bootstrap_interval(values: np.ndarray, seed: int, level: float = 0.95) -> tuple[float, float]:
    """A percentile interval of the mean over tasks and episodes.

    Each resample draws tasks with replacement, and then episodes of each drawn task: both which
    tasks there are and the policy's noise are accounted for.

    Args:
        values: [M, E].
        seed: of the resampling.
        level: probability that the interval should hold the mean.
    """
    generator = np.random.default_rng(seed)
    tasks, episodes = values.shape

    def resample() -> float:
        rows = generator.integers(tasks, size=(tasks, 1))
        columns = generator.integers(episodes, size=(tasks, episodes))
        return float(values[rows, columns].mean())

    tail = 50 * (1 - level)
    low, high = np.percentile([resample() for _ in range(RESAMPLES)], [tail, 100 - tail])
    return float(low), float(high)


def summarize(evaluation: Evaluation, seed: int) -> dict[str, Any]:
    """Means, intervals and per-task means at each stage, as JSON values."""
    returns, successes = np.asarray(evaluation.returns), np.asarray(evaluation.successes)
    stages = []
    for k in range(returns.shape[1]):
        entry: dict[str, Any] = {"adaptation_steps": k}
        entry["diverged"] = float(np.mean(np.asarray(evaluation.divergences)[:, k]))
        for name, values in (("return", returns[:, k]), ("success", successes[:, k])):
            entry[name] = float(values.mean())
            entry[f"{name}_interval"] = list(bootstrap_interval(values, seed))
            entry[f"{name}_per_task"] = [float(x) for x in values.mean(axis=1)]
        stages.append(entry)
    return {"tasks": returns.shape[0], "episodes": returns.shape[2], "stages": stages}
