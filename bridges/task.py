"""What a control step was worth, and whether it ended the episode: the environment's rules."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bridges.bundle import Zone


class Outcome(NamedTuple):
    """What one control step led to."""

    reward: float
    done: bool  # the environment ends the episode here (the horizon is the driver's business)
    success: bool


def outcome(zone: Zone, x: float, y: float, t: int) -> Outcome:
    """What step `t` (from 0) was worth that led to the position (x, y), in m.

    In float32, as the environments compute: on the edge of a zone a robot counts the same.
    """
    offset = np.array([x, y], np.float32) - np.array(zone.goal, np.float32)
    distance, size = np.sqrt(np.sum(offset**2)), np.float32(zone.success_size)
    near = distance <= size if zone.success == "disc" else np.all(np.abs(offset) <= size)
    success = bool(near)
    done = success or is_outside(zone, x, y)
    return Outcome(_reward(zone, distance, success, t), done, success)


def is_outside(zone: Zone, x: float, y: float) -> bool:
    """Whether the position (x, y), in m, is outside the arena."""
    arena = np.float32(math.inf if zone.arena is None else zone.arena)
    return bool(np.any(np.abs(np.array([x, y], np.float32)) > arena))


def distance_to_goal(zone: Zone, x: float, y: float) -> float:
    """From the position (x, y), in m."""
    return math.hypot(x - zone.goal[0], y - zone.goal[1])


def _reward(zone: Zone, distance: np.float32, success: bool, t: int) -> float:
    """As `envs_jax.goals.goal_reward`."""
    if zone.reward == "dense":
        return -float(distance)
    if success:
        return float(zone.horizon - t - 1)
    return float(1 - distance) if distance <= np.float32(zone.reward_radius) else 0.0
