"""What the goal-reaching environments share: goals on a half circle, and rewards near a goal."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class GoalTask(NamedTuple):
    """A task named by where to go."""

    goal: jax.Array  # [2], m; a batch of tasks has [M, 2]


def half_circle(degrees: jax.Array, distance: float) -> GoalTask:
    """Goals at `distance` (m) from the origin in the directions `degrees`, shape [M] or []."""
    radians = jnp.deg2rad(degrees)
    return GoalTask(distance * jnp.stack([jnp.cos(radians), jnp.sin(radians)], axis=-1))


def sample_half_circle(key: jax.Array, distance: float) -> GoalTask:
    """One goal at `distance` (m) from the origin, its direction uniform over 0 to 180 degrees."""
    return half_circle(jax.random.uniform(key, (), maxval=180.0), distance)


def goal_reward(
    kind: str,
    distance: jax.Array,
    success: jax.Array,
    t: jax.Array,
    reward_radius: float,
    horizon: int,
) -> jax.Array:
    """Reward of step `t` (from 0), which ended `distance` (m) from the goal (section B.1).

    Sparse: exactly 0 outside `reward_radius`, 1 - distance inside, and at success the number of
    steps that remain, horizon - t - 1. Dense: minus the distance.

    Args:
        kind: "sparse" or "dense".
        distance: [], m.
        success: [], bool.
        t: [], int.
        reward_radius: m.
        horizon: steps.

    Returns:
        The reward, shape [].
    """
    if kind == "dense":
        return -distance
    near = jnp.where(distance <= reward_radius, 1.0 - distance, 0.0)
    return jnp.where(success, (horizon - t - 1).astype(distance.dtype), near)
