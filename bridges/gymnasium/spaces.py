"""Spaces in physical units, all of them bounded."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from envs_jax import Env
from envs_jax.point2d import Point2D
from envs_jax.wheels import DifferentialDrive

HALF_TURN = 3.2  # rad: no task turns a robot by more in a step; a little over pi
MUJOCO_LIMIT = 1e10  # MuJoCo ends simulations with positions and velocities beyond it


def action_space(env: Env) -> Box:
    """The physical actions. Each number has its bounds; Point2D bounds the length, too."""
    low, high = (np.array(bounds, np.float32) for bounds in (env.action_low, env.action_high))
    return Box(low, high, dtype=np.float32)


def observation_space(env: Env) -> Box:
    """All that can be observed in an episode."""
    high = np.array(_reach(env), np.float32)
    return Box(-high, high, dtype=np.float32)


def _reach(env: Env) -> list[float]:
    """How far from 0 each number of an observation can come, [O]; a little more."""
    if isinstance(env, Point2D):
        return [env.max_step * (env.horizon + 1)] * 2
    if isinstance(env, DifferentialDrive):
        linear, angular = (high * env.dt for high in env.action_high)
        position = env.arena + 2 * linear  # the step that leaves the arena is the last
        return [position, position, (angular + HALF_TURN) * (env.horizon + 1)]
    return [MUJOCO_LIMIT] * env.observation_size
