"""Point2D: a point walks in the plane to a goal on a half circle (supplement, section B.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from envs_jax.base import State, check_parameters, scale_action, unscale_action
from envs_jax.goals import GoalTask, goal_reward, half_circle, sample_half_circle


class Point(NamedTuple):
    position: jax.Array  # [2], m
    t: jax.Array  # [], steps taken


@dataclass(frozen=True)
class Point2D:
    """A point that moves at most 0.1 m a step, from the origin to a goal 2 m away.

    Attributes:
        reward: "sparse" (nothing outside `reward_radius`) or "dense" (minus the distance).
        horizon: steps an episode.
        reward_radius: m; inside, each step gives 1 - distance.
        goal_radius: m; inside, the episode ends in success.

    Raises:
        ValueError: impossible parameters.
    """

    reward: str = "sparse"
    horizon: int = 100
    reward_radius: float = 0.2
    goal_radius: float = 0.02

    name: ClassVar[str] = "point2d"
    observation_names: ClassVar[tuple[str, ...]] = ("x", "y")
    observation_units: ClassVar[tuple[str, ...]] = ("m", "m")
    action_names: ClassVar[tuple[str, ...]] = ("dx", "dy")
    action_units: ClassVar[tuple[str, ...]] = ("m", "m")
    action_low: ClassVar[tuple[float, ...]] = (-0.1, -0.1)
    action_high: ClassVar[tuple[float, ...]] = (0.1, 0.1)
    dt: ClassVar[float] = 1.0  # s; nominal, the paper gives none
    goal_distance: ClassVar[float] = 2.0  # m
    max_step: ClassVar[float] = 0.1  # m

    def __post_init__(self) -> None:
        sizes = {"reward_radius": self.reward_radius, "goal_radius": self.goal_radius}
        check_parameters(self.reward, self.horizon, **sizes)

    @property
    def observation_size(self) -> int:
        return 2

    @property
    def action_size(self) -> int:
        return 2

    def train_tasks(self) -> GoalTask:
        """12 goals, 0 to 165 degrees, 15 apart; goal [12, 2]."""
        return half_circle(15.0 * jnp.arange(12), self.goal_distance)

    def test_tasks(self) -> GoalTask:
        """12 held-out goals, halfway between the training goals; goal [12, 2]."""
        return half_circle(7.5 + 15.0 * jnp.arange(12), self.goal_distance)

    def sample_task(self, key: jax.Array) -> GoalTask:
        """A goal in a direction uniform over 0 to 180 degrees."""
        return sample_half_circle(key, self.goal_distance)

    def goal(self, task: GoalTask) -> jax.Array:
        """Where the task's goal is, [2] in m."""
        return task.goal

    def to_physical(self, action: jax.Array) -> jax.Array:
        """Policy action [2] -> displacement [2] in m, its norm bounded to 0.1 by projection."""
        displacement = unscale_action(action, self.action_low, self.action_high)
        norm = jnp.sqrt(jnp.maximum(jnp.sum(displacement**2), 1e-12))
        return displacement * jnp.minimum(1.0, self.max_step / norm)

    def to_policy(self, physical_action: jax.Array) -> jax.Array:
        """Displacement [2] in m -> policy action [2]; the linear inverse of `to_physical`."""
        return scale_action(physical_action, self.action_low, self.action_high)

    def reset(self, key: jax.Array, task: GoalTask | None = None) -> State:
        """The start, at the origin; without a task, a random one."""
        return self.reset_to(jnp.zeros(2), self.sample_task(key) if task is None else task)

    def reset_to(self, obs: jax.Array, task: GoalTask) -> State:
        """The start of an episode at the position `obs` [2]."""
        zero = jnp.zeros(())
        metrics = {"success": zero, "diverged": zero, "distance": jnp.linalg.norm(obs - task.goal)}
        return State(Point(obs, jnp.zeros((), jnp.int32)), obs, zero, zero, metrics, {}, task)

    def step(self, state: State, action: jax.Array) -> State:
        """Moves by the policy action [2]."""
        point: Point = state.pipeline_state
        position = point.position + self.to_physical(action)
        distance = jnp.linalg.norm(position - state.task.goal)
        success = distance <= self.goal_radius
        reward = goal_reward(
            self.reward, distance, success, point.t, self.reward_radius, self.horizon
        )
        done = success.astype(position.dtype)
        return replace(
            state,
            pipeline_state=Point(position, point.t + 1),
            obs=position,
            reward=reward,
            done=done,
            metrics={**state.metrics, "success": done, "distance": distance},
        )
