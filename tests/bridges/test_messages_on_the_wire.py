"""Bytes and hashes of the DDS types against rosbags, another implementation of ROS's formats."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from rosbags.typesys import Stores, get_typestore

from bridges.messages import TWIST, TWIST_STAMPED, Command, Odometry
from bridges.ros_messages import (
    command_of,
    fill_odometry,
    fill_stamp,
    fill_twist,
    odometry_of,
    seconds,
    wrapped,
    yaw,
)
from bridges.transports import dds_types
from bridges.transports.dds_types import EMPTY, HASHES, ODOMETRY, TYPES

JAZZY, HUMBLE = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS2_HUMBLE)
KINDS = (ODOMETRY, TWIST, TWIST_STAMPED, EMPTY)


def randomized(message: Any, generator: np.random.Generator, text: str) -> Any:
    """A message of the same type with other numbers everywhere, and the text in its texts."""
    values: dict[str, Any] = {}
    for item in dataclasses.fields(message):
        old = getattr(message, item.name)
        if dataclasses.is_dataclass(old):
            values[item.name] = randomized(old, generator, text)
        elif isinstance(old, list):
            values[item.name] = generator.normal(size=36).tolist()
        elif isinstance(old, float):
            values[item.name] = float(generator.normal())
        else:
            values[item.name] = text if isinstance(old, str) else int(generator.integers(256))
    return type(message)(**values)


def of_rosbags(message: Any, kind: str) -> Any:
    """The same as an object of rosbags."""
    made = JAZZY.types[kind]
    values = {}
    for name, (_, description) in zip(
        (item.name for item in dataclasses.fields(message)),
        JAZZY.fielddefs[kind][1] or [("", (None, None))],
        strict=True,
    ):
        old = getattr(message, name)
        if dataclasses.is_dataclass(old):
            values[name] = of_rosbags(old, description[1])
        else:
            values[name] = np.array(old) if isinstance(old, list) else old
    return made(**values)


@pytest.mark.parametrize("text", ["", "o", "od", "odo", "odom", "base_footprint", "größer"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_bytes_are_those_of_ros(kind: str, text: str) -> None:
    """Texts of all lengths modulo 4, so that all of the alignment is seen."""
    message = randomized(TYPES[kind](), np.random.default_rng(len(text)), text)

    written = message.serialize()

    assert written == bytes(JAZZY.serialize_cdr(of_rosbags(message, kind), kind))
    assert TYPES[kind].deserialize(written) == message


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("store", [JAZZY, HUMBLE], ids=["jazzy", "humble"])
def test_the_hashes_are_those_of_ros(kind: str, store: Any) -> None:
    assert HASHES[kind] == store.hash_rihs01(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_the_names_are_those_of_ros(kind: str) -> None:
    package, name = kind.split("/msg/")

    assert TYPES[kind].__idl__.idl_transformed_typename == f"{package}::msg::dds_::{name}_"


def test_sizes_are_those_measured_with_a_robot() -> None:
    """724 and 52 bytes were measured with rclpy, the frames odom and base_footprint."""
    odometry = dds_types.Odometry()
    fill_odometry(odometry, Odometry(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert len(odometry.serialize()) == 724
    assert len(dds_types.Twist().serialize()) == 52


def test_odometry_comes_back() -> None:
    odometry = Odometry(1_700_000_000.125, 3.5, 1.5, -2.5, -2.0, 0.21, -1.3, "a", "b")
    message = dds_types.Odometry()
    fill_odometry(message, odometry, (0.1, 0.2, 0.3))

    read = JAZZY.deserialize_cdr(message.serialize(), ODOMETRY)

    again = odometry_of(read, 3.5)
    assert again.theta == pytest.approx(-2.0, abs=1e-15)
    assert again._replace(theta=-2.0) == odometry
    matrix = np.zeros((6, 6))
    matrix[0, 0], matrix[1, 1], matrix[5, 5] = 0.1, 0.2, 0.3
    np.testing.assert_array_equal(read.pose.covariance.reshape(6, 6), matrix)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1_700_000_000, 125_000_000)


def test_numbers_are_filled_in_as_floats() -> None:
    """What rclpy refuses, where it checks: ints and numbers of NumPy."""
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace()),
        pose=SimpleNamespace(
            pose=SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
        ),
        twist=SimpleNamespace(
            twist=SimpleNamespace(linear=SimpleNamespace(), angular=SimpleNamespace())
        ),
    )
    one: Any = np.float32(1)
    fill_odometry(message, Odometry(one, 0.0, 1, one, 0, one, 2), (one, 1, 2))
    fill_twist(message.twist.twist, Command(1, one))
    pose, twist = message.pose, message.twist.twist
    numbers = [
        *(pose.pose.position.x, pose.pose.position.y, *pose.covariance),
        *(pose.pose.orientation.z, pose.pose.orientation.w),
        *(twist.linear.x, twist.angular.z),
    ]
    assert {type(number) for number in numbers} == {float}
    stamp = message.header.stamp
    assert (type(stamp.sec), type(stamp.nanosec)) == (int, int)
    assert command_of(twist) == Command(1.0, 1.0)


@pytest.mark.parametrize(
    ("moment", "sec", "nanosec"),
    [(0.0, 0, 0), (1.25, 1, 250_000_000), (2.9999999999, 3, 0), (-0.25, -1, 750_000_000)],
)
def test_times_are_whole_seconds_and_nanoseconds(moment: float, sec: int, nanosec: int) -> None:
    stamp = dds_types.Time()
    fill_stamp(stamp, moment)

    assert (stamp.sec, stamp.nanosec) == (sec, nanosec)
    assert seconds(stamp) == pytest.approx(moment, abs=1e-9)


def rotation(axis: list[float], angle: float) -> list[float]:
    """x, y, z, w of a turn about an axis."""
    unit = np.array(axis) / np.linalg.norm(axis)
    return [*(unit * math.sin(angle / 2)).tolist(), math.cos(angle / 2)]


@pytest.mark.parametrize("angle", [0.0, 0.5, -2.5, 3.1, math.pi])
def test_the_heading_is_the_turn_about_z(angle: float) -> None:
    assert yaw(*rotation([0, 0, 1], angle)) == pytest.approx(angle, abs=1e-12)
    assert yaw(*(-value for value in rotation([0, 0, 1], angle))) == pytest.approx(angle)
    assert wrapped(angle + 2 * math.pi) == pytest.approx(angle)


def test_the_heading_of_a_tilted_robot_is_where_its_x_axis_points() -> None:
    """Against the rotation matrix by Rodrigues' formula."""
    axis, angle = np.array([0.1, -0.2, 0.97]), 1.1
    unit = axis / np.linalg.norm(axis)
    cross = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
    matrix = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

    heading = math.atan2(matrix[1, 0], matrix[0, 0])

    assert yaw(*rotation(axis.tolist(), angle)) == pytest.approx(heading)


def test_half_a_turn_is_pi_whatever_its_sign() -> None:
    assert yaw(0.0, 0.0, 1.0, 0.0) == math.pi
    assert yaw(0.0, 0.0, -1.0, 0.0) == math.pi


@pytest.mark.parametrize(
    "quaternion",
    [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.01), (0.0, 0.0, 0.6, 0.6), (math.nan, 0.0, 0.0, 1.0)],
)
def test_what_is_no_rotation_has_no_heading(quaternion: tuple[float, ...]) -> None:
    assert math.isnan(yaw(*quaternion))
