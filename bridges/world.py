"""The robot that a command is told to drive, and the clock that it lives by."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

from bridges.bundle import Action, Environment, Observation, Zone
from bridges.clock import Clock, RealClock, VirtualClock
from bridges.commander import RobotRules
from bridges.messages import BridgeError
from bridges.run_settings import RunConfig
from bridges.safety import limits_of
from bridges.settings import SettingError
from bridges.simulation.robot import SimulatedRobot
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.tracking import Guard, Room
from bridges.transports import choice, memory
from bridges.transports.base import RobotLink

VIRTUAL_STEP = 0.01  # s
OBSERVATION = ["x", "y", "theta"]
ACTION = ["linear_velocity", "angular_velocity"]


class Drivable(Protocol):
    """What a robot is driven by: a bundle, or as much of one as says what may be done."""

    @property
    def environment(self) -> Environment: ...
    @property
    def observation(self) -> Observation: ...
    @property
    def action(self) -> Action: ...
    @property
    def zone(self) -> Zone | None: ...
    @property
    def control_period(self) -> float: ...


class World(NamedTuple):
    """A robot within reach."""

    link: RobotLink
    clock: Clock


def world(config: RunConfig) -> World:
    """What the settings name; nothing is opened yet.

    Raises:
        SettingError: settings that do not go together.
        TransportError: a transport that is not installed.
    """
    if config.robot != "memory":
        if config.sim != SimulatedRobotSettings():
            raise SettingError(
                "sim.* is for robot=memory; a simulator in another process has its own settings"
            )
        clock = RealClock(config.speed)
        return World(choice.link(config.robot, config.link, clock), clock)
    if config.speed != 1:
        raise SettingError("speed has no meaning with robot=memory: it is as fast as it can be")

    def tick(moment: float) -> None:
        robot.tick(moment)

    virtual = VirtualClock(VIRTUAL_STEP, tick)
    link, end = memory.pair(virtual, config.link)
    end.open()
    robot = SimulatedRobot(end, config.sim)
    return World(link, virtual)


def zone_of(bundle: Drivable) -> Zone:
    """The zone of a bundle that drives a TurtleBot3.

    Raises:
        BridgeError: it drives something else.
    """
    if (bundle.observation.names, bundle.action.names) != (OBSERVATION, ACTION):
        raise BridgeError(
            f"the bundle is of {bundle.environment.name}, whose policy sees "
            f"{', '.join(bundle.observation.names)} and gives {', '.join(bundle.action.names)}; "
            f"a TurtleBot3 needs one that sees {', '.join(OBSERVATION)} and gives "
            f"{', '.join(ACTION)}"
        )
    if (bundle.observation.units, bundle.action.units) != (["m", "m", "rad"], ["m/s", "rad/s"]):
        raise BridgeError(
            f"the bundle's units are {bundle.observation.units} and {bundle.action.units}; a "
            "TurtleBot3 needs m, rad, m/s and rad/s"
        )
    if bundle.zone is None:
        raise BridgeError("the bundle does not say where its goal is")
    return bundle.zone


def rules_of(config: RunConfig, bundle: Drivable) -> RobotRules:
    """How a robot is driven by this bundle's policy.

    Raises:
        BridgeError: its limits and the robot's exclude each other, it drives something else, or
            its goal is outside the room.
    """
    zone, low, high = zone_of(bundle), bundle.action.low, bundle.action.high
    injected = config.residual_angular_velocity / bundle.control_period
    limits = limits_of(
        (low[0], low[1]),
        (high[0], high[1]),
        injected,
        config.max_linear,
        config.max_angular,
        config.linear_acceleration,
        config.angular_acceleration,
    )
    # what a robot that was told too much by another may drive is more than it may be told by us
    fastest = (max(config.max_linear, high[0]), max(config.max_angular, high[1]))
    arena = math.inf if zone.arena is None else zone.arena
    guard = Guard(config.watchdog, *fastest, arena, room_of(config.room, zone))
    return RobotRules(
        limits,
        guard,
        injected=injected,
        patience=config.link.connect_timeout * config.speed,
        from_start=config.origin == "start",
        dry_run=config.dry_run,
    )


def room_of(numbers: list[float] | None, zone: Zone) -> Room:
    """Where there is room for the robot.

    Raises:
        SettingError: the numbers are no rectangle, or the goal is outside it.
    """
    if numbers is None:
        return Room()
    if len(numbers) != 4 or numbers[0] >= numbers[1] or numbers[2] >= numbers[3]:
        raise SettingError(
            f"room={numbers} is not allowed: it must be [x from, x to, y from, y to] in m"
        )
    room = Room(*numbers)
    if not room.holds(zone.goal[0], zone.goal[1]):
        raise SettingError(f"room={numbers} leaves out the goal, which is at {list(zone.goal)} m")
    return room


def driving_settings(config: RunConfig) -> dict[str, Any]:
    """The settings that a recording's episodes depend on, as JSON values."""
    names = (
        *("residual_angular_velocity", "watchdog", "max_linear", "max_angular"),
        *("linear_acceleration", "angular_acceleration", "origin", "seed"),
    )
    values = asdict(config)
    simulated = config.robot == "memory"  # any other is the same robot, however it is reached
    return {
        "robot": "memory" if simulated else "real",
        **{name: values[name] for name in names},
        **{f"sim.{name}": value for name, value in values["sim"].items() if simulated},
    }
