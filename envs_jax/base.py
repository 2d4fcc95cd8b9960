"""What every environment is: a State, and pure functions that make and advance it."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

REWARDS = ("sparse", "dense")


@struct.dataclass
class State:
    """One environment's state. The field names are brax's, so brax's wrappers take it unmodified.

    Attributes:
        pipeline_state: the physical state and the step count; each environment has its own type.
        obs: observation, shape [O].
        reward: reward of the last step, shape [].
        done: 1.0 if the episode ended at the last step (success or leaving the arena; never the
            horizon, which is the rollout's business), else 0.0, shape [].
        metrics: figures of the last step; every environment reports `success` and `diverged` (the
            simulation broke down, and ended the episode), shape [], 0 or 1.
        info: room for wrappers.
        task: what varies between tasks; each environment has its own NamedTuple.
    """

    pipeline_state: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)
    task: Any = None


class Env(Protocol):
    """A family of tasks, as pure functions of one environment; batch them with `jax.vmap`."""

    @property
    def name(self) -> str:
        """What `make` calls it, and demonstration files and run folders."""
        ...

    @property
    def observation_names(self) -> tuple[str, ...]:
        """A name for each of the O numbers of an observation."""
        ...

    @property
    def observation_units(self) -> tuple[str, ...]:
        """Their units, such as "m"."""
        ...

    @property
    def action_names(self) -> tuple[str, ...]:
        """A name for each of the A numbers of an action."""
        ...

    @property
    def action_units(self) -> tuple[str, ...]:
        """The units of the physical action."""
        ...

    @property
    def action_low(self) -> tuple[float, ...]:
        """Lower bounds of the physical action, in `action_units`; policy action -1."""
        ...

    @property
    def action_high(self) -> tuple[float, ...]:
        """Upper bounds of the physical action, in `action_units`; policy action +1."""
        ...

    @property
    def reward(self) -> str:
        """The kind of reward: "sparse" or "dense"."""
        ...

    @property
    def horizon(self) -> int:
        """Steps an episode; whoever rolls out ends it there."""
        ...

    @property
    def dt(self) -> float:
        """Seconds a step."""
        ...

    @property
    def observation_size(self) -> int:
        """O."""
        ...

    @property
    def action_size(self) -> int:
        """A."""
        ...

    def train_tasks(self) -> Any:
        """The tasks to learn from: one NamedTuple, its arrays [M, ..]."""
        ...

    def test_tasks(self) -> Any:
        """Held-out tasks, of the same type."""
        ...

    def sample_task(self, key: jax.Array) -> Any:
        """A random task."""
        ...

    def reset(self, key: jax.Array, task: Any = None) -> State:
        """The start of an episode; without a task, of a random one."""
        ...

    def reset_to(self, obs: jax.Array, task: Any) -> State:
        """The start of an episode that begins where `obs` [O] was observed."""
        ...

    def step(self, state: State, action: jax.Array) -> State:
        """The state one step later, after an action [A] in policy units; never a reset."""
        ...

    def to_physical(self, action: jax.Array) -> jax.Array:
        """What is executed of an action in policy units, in physical ones, bounded. [A] -> [A]."""
        ...

    def to_policy(self, physical_action: jax.Array) -> jax.Array:
        """The linear inverse of `to_physical`, unbounded. [A] -> [A]."""
        ...


def unscale_action(action: jax.Array, low: tuple[float, ...], high: tuple[float, ...]) -> jax.Array:
    """Maps policy units [-1, 1] linearly to physical ones [low, high], unbounded. [A] -> [A]."""
    lower, upper = jnp.asarray(low), jnp.asarray(high)
    return lower + 0.5 * (action + 1.0) * (upper - lower)


def scale_action(physical: jax.Array, low: tuple[float, ...], high: tuple[float, ...]) -> jax.Array:
    """Maps physical units [low, high] linearly to policy units [-1, 1]. [A] -> [A].

    The inverse of `unscale_action`.
    """
    lower, upper = jnp.asarray(low), jnp.asarray(high)
    return 2.0 * (physical - lower) / (upper - lower) - 1.0


def check_parameters(reward: str, horizon: int, **sizes: float) -> None:
    """Refuses impossible environment parameters; `sizes` are in meters.

    Raises:
        ValueError: an unknown reward, or a horizon or size that is not positive.
    """
    if reward not in REWARDS:
        raise ValueError(f"reward={reward!r} is unknown; choose one of: {', '.join(REWARDS)}")
    if horizon < 1:
        raise ValueError(f"horizon={horizon} must be at least 1 step")
    for name, value in sizes.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}={value} must be a positive number of meters")
