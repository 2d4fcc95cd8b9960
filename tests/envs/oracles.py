"""The environments once more: float64, plain Python, one step at a time, from the equations.

Nothing here calls `envs_jax`, and every number is written again, so that a wrong constant shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

HORIZON = 100
HALF_SECOND = 0.5
ARENA = 2.5


class Expected(NamedTuple):
    """What one step must give."""

    obs: np.ndarray
    distance: float
    zone: str  # "success", "near", "far" or "outside"
    margin: float  # distance to the closest zone boundary: rounding decides where it is tiny

    def reward(self, t: int, kind: str) -> float:
        """The reward of the step numbered t."""
        if kind == "dense":
            return -self.distance
        return {
            "success": float(HORIZON - t - 1),
            "near": 1.0 - self.distance,
            "far": 0.0,
            "outside": 0.0,
        }[self.zone]

    @property
    def done(self) -> float:
        return float(self.zone in ("success", "outside"))


@dataclass(frozen=True)
class PointOracle:
    """Point2D."""

    def displacement(self, action: np.ndarray) -> np.ndarray:
        dx, dy = 0.1 * float(action[0]), 0.1 * float(action[1])
        norm = math.hypot(dx, dy)
        shorten = 0.1 / norm if norm > 0.1 else 1.0
        return np.array([dx * shorten, dy * shorten])

    def step(self, obs: np.ndarray, action: np.ndarray, goal: np.ndarray, drift: float) -> Expected:
        assert drift == 0.0
        position = obs + self.displacement(action)
        distance = math.hypot(position[0] - goal[0], position[1] - goal[1])
        margin = min(abs(distance - 0.02), abs(distance - 0.2))
        if distance <= 0.02:
            return Expected(position, distance, "success", margin)
        return Expected(position, distance, "near" if distance <= 0.2 else "far", margin)

    def before(self, target: np.ndarray, theta: float, action: np.ndarray) -> np.ndarray:
        """The observation from which this action leads to `target`."""
        return target - self.displacement(action)


@dataclass(frozen=True)
class WheelsOracle:
    """TwoWheeled, and its version with drift."""

    max_linear: float
    max_angular: float
    half_width: float

    def velocities(self, action: np.ndarray) -> tuple[float, float]:
        linear = (float(action[0]) + 1.0) / 2.0 * self.max_linear
        angular = float(action[1]) * self.max_angular
        return (
            min(max(linear, 0.0), self.max_linear),
            min(max(angular, -self.max_angular), self.max_angular),
        )

    def step(self, obs: np.ndarray, action: np.ndarray, goal: np.ndarray, drift: float) -> Expected:
        linear, angular = self.velocities(action)
        theta = float(obs[2])
        x = float(obs[0]) + linear * math.cos(theta) * HALF_SECOND
        y = float(obs[1]) + linear * math.sin(theta) * HALF_SECOND
        pose = np.array([x, y, theta + drift + angular * HALF_SECOND])
        dx, dy = abs(x - goal[0]), abs(y - goal[1])
        distance = math.hypot(dx, dy)
        edges = (dx - self.half_width, dy - self.half_width, distance - 0.5)
        margin = min(abs(edge) for edge in (*edges, abs(x) - ARENA, abs(y) - ARENA))
        return Expected(pose, distance, self._zone(x, y, dx, dy, distance), margin)

    def _zone(self, x: float, y: float, dx: float, dy: float, distance: float) -> str:
        if dx <= self.half_width and dy <= self.half_width:
            return "success"
        if abs(x) > ARENA or abs(y) > ARENA:
            return "outside"
        return "near" if distance <= 0.5 else "far"

    def before(self, target: np.ndarray, theta: float, action: np.ndarray) -> np.ndarray:
        """The observation, with heading theta, from which this action leads to `target`."""
        ahead = self.velocities(action)[0] * HALF_SECOND
        return np.array(
            [target[0] - ahead * math.cos(theta), target[1] - ahead * math.sin(theta), theta]
        )


ORACLES: dict[str, PointOracle | WheelsOracle] = {
    "point2d": PointOracle(),
    "two_wheeled": WheelsOracle(0.22, 2.84, 0.2),
    "two_wheeled_drift": WheelsOracle(0.15, 1.5, 0.1),
}
