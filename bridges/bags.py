"""An episode as a rosbag2 bag in MCAP, which ROS's tools open, and back.

Topics: `/odom` (nav_msgs/Odometry), `/cmd_vel` (of the type that the robot takes), the control
steps in `/emrld/steps` (std_msgs/Float64MultiArray, whose layout's label names the columns) and
what there is to know about the episode in `/emrld/episode` (std_msgs/String, JSON).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from bridges.episodes import Episode, Step
from bridges.messages import TWIST, BridgeError, Command, Odometry
from bridges.ros_messages import command_of, odometry_of

ODOMETRY, STEPS, ABOUT = (
    "nav_msgs/msg/Odometry",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/String",
)
COLUMNS = (
    *("time", "x", "y", "theta", "action_linear", "action_angular"),
    *("command_linear", "command_angular", "log_prob", "reward", "done", "success"),
    *("odometry_age", "latency"),
)
Message = tuple[float, str, Any]  # s since the episode began, topic, ROS message


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
    messages = _messages(types.types, episode, command_type, about)
    writer = bag.Writer(path, version=9, storage_plugin=bag.StoragePlugin.MCAP)
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=types)
            for topic, kind in topics.items()
        }
        for moment, topic, message in sorted(messages, key=lambda row: row[0]):
            stamp = episode.began_wall + round(1e9 * moment)
            data = types.serialize_cdr(message, topics[topic])
            writer.write(connections[topic], stamp, data)


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
        episode = _episode(rows, about.pop("episode"))
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


def _messages(
    types: Any, episode: Episode, command_type: str, about: Mapping[str, Any]
) -> list[Message]:
    began = episode.began
    told = {
        "began_wall": episode.began_wall,
        "last_pose": [float(x) for x in episode.last_pose],
        "ending": episode.ending,
        "detail": episode.detail,
        "missed": episode.missed,
        "steps": len(episode.steps),
    }
    text = json.dumps({**about, "episode": told}, sort_keys=True)
    moments = [odometry.received for odometry in episode.odometry]
    moments += [moment for moment, _ in episode.commands]
    ended = max(moments, default=began) - began
    return [
        *((o.received - began, "/odom", _odometry(types, o)) for o in episode.odometry),
        *(
            (moment - began, "/cmd_vel", _command(types, command, command_type, moment))
            for moment, command in episode.commands
        ),
        *((step.time - began, "/emrld/steps", _step(types, step, began)) for step in episode.steps),
        (ended, "/emrld/episode", types[ABOUT](text)),
    ]


def _episode(rows: Mapping[str, Sequence[tuple[int, Any]]], told: Mapping[str, Any]) -> Episode:
    began = int(told["began_wall"])
    steps = [_step_of(message) for _, message in rows.get("/emrld/steps", ())]
    if len(steps) != told["steps"]:
        raise ValueError(f"{len(steps)} of {told['steps']} steps are there")
    return Episode(
        began=0.0,
        began_wall=began,
        steps=tuple(steps),
        last_pose=np.array(told["last_pose"], np.float32),
        ending=str(told["ending"]),
        detail=str(told["detail"]),
        missed=int(told["missed"]),
        odometry=tuple(
            odometry_of(message, 1e-9 * (stamp - began)) for stamp, message in rows.get("/odom", ())
        ),
        commands=tuple(
            (1e-9 * (stamp - began), command_of(getattr(message, "twist", message)))
            for stamp, message in rows.get("/cmd_vel", ())
        ),
    )


def _step(types: Any, step: Step, began: float) -> Any:
    values = [
        *(step.time - began, *step.obs, *step.action, *step.command, step.log_prob),
        *(step.reward, step.done, step.success, step.age, step.latency),
    ]
    size = len(COLUMNS)
    row = types["std_msgs/msg/MultiArrayDimension"](",".join(COLUMNS), size, size)
    layout = types["std_msgs/msg/MultiArrayLayout"]([row], 0)
    return types[STEPS](layout, np.array(values, np.float64))


def _step_of(message: Any) -> Step:
    if [row.label for row in message.layout.dim] != [",".join(COLUMNS)]:
        raise ValueError("its steps have other columns")
    values = [float(x) for x in message.data]
    if len(values) != len(COLUMNS) or not all(map(math.isfinite, values)):
        raise ValueError("a step has numbers that are missing or not finite")
    return Step(
        time=values[0],
        obs=np.array(values[1:4], np.float32),
        action=np.array(values[4:6], np.float32),
        command=Command(*values[6:8]),
        log_prob=values[8],
        reward=values[9],
        done=values[10] == 1,
        success=values[11] == 1,
        age=values[12],
        latency=values[13],
    )


def _header(types: Any, stamp: float, frame: str) -> Any:
    seconds, nanoseconds = divmod(round(1e9 * stamp), 10**9)
    time = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    return types["std_msgs/msg/Header"](time, frame)


def _twist(types: Any, command: Command) -> Any:
    vector = types["geometry_msgs/msg/Vector3"]
    return types["geometry_msgs/msg/Twist"](
        vector(command.linear, 0.0, 0.0), vector(0.0, 0.0, command.angular)
    )


def _command(types: Any, command: Command, command_type: str, moment: float) -> Any:
    twist = _twist(types, command)
    if command_type == TWIST:
        return twist
    return types[command_type](_header(types, moment, ""), twist)


def _odometry(types: Any, odometry: Odometry) -> Any:
    """Its covariance is not kept: nothing here reads it."""
    half, none = odometry.theta / 2, np.zeros(36)
    stamp = odometry.stamp if math.isfinite(odometry.stamp) else 0.0
    point = types["geometry_msgs/msg/Point"](odometry.x, odometry.y, 0.0)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(half), math.cos(half))
    pose = types["geometry_msgs/msg/Pose"](point, turn)
    return types[ODOMETRY](
        _header(types, stamp, odometry.frame),
        odometry.child_frame,
        types["geometry_msgs/msg/PoseWithCovariance"](pose, none),
        types["geometry_msgs/msg/TwistWithCovariance"](
            _twist(types, Command(odometry.linear, odometry.angular)), none
        ),
    )
