"""Puts goal-reaching environments into a chosen state, and makes their tasks from numbers."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from envs_jax import State
from envs_jax.goals import GoalTask
from envs_jax.point2d import Point
from envs_jax.two_wheeled_drift import DriftTask
from envs_jax.wheels import Robot

GOAL_NAMES = ("point2d", "two_wheeled", "two_wheeled_drift")
DRIFT_GOAL = np.array([2.0, 1.0])


def task_of(name: str, goal: np.ndarray, drift: np.ndarray | float) -> Any:
    """The task with this goal, or this drift; leading axes make a batch."""
    if name == "two_wheeled_drift":
        return DriftTask(jnp.asarray(drift, jnp.float32))
    return GoalTask(jnp.asarray(goal, jnp.float32))


def state_at(name: str, obs: np.ndarray, t: np.ndarray | int, task: Any) -> State:
    """A state with this observation at step t; leading axes make a batch."""
    values = jnp.asarray(obs, jnp.float32)
    steps = jnp.asarray(t, jnp.int32)
    physical: Any = Point(values, steps) if name == "point2d" else Robot(values, steps)
    zero = jnp.zeros(steps.shape)
    return State(physical, values, zero, zero, {"success": zero, "distance": zero}, {}, task)
