"""A transport by its name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from bridges.clock import Clock, RealClock
from bridges.transports.base import LinkSettings, RobotEnd, RobotLink, TransportError

NAMES = ("auto", "rclpy", "dds", "memory")

# the module, imported when it is chosen, and what the names of its classes begin with
_WHERE = {"rclpy": ("ros", "Ros"), "dds": ("dds", "Dds"), "memory": ("memory", "Memory")}
_MISSING = {
    "rclpy": (
        "robot=rclpy needs ROS 2 with nav_msgs and geometry_msgs: source its setup first (such as"
        " `. /opt/ros/jazzy/setup.bash`) and use its Python's version; without ROS there is"
        " robot=dds"
    ),
    "dds": (
        "robot=dds needs CycloneDDS: pip install -e '.[dds,robot]' in the clone of emrld-jax (there"
        " are wheels for Linux on x86-64, macOS on Apple silicon and Windows; on a robot's own"
        " computer use robot=rclpy)"
    ),
}


def resolved(name: str) -> str:
    """The transport that a name stands for: `auto` is rclpy where it can be imported, else dds."""
    if name != "auto":
        return name
    try:
        # Never by a message package: Debian has ROS 1's under the same names.
        import_module("rclpy")
    except ImportError:
        return "dds"
    return "rclpy"


def link(name: str, settings: LinkSettings, clock: Clock) -> RobotLink:
    """The bridge's end of a transport, not open yet.

    Args:
        name: one of NAMES.
        settings: where the robot is.
        clock: what received odometry is dated with, and what timeouts count in.

    Raises:
        TransportError: the transport is not installed, or cannot go with the clock.
    """
    made: RobotLink = _class(name, clock, "Link")(settings, clock)
    return made


def end(name: str, settings: LinkSettings, clock: Clock) -> RobotEnd:
    """A simulated robot's end of a transport, not open yet; arguments and errors as of `link`."""
    made: RobotEnd = _class(name, clock, "End")(settings, clock)
    return made


def _class(name: str, clock: Clock, which: str) -> Any:
    if name not in NAMES:
        raise TransportError(f"there is no transport {name!r}; there are {', '.join(NAMES)}")
    name = resolved(name)
    if name != "memory" and not isinstance(clock, RealClock):
        raise TransportError(f"robot={name} needs real time; virtual time is for robot=memory")
    module, prefix = _WHERE[name]
    try:
        return getattr(import_module(f"bridges.transports.{module}"), prefix + which)
    except ImportError as error:
        raise TransportError(f"{_MISSING[name]} ({error})") from error
