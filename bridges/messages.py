"""What a robot tells and is told, free of any middleware."""

from __future__ import annotations

from typing import NamedTuple

TWIST = "geometry_msgs/msg/Twist"  # velocity commands of ROS 2 Humble's TurtleBot3
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"  # of Jazzy's and later ones
COMMAND_TYPES = (TWIST, TWIST_STAMPED)


class BridgeError(Exception):
    """Something that whoever runs the robot can mend; the message says what and how."""


class Odometry(NamedTuple):
    """Where a robot believes it is."""

    stamp: float  # s, the robot's clock
    received: float  # s, this process's clock (bridges.clock), when it arrived here
    x: float  # m, in the frame
    y: float  # m
    theta: float  # rad, in (-pi, pi]
    linear: float  # m/s, forward
    angular: float  # rad/s, counterclockwise
    frame: str = "odom"
    child_frame: str = "base_footprint"


class Command(NamedTuple):
    """A velocity command."""

    linear: float  # m/s, forward
    angular: float  # rad/s, counterclockwise


STOP = Command(0.0, 0.0)
