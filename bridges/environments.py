"""What a bundle says of its environment and its task, from and to those of `envs_jax`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from bridges.bundle import Action, Bundle, Environment, Observation, Zone
from bridges.bundle_checks import BOUNDINGS
from bridges.messages import BridgeError
from bridges.policy import bounded
from envs_jax import Env
from envs_jax.point2d import Point2D
from envs_jax.wheels import DifferentialDrive


def described(env: Env) -> tuple[Environment, Observation, Action]:
    """An environment, as a bundle says it.

    Raises:
        BridgeError: it bounds actions in a way that no bundle can tell.
    """
    parameters: Any = env  # a dataclass whose fields are its parameters
    low, high = ([float(x) for x in bounds] for bounds in (env.action_low, env.action_high))
    return (
        Environment(env.name, asdict(parameters)),
        Observation(list(env.observation_names), list(env.observation_units)),
        Action(list(env.action_names), list(env.action_units), low, high, _bounding(env)),
    )


def described_task(task: Any) -> dict[str, Any]:
    """A task's numbers by name, with no more digits than float32 has."""
    return {name: _shortest(np.asarray(value)) for name, value in task._asdict().items()}


def zone(env: Env, task: Any) -> Zone | None:
    """Where a task pays; None if it is not in the plane."""
    if isinstance(env, Point2D):
        ends: tuple[str, float, float | None] = ("disc", env.goal_radius, None)
    elif isinstance(env, DifferentialDrive):
        ends = ("square", env.goal_half_width, env.arena)
    else:
        return None
    goal = _shortest(np.asarray(env.goal(task)))
    return Zone(goal, env.reward, env.reward_radius, *ends, env.horizon)


def environment_of(bundle: Bundle) -> Env:
    """The environment that a bundle's policy was trained in.

    Raises:
        BridgeError: this version has no such environment, or an extra is missing.
    """
    name, parameters = bundle.environment
    try:
        return envs_jax.make(name, **parameters)
    except (ValueError, ImportError) as error:
        raise BridgeError(f"the bundle's environment cannot be made: {error}") from error


def task_of(bundle: Bundle, env: Env) -> Any:
    """A bundle's task, as the environment has them.

    Raises:
        BridgeError: the environment's tasks are of another kind.
    """
    kind = env.train_tasks()
    shapes = {name: np.shape(value)[1:] for name, value in kind._asdict().items()}
    if {name: np.shape(value) for name, value in bundle.task.items()} != shapes:
        raise BridgeError(f"the bundle's task {bundle.task} is none of {env.name}")
    return type(kind)(**{name: jnp.asarray(x, jnp.float32) for name, x in bundle.task.items()})


def _shortest(numbers: np.ndarray) -> Any:
    """A number or a list of numbers, which as float32 are the given ones."""
    texts = [float(str(x)) for x in numbers.astype(np.float32).ravel()]
    return texts if numbers.ndim else texts[0]


def _bounding(env: Env) -> str:
    """Which of the ways to bound an action the environment goes."""
    generator = np.random.default_rng(0)
    actions = generator.uniform(-3.0, 3.0, (100, env.action_size)).astype(np.float32)
    wanted = np.asarray(jax.vmap(env.to_physical)(jnp.asarray(actions)))
    low, high = np.array(env.action_low), np.array(env.action_high)
    for name in BOUNDINGS:
        if np.allclose(bounded(actions, low, high, name), wanted, atol=1e-6):
            return name
    raise BridgeError(f"{env.name} bounds actions in another way than {' or '.join(BOUNDINGS)}")
