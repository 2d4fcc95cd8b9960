"""A simulated robot in real time, or a multiple of it: its process' loop, and what it says."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from bridges.clock import Clock
from bridges.simulation.robot import SimulatedRobot
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.simulation.state import State
from bridges.simulation.view import View, ViewSettings
from bridges.transports import names
from bridges.transports.base import LinkSettings, RobotEnd
from emrld_jax.fields import setting

FRAME = 0.05  # s of ours between the page's pictures


@dataclass
class SimTurtleBotConfig(ViewSettings, SimulatedRobotSettings):
    """The settings of `bridges.sim_turtlebot`."""

    robot: str = setting(
        "auto",
        "how it is reached; auto: rclpy where ROS is, else dds",
        choices=("auto", "rclpy", "dds"),
    )
    command_type: str = setting(
        "twist_stamped",
        "what it takes as velocity command: twist, as Humble's, or twist_stamped, as Jazzy's",
        choices=("twist", "twist_stamped"),
    )
    speed: float = setting(
        1.0, "simulated seconds in one of ours; the bridge needs the same", above=0, at_most=100
    )
    status_every: float | None = setting(5.0, "s of ours between status lines; null: none", above=0)
    link: LinkSettings = field(default_factory=LinkSettings)


def simulate(
    config: SimTurtleBotConfig,
    end: RobotEnd,
    clock: Clock,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
) -> None:
    """Simulates a robot until it is stopped.

    Args:
        config: what it can do, and how it is shown.
        end: its end of a transport, open.
        clock: runs at the speed of the config.
        stopped: whether to stop; asked twenty times a second at least.
        say: takes lines for people.

    Raises:
        BridgeError: the page cannot be offered, or a setting is of no use.
    """
    # stamps begin at ROS's time, as a robot's, and go on as fast as the simulation
    robot = SimulatedRobot(end, config, clock.now(), time.time())
    view = None if config.view is None else View(config, config, config.speed)
    say(greeting(config))
    say(f"page: {view.url}" if view else "page: none (view=8000 offers one)")
    drawn, told = Every(FRAME), Every(config.status_every)
    try:
        while not stopped():
            end.wait(max(0.0, min(robot.next_odometry - clock.now(), FRAME * config.speed)))
            robot.tick(clock.now())
            if view:
                (view.show if drawn.due() else view.record)(robot.state())
            if told.due():
                say(status(robot.state()))
    finally:
        if view:
            view.close()
    say(summary(robot))


class Every:
    """Says when it is time again.

    Args:
        seconds: of ours, between times; None: never.
    """

    def __init__(self, seconds: float | None) -> None:
        self._seconds = seconds
        self._next = time.monotonic()

    def due(self) -> bool:
        """Whether it is time; at first it is."""
        now = time.monotonic()
        if self._seconds is None or now < self._next:
            return False
        self._next = now + self._seconds
        return True


def greeting(config: SimTurtleBotConfig) -> str:
    """What this is, and every setting of the robot."""
    kind = "TwistStamped" if config.command_type == "twist_stamped" else "Twist"
    domain = names.domain_id(config.link)
    first = (
        f"A simulated TurtleBot3 Burger over {config.robot}, domain {domain}: takes {kind} on "
        f"cmd_vel, tells odometry on odom {config.odometry_rate:g} times a second, is put back to "
        f"its start by an Empty on reset. {config.speed:g} simulated seconds in one of ours."
    )
    values = [f"{x.name}={_typed(getattr(config, x.name))}" for x in fields(SimulatedRobotSettings)]
    lines = [*textwrap.wrap(first, 100), *textwrap.wrap(" ".join(values), 100)]
    return "\n".join([*lines, "Ctrl-C stops it."])


def status(state: State) -> str:
    """A line on where the robot is and what it is told."""
    return (
        f"{state.moment:8.1f} s  x {state.x:+.3f} y {state.y:+.3f} theta {state.theta:+.2f}  "
        f"told {state.command.linear:+.2f} m/s {state.command.angular:+.2f} rad/s, "
        f"{state.command_rate:g} times a second  {state.words}"
    )


def summary(robot: SimulatedRobot) -> str:
    """What there was, at the end."""
    return (
        f"stopped after {robot.state().moment:.1f} s: {robot.commands} commands came "
        f"({robot.lost_commands} lost), {robot.odometry} times odometry was told "
        f"({robot.lost_odometry} lost), put back {robot.resets} times"
    )


def _typed(value: Any) -> str:
    """A value as the command line takes it."""
    return "null" if value is None else str(value).replace(" ", "")
