"""An episode as a rosbag2 bag in MCAP, which ROS's tools open, and back.

Topics: `/odom` (nav_msgs/Odometry), `/cmd_vel` (of the type that the robot takes), the control
steps in `/emrld/steps` (std_msgs/Float64MultiArray, whose layout's label names the columns) and
what there is to know about the episode in `/emrld/episode` (std_msgs/String, JSON).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from bridges.bag_messages import ABOUT, ODOMETRY, STEPS, episode_of, messages_of
from bridges.episodes import Episode
from bridges.messages import BridgeError


class BagError(BridgeError):
    """A bag is refused; the message says why."""


class _Rosbags(NamedTuple):
    """The parts of rosbags that are needed."""

    bag: ModuleType
    types: Any  # a type store


@cache
def rosbags() -> _Rosbags:
    """The package that writes and reads bags.

    Raises:
        BridgeError: it is not installed.
    """
    try:
        # only where bags are needed, as it takes a moment
        from rosbags import rosbag2  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise BridgeError(
            "recordings need the package rosbags: pip install -e '.[robot]' in the clone of "
            "emrld-jax; on a robot without JAX, docs/bridge/robot.md says how"
        ) from error
    return _Rosbags(rosbag2, get_typestore(Stores.ROS2_JAZZY))


def write(path: Path, episode: Episode, command_type: str, about: Mapping[str, Any]) -> None:
    """Writes a bag's folder.

    Args:
        path: the folder, which must not exist.
        episode: what happened.
        command_type: one of `bridges.messages.COMMAND_TYPES`.
        about: what else there is to know, as JSON values.
    """
    bag, types = rosbags()
    topics = {
        "/odom": ODOMETRY,
        "/cmd_vel": command_type,
        "/emrld/steps": STEPS,
        "/emrld/episode": ABOUT,
    }
    messages = messages_of(types.types, episode, command_type, about)
    # Humble reads no newer version, and all later ROS reads this one
    writer = bag.Writer(path, version=8, storage_plugin=bag.StoragePlugin.MCAP)
    with writer:
        connections = {
            topic: writer.add_connection(
                topic, kind, typestore=types, offered_qos_profiles=[_qos()]
            )
            for topic, kind in topics.items()
        }
        for moment, topic, message in sorted(messages, key=lambda row: row[0]):
            stamp = episode.began_wall + round(1e9 * moment)
            data = types.serialize_cdr(message, topics[topic])
            writer.write(connections[topic], stamp, data)


def _qos() -> Any:
    """Reliable, as the robot's topics are; ROS asks for one in a bag."""
    from rosbags import interfaces  # noqa: PLC0415

    forever = interfaces.QosTime(9_223_372_036, 854_775_807)
    return interfaces.Qos(
        interfaces.QosHistory.KEEP_LAST,
        10,
        interfaces.QosReliability.RELIABLE,
        interfaces.QosDurability.VOLATILE,
        forever,
        forever,
        interfaces.QosLiveliness.AUTOMATIC,
        forever,
        avoid_ros_namespace_conventions=False,
    )


def read(path: Path) -> tuple[Episode, dict[str, Any]]:
    """Reads what `write` wrote.

    Returns:
        The episode, whose times count from its beginning, and `about`.

    Raises:
        BagError: it is no such bag, or not a whole one.
    """
    bag, types = rosbags()
    rows: dict[str, list[tuple[int, Any]]] = {}
    try:
        with bag.Reader(path) as reader:
            for connection, stamp, data in reader.messages():
                message = types.deserialize_cdr(data, connection.msgtype)
                rows.setdefault(connection.topic, []).append((stamp, message))
    except Exception as error:  # whatever a damaged file makes of the reader
        raise BagError(f"{path} cannot be read as a bag: {error}") from error
    try:
        ((_, text),) = rows["/emrld/episode"]
        about = json.loads(text.data)
        episode = episode_of(rows, about.pop("episode"))
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise BagError(f"{path} is a bag, but not one of an episode ({error!r})") from error
    return episode, about


def messages(path: Path, topics: Mapping[str, Sequence[str]]) -> dict[str, list[tuple[float, Any]]]:
    """What any rosbag2 bag (MCAP or sqlite3) holds on some topics.

    Args:
        path: the bag's folder, or its file.
        topics: the message types that each may have.

    Returns:
        By topic the messages with the time at which each was written down, in s.

    Raises:
        BagError: it cannot be read, or a topic has another type.
    """
    if not path.exists():
        raise BagError(f"{path}: there is no such bag")
    rosbags()
    from rosbags.highlevel import AnyReader  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    rows: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in topics}
    try:
        # bags of older distributions do not hold the definitions of their messages
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            chosen = [c for c in reader.connections if c.topic in topics]
            wrong = [c for c in chosen if c.msgtype not in topics[c.topic]]
            if not wrong:
                for c, stamp, data in reader.messages(connections=chosen) if chosen else ():
                    rows[c.topic].append((1e-9 * stamp, reader.deserialize(data, c.msgtype)))
    except Exception as error:  # whatever a damaged file makes of the reader
        raise BagError(f"{path} cannot be read as a bag: {error}") from error
    for c in wrong:
        allowed = " or ".join(topics[c.topic])
        raise BagError(f"{path}: {c.topic} is of type {c.msgtype}; it must be {allowed}")
    return rows
