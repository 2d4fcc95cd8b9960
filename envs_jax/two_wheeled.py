"""TwoWheeled: a differential-drive robot drives to a goal on a half circle (section B.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from envs_jax.goals import GoalTask, half_circle, sample_half_circle
from envs_jax.wheels import DifferentialDrive


@dataclass(frozen=True)
class TwoWheeled(DifferentialDrive):
    """A robot with up to 0.22 m/s and 2.84 rad/s, and a goal 2 m away that the task sets."""

    name: ClassVar[str] = "two_wheeled"
    action_low: ClassVar[tuple[float, ...]] = (0.0, -2.84)
    action_high: ClassVar[tuple[float, ...]] = (0.22, 2.84)
    goal_distance: ClassVar[float] = 2.0

    def train_tasks(self) -> GoalTask:
        """24 goals, 0 to 172.5 degrees, 7.5 apart; goal [24, 2]."""
        return half_circle(7.5 * jnp.arange(24), self.goal_distance)

    def test_tasks(self) -> GoalTask:
        """24 held-out goals, halfway between the training goals; goal [24, 2]."""
        return half_circle(3.75 + 7.5 * jnp.arange(24), self.goal_distance)

    def sample_task(self, key: jax.Array) -> GoalTask:
        """A goal in a direction uniform over 0 to 180 degrees."""
        return sample_half_circle(key, self.goal_distance)

    def goal(self, task: GoalTask) -> jax.Array:
        """Where the task's goal is, [2] in m."""
        return task.goal
