"""Environments of others, of one task each, made into families of tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from envs_jax.base import State

# (the wrapped environment's state before the step, action [A], its state after, task) -> []
Reward = Callable[[Any, jax.Array, Any, Any], jax.Array]


class Tasks(NamedTuple):
    """A family of tasks: NamedTuples of arrays, a batch with a leading [M]."""

    train: Any  # [M, ..]
    test: Any  # [M', ..]
    sample: Callable[[jax.Array], Any]  # (key) -> one task


@dataclass(frozen=True, eq=False)
class FromBrax:
    """An environment of brax's, or of MuJoCo Playground's, whose reward depends on a task.

    Attributes:
        inner: what has brax's interface: `reset(key)`, `step(state, action)`, `action_size`,
            `observation_size`, `dt`; its state has `obs`, `reward` and `done`.
        reward_of: what a step is worth in a task.
        tasks: the tasks.
        name: what it is called.
        horizon: steps an episode.
    """

    inner: Any
    reward_of: Reward
    tasks: Tasks
    name: str
    horizon: int

    reward: ClassVar[str] = "own"

    @property
    def dt(self) -> float:
        """Seconds a step."""
        return float(self.inner.dt)

    @property
    def observation_size(self) -> int:
        return int(_observed(self._shapes.obs).shape[-1])

    @property
    def action_size(self) -> int:
        return int(self.inner.action_size)

    @property
    def observation_names(self) -> tuple[str, ...]:
        return tuple(f"observation_{i}" for i in range(self.observation_size))

    @property
    def observation_units(self) -> tuple[str, ...]:
        return ("",) * self.observation_size

    @property
    def action_names(self) -> tuple[str, ...]:
        return tuple(f"action_{i}" for i in range(self.action_size))

    @property
    def action_units(self) -> tuple[str, ...]:
        return ("1",) * self.action_size

    @property
    def action_low(self) -> tuple[float, ...]:
        return (-1.0,) * self.action_size

    @property
    def action_high(self) -> tuple[float, ...]:
        return (1.0,) * self.action_size

    @cached_property
    def _shapes(self) -> Any:
        with jax.numpy_rank_promotion("allow"):
            return jax.eval_shape(self.inner.reset, jax.random.key(0))

    def train_tasks(self) -> Any:
        """The training tasks, [M, ..]."""
        return self.tasks.train

    def test_tasks(self) -> Any:
        """The held-out tasks, [M', ..]."""
        return self.tasks.test

    def sample_task(self, key: jax.Array) -> Any:
        """A random task."""
        return self.tasks.sample(key)

    def to_physical(self, action: jax.Array) -> jax.Array:
        """Policy action [A], bounded to [-1, 1], which is what brax's environments take."""
        return jnp.clip(action, -1.0, 1.0)

    def to_policy(self, physical_action: jax.Array) -> jax.Array:
        """The same numbers."""
        return physical_action

    def reset(self, key: jax.Array, task: Any = None) -> State:
        """A start of the wrapped environment's; without a task, a random one."""
        task_key, inner_key = jax.random.split(key)
        task = self.sample_task(task_key) if task is None else task
        with jax.numpy_rank_promotion("allow"):
            inner = self.inner.reset(inner_key)
        zero = jnp.zeros(())
        metrics = {"success": zero, "diverged": zero}
        return State(inner, _observed(inner.obs), zero, zero, metrics, {}, task)

    def reset_to(self, obs: jax.Array, task: Any) -> State:
        """Not possible: these environments' states are more than what is observed.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"{self.name} cannot start from an observation, so nothing can be replayed"
        )

    def step(self, state: State, action: jax.Array) -> State:
        """A step of the wrapped environment, with the task's reward."""
        action = self.to_physical(action)
        before = state.pipeline_state
        # a copy: brax's environments write into the dictionaries of the state that they are given
        with jax.numpy_rank_promotion("allow"):
            after = self.inner.step(jax.tree.map(lambda x: x, before), action)
            reward = self.reward_of(before, action, after, state.task)
        fine = jnp.all(jnp.isfinite(_observed(after.obs))) & jnp.isfinite(reward)
        after = jax.tree.map(
            lambda old, new: jnp.where(fine, jnp.asarray(new, old.dtype), old), before, after
        )
        diverged = 1.0 - fine.astype(jnp.float32)
        return replace(
            state,
            pipeline_state=after,
            obs=_observed(after.obs),
            reward=jnp.where(fine, reward, 0.0).astype(jnp.float32),
            done=jnp.maximum(jnp.asarray(after.done, jnp.float32), diverged),
            metrics={**state.metrics, "success": jnp.zeros(()), "diverged": diverged},
        )


def from_brax(
    env: Any, reward: Reward, tasks: Tasks, *, name: str | None = None, horizon: int = 100
) -> FromBrax:
    """A task-parametrized environment of one with brax's interface.

    Brax's own environments have it, and MuJoCo Playground's. Its physics and its endings stay; the
    reward is a function of the task, and the tasks are given (docs/environments.md has examples).

    Args:
        env: the environment, without brax's training wrappers.
        reward: what a step is worth, of the environment's own states before and after it.
        tasks: training and held-out tasks, and how to sample one.
        name: what to call it; None: the name of its class.
        horizon: steps an episode.

    Raises:
        TypeError: the environment lacks a part of the interface.
    """
    needed = ("reset", "step", "action_size", "observation_size", "dt")
    if missing := [part for part in needed if not hasattr(env, part)]:
        raise TypeError(f"{type(env).__name__} has no {', '.join(missing)}, as brax's have")
    return FromBrax(env, reward, tasks, name or type(env).__name__.lower(), horizon)


def _observed(obs: Any) -> jax.Array:
    """The policy's observation [O]: the array, or of several the one that is called state."""
    return obs["state"] if isinstance(obs, dict) else obs
