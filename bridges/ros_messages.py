"""Between this package's messages and ROS's.

The functions read and fill objects with the fields of ROS messages, whoever made their classes:
rclpy, bridges.transports.dds_types and rosbags name them alike. `float()` is around every number
that is filled in, as rclpy refuses ints and NumPy's numbers where it checks fields.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from bridges.messages import Command, Odometry

# of x, y and the turn about z in the row-major 6 x 6 covariance of a pose
# (x, y, z, and turns about x, y, z)
_DIAGONAL = (0, 7, 35)
# A quaternion that is this far from length 1 is no rotation; rounding is a millionth of it.
_NORM_TOLERANCE = 1e-3


def yaw(x: float, y: float, z: float, w: float) -> float:
    """The turn about z of a quaternion, in (-pi, pi]; NaN if its length is not 1."""
    if not abs(math.sqrt(x * x + y * y + z * z + w * w) - 1) <= _NORM_TOLERANCE:  # NaN, too
        return math.nan
    angle = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return math.pi if angle == -math.pi else angle


def turn(theta: float) -> tuple[float, float]:
    """z and w of the quaternion that turns about z; NaN if the angle is no number."""
    if not math.isfinite(theta):
        return math.nan, math.nan
    return math.sin(theta / 2), math.cos(theta / 2)


def wrapped(theta: float) -> float:
    """An angle as a pose's quaternion keeps it, in (-pi, pi]."""
    return yaw(0.0, 0.0, *turn(theta))


def seconds(stamp: Any) -> float:
    """A ROS time in s."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def fill_stamp(stamp: Any, moment: float) -> None:
    """A time in s as whole seconds (rounded down) and nanoseconds."""
    nanoseconds = round((moment - math.floor(moment)) * 1e9)
    carry, stamp.nanosec = divmod(nanoseconds, 10**9)
    stamp.sec = math.floor(moment) + carry


def odometry_of(message: Any, received: float) -> Odometry:
    """What a nav_msgs/Odometry says; NaN passes.

    Args:
        message: the ROS message.
        received: s, when it arrived.
    """
    pose, twist = message.pose.pose, message.twist.twist
    rotation = pose.orientation
    return Odometry(
        stamp=seconds(message.header.stamp),
        received=received,
        x=float(pose.position.x),
        y=float(pose.position.y),
        theta=yaw(rotation.x, rotation.y, rotation.z, rotation.w),
        linear=float(twist.linear.x),
        angular=float(twist.angular.z),
        frame=message.header.frame_id,
        child_frame=message.child_frame_id,
    )


def fill_odometry(message: Any, odometry: Odometry, covariance: Sequence[float]) -> None:
    """Fills a new nav_msgs/Odometry.

    Args:
        message: the ROS message, as its class makes it.
        odometry: what it is to say.
        covariance: of x, y (m^2) and theta (rad^2), the diagonal.
    """
    fill_stamp(message.header.stamp, odometry.stamp)
    message.header.frame_id = odometry.frame
    message.child_frame_id = odometry.child_frame
    pose, twist = message.pose.pose, message.twist.twist
    pose.position.x, pose.position.y = float(odometry.x), float(odometry.y)
    pose.orientation.z, pose.orientation.w = turn(odometry.theta)
    matrix = [0.0] * 36
    for index, variance in zip(_DIAGONAL, covariance, strict=True):
        matrix[index] = float(variance)
    message.pose.covariance = matrix
    twist.linear.x, twist.angular.z = float(odometry.linear), float(odometry.angular)


def command_of(twist: Any) -> Command:
    """What a geometry_msgs/Twist says."""
    return Command(float(twist.linear.x), float(twist.angular.z))


def fill_twist(twist: Any, command: Command) -> None:
    """Fills a new geometry_msgs/Twist."""
    twist.linear.x, twist.angular.z = float(command.linear), float(command.angular)
