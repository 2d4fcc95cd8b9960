"""What a robot is driven for through Gymnasium: a goal of one's own, or a bundle's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from bridges.bundle import Action, Environment, Observation, Zone, read
from bridges.run_settings import RunConfig
from bridges.settings import check_all
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.transports.base import LinkSettings
from bridges.world import ACTION, OBSERVATION, zone_of
from emrld_jax.runs.usage import did_you_mean

REWARDS = ("sparse", "dense")
SETTINGS = (  # of bridges.run
    *("reset", "yes", "dry_run", "residual_angular_velocity", "watchdog", "max_linear"),
    *("max_angular", "linear_acceleration", "angular_acceleration", "room", "origin"),
    "speed",
    *("link", "sim"),
)
SECTIONS = {"link": LinkSettings, "sim": SimulatedRobotSettings}
MORE = 1.0  # m that odometry may be seen beyond the arena: a robot is stopped only then
TURNS = 2.0  # times what the robot is told that it may turn: it may drift


class Ground(NamedTuple):
    """As much of a bundle as driving without its policy needs."""

    environment: Environment
    task: dict[str, Any]
    zone: Zone | None
    observation: Observation
    action: Action
    control_period: float


def ground(
    bundle: str | None, goal: Sequence[float] | None, reward: str | None, horizon: int | None
) -> Ground:
    """What a robot is driven for; arguments as of `bridges.gymnasium.turtlebot.TurtleBot3Env`.

    Raises:
        BridgeError: the file is no bundle, or its policy drives something else.
        ValueError: an impossible value, or one that the bundle says already.
    """
    rules: dict[str, Any] = {"goal": goal, "reward": reward, "horizon": horizon}
    given = {name: value for name, value in rules.items() if value is not None}
    if bundle is None:
        return _of_goal(**given)
    if given:
        raise ValueError(f"the bundle says what {', '.join(given)} is; leave it out")
    made = read(bundle)
    zone_of(made)
    return Ground(**{name: getattr(made, name) for name in Ground._fields})


def _of_goal(
    goal: Sequence[float] = (2.0, 1.0), reward: str = "sparse", horizon: int = 100
) -> Ground:
    """A goal by the rules of `two_wheeled_drift`, for a robot that does not drift by itself."""
    place = np.asarray(goal, float)
    if place.shape != (2,) or not np.isfinite(place).all():
        raise ValueError(f"goal={goal!r} is not allowed: it must be two finite numbers, in m")
    if reward not in REWARDS:
        raise ValueError(f"reward={reward!r} is unknown; choose one of: {', '.join(REWARDS)}")
    if horizon < 1:
        raise ValueError(f"horizon={horizon} must be at least 1 step")
    return Ground(
        Environment("TurtleBot3", {}),
        {"goal": place.tolist()},
        Zone(place.tolist(), reward, 0.5, "square", 0.1, 2.5, horizon),
        Observation(OBSERVATION, ["m", "m", "rad"]),
        Action(ACTION, ["m/s", "rad/s"], [0.0, -1.5], [0.15, 1.5], "box"),
        0.5,
    )


def run_config(robot: str, settings: Mapping[str, Any]) -> RunConfig:
    """The settings of `bridges.run` that are of use here.

    Raises:
        ValueError: an unknown one, or a value that is not allowed.
    """
    if wrong := sorted(set(settings) - set(SETTINGS)):
        hint = did_you_mean(wrong[0], SETTINGS)
        raise ValueError(
            f"there is no setting {wrong[0]!r}{hint} (there are: {', '.join(SETTINGS)})"
        )
    values = dict(settings)
    for name, kind in SECTIONS.items():
        if isinstance(given := values.get(name), Mapping):
            try:
                values[name] = kind(**given)
            except TypeError as error:
                raise ValueError(f"{name}={given} is not allowed: {error}") from error
    config = RunConfig(robot=robot, **values)
    check_all(config)
    return config


def action_space(ground: Ground) -> Box:
    """Linear velocity (m/s) and angular velocity (rad/s)."""
    low, high = (np.array(x, np.float32) for x in (ground.action.low, ground.action.high))
    return Box(low, high, dtype=np.float32)


def observation_space(ground: Ground, zone: Zone) -> Box:
    """x (m), y (m) and theta (rad, continuous), from where an episode began."""
    reach = ground.action.high[0] * ground.control_period * (zone.horizon + 1)
    place = MORE + (reach if zone.arena is None else zone.arena)
    turn = TURNS * ground.action.high[1] * ground.control_period * (zone.horizon + 1)
    high = np.array([place, place, turn], np.float32)
    return Box(-high, high, dtype=np.float32)
