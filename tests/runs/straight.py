"""A scripted demonstrator for Point2D: straight lines from the origin to the goals."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp

from emrld_jax.demos import DemoFile, DemoSet, empty, replay, save
from emrld_jax.types import Demos
from envs_jax import make
from envs_jax.point2d import Point2D

STEPS = 20  # of 0.1 m, to goals 2 m away


def straight_lines(env: Point2D, goals: jnp.ndarray) -> DemoSet:
    """Demonstrations that reach `goals` [M, 2] by steps of equal length."""
    displacement = goals / STEPS  # [M, 2] m
    obs = displacement[:, None] * jnp.arange(STEPS)[None, :, None]
    action = jnp.broadcast_to((displacement / env.max_step)[:, None], obs.shape)
    demos = Demos(obs, action, jnp.ones(obs.shape[:2]))
    tasks = type(env.train_tasks())(goals)
    return DemoSet(demos, tasks, *replay(env, tasks, demos))


def write_demos(path: Path, num_train: int = 3, num_test: int = 2) -> Path:
    """Writes a file of straight lines to the first training and held-out goals."""
    env = make("point2d")
    assert isinstance(env, Point2D)
    train = straight_lines(env, env.train_tasks().goal[:num_train])
    test = straight_lines(env, env.test_tasks().goal[:num_test]) if num_test else empty(env)
    save(path, DemoFile("point2d", "optimal", train, test, {"by": "a test"}), env)
    return path
