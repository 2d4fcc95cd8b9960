"""TwoWheeled drift: the goal is fixed, the robot turns by itself as the task says (section B.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from envs_jax.wheels import DifferentialDrive


class DriftTask(NamedTuple):
    """A task named by how the robot drifts."""

    residual_angular_velocity: jax.Array  # [], rad a step; a batch of tasks has [M]


@dataclass(frozen=True)
class TwoWheeledDrift(DifferentialDrive):
    """A robot with up to 0.15 m/s and 1.5 rad/s that drives to (2, 1) m against its drift."""

    goal_half_width: float = 0.1

    name: ClassVar[str] = "two_wheeled_drift"
    action_low: ClassVar[tuple[float, ...]] = (0.0, -1.5)
    action_high: ClassVar[tuple[float, ...]] = (0.15, 1.5)
    max_residual: ClassVar[float] = 0.7  # rad a step
    robot_experiment: ClassVar[float] = -0.65  # rad a step: the drift on the paper's real robot

    def train_tasks(self) -> DriftTask:
        """24 residuals, evenly over [-0.7, 0.7]; residual_angular_velocity [24]."""
        return DriftTask(jnp.linspace(-self.max_residual, self.max_residual, 24))

    def test_tasks(self) -> DriftTask:
        """Midpoints of 24 parts of [-0.7, 0.7], then -0.65; residual_angular_velocity [25].

        They do not interleave evenly with the training values: the nearest one is 0.0013 rad a
        step away in the middle of the range, and 0.029 at its ends.
        """
        width = 2 * self.max_residual / 24
        midpoints = -self.max_residual + width * (jnp.arange(24) + 0.5)
        return DriftTask(jnp.append(midpoints, jnp.float32(self.robot_experiment)))

    def sample_task(self, key: jax.Array) -> DriftTask:
        """A residual uniform over [-0.7, 0.7]."""
        limit = self.max_residual
        return DriftTask(jax.random.uniform(key, (), minval=-limit, maxval=limit))

    def goal(self, task: DriftTask) -> jax.Array:
        """Where the goal is, [2] in m: the same for every task."""
        return jnp.array([2.0, 1.0])

    def residual(self, task: DriftTask) -> jax.Array:
        """What the robot turns by itself, [] in rad a step."""
        return task.residual_angular_velocity
