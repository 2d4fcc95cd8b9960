"""What the differential-drive environments share: kinematics, arena, one step toward a goal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from envs_jax.base import State, check_parameters, scale_action, unscale_action
from envs_jax.goals import goal_reward


class Robot(NamedTuple):
    pose: jax.Array  # [3]: x (m), y (m), theta (rad, not wrapped)
    t: jax.Array  # [], steps taken


def drive(pose: jax.Array, command: jax.Array, residual: jax.Array, dt: float) -> jax.Array:
    """The pose one step later (section B.1): Euler's rule with the heading before the turn.

    Args:
        pose: [3]: x (m), y (m), theta (rad).
        command: [2]: linear (m/s) and angular (rad/s) velocity.
        residual: [], rad a step that the robot turns by itself.
        dt: s.

    Returns:
        The new pose, [3].
    """
    x, y, theta = pose
    linear, angular = command
    return jnp.stack(
        [
            x + linear * jnp.cos(theta) * dt,
            y + linear * jnp.sin(theta) * dt,
            theta + residual + angular * dt,
        ]
    )


@dataclass(frozen=True)
class DifferentialDrive:
    """A robot that drives from the origin to a goal; subclasses say what a task is.

    Attributes:
        reward: "sparse" (nothing outside `reward_radius`) or "dense" (minus the distance).
        horizon: steps an episode.
        reward_radius: m; inside, each step gives 1 - distance.
        goal_half_width: m; the episode ends in success in this square around the goal.

    Raises:
        ValueError: impossible parameters.
    """

    reward: str = "sparse"
    horizon: int = 100
    reward_radius: float = 0.5
    goal_half_width: float = 0.2

    name: ClassVar[str]
    action_low: ClassVar[tuple[float, ...]]
    action_high: ClassVar[tuple[float, ...]]
    observation_names: ClassVar[tuple[str, ...]] = ("x", "y", "theta")
    observation_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad")
    action_names: ClassVar[tuple[str, ...]] = ("linear_velocity", "angular_velocity")
    action_units: ClassVar[tuple[str, ...]] = ("m/s", "rad/s")
    dt: ClassVar[float] = 0.5
    arena: ClassVar[float] = 2.5  # m: the episode ends where |x| or |y| exceeds it

    def __post_init__(self) -> None:
        sizes = {"reward_radius": self.reward_radius, "goal_half_width": self.goal_half_width}
        check_parameters(self.reward, self.horizon, **sizes)

    @property
    def observation_size(self) -> int:
        return 3

    @property
    def action_size(self) -> int:
        return 2

    def sample_task(self, key: jax.Array) -> Any:
        """A random task."""
        raise TypeError(f"{type(self).__name__} does not say how its tasks are sampled")

    def goal(self, task: Any) -> jax.Array:
        """Where the task's goal is, [2] in m."""
        raise TypeError(f"{type(self).__name__} does not say where its goal is")

    def residual(self, task: Any) -> jax.Array:
        """What the robot turns by itself, [] in rad a step."""
        return jnp.zeros(())

    def to_physical(self, action: jax.Array) -> jax.Array:
        """Policy action [2] -> velocities [2] in m/s and rad/s, each within its bounds."""
        velocities = unscale_action(action, self.action_low, self.action_high)
        return jnp.clip(velocities, jnp.asarray(self.action_low), jnp.asarray(self.action_high))

    def to_policy(self, physical_action: jax.Array) -> jax.Array:
        """Velocities [2] in m/s and rad/s -> policy action [2]; `to_physical`'s linear inverse."""
        return scale_action(physical_action, self.action_low, self.action_high)

    def reset(self, key: jax.Array, task: Any = None) -> State:
        """The start: at the origin, heading along x; without a task, a random one."""
        return self.reset_to(jnp.zeros(3), self.sample_task(key) if task is None else task)

    def reset_to(self, obs: jax.Array, task: Any) -> State:
        """The start of an episode at the pose `obs` [3]."""
        zero = jnp.zeros(())
        distance = jnp.linalg.norm(obs[:2] - self.goal(task))
        metrics = {"success": zero, "diverged": zero, "distance": distance}
        return State(Robot(obs, jnp.zeros((), jnp.int32)), obs, zero, zero, metrics, {}, task)

    def step(self, state: State, action: jax.Array) -> State:
        """Drives for `dt` seconds with the policy action [2]."""
        robot: Robot = state.pipeline_state
        residual = self.residual(state.task)
        pose = drive(robot.pose, self.to_physical(action), residual, self.dt)
        offset = pose[:2] - self.goal(state.task)
        distance = jnp.linalg.norm(offset)
        success = jnp.all(jnp.abs(offset) <= self.goal_half_width)
        outside = jnp.any(jnp.abs(pose[:2]) > self.arena)
        metrics = {"success": success.astype(pose.dtype), "distance": distance}
        return replace(
            state,
            pipeline_state=Robot(pose, robot.t + 1),
            obs=pose,
            reward=goal_reward(
                self.reward, distance, success, robot.t, self.reward_radius, self.horizon
            ),
            done=(success | outside).astype(pose.dtype),
            metrics={**state.metrics, **metrics},
        )
