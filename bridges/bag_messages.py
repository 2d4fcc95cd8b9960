"""An episode as ROS messages, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bridges.episodes import Episode, Step
from bridges.messages import TWIST, Command, Odometry
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


def messages_of(
    types: Any, episode: Episode, command_type: str, about: Mapping[str, Any]
) -> list[Message]:
    """What a bag of an episode holds, in no order.

    Args:
        types: the messages' classes by name.
        episode: what happened.
        command_type: one of `bridges.messages.COMMAND_TYPES`.
        about: what else there is to know, as JSON values.
    """
    began, wall = episode.began, 1e-9 * episode.began_wall
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
        *((o.received - began, "/odom", odometry_message(types, o)) for o in episode.odometry),
        *(
            (t - began, "/cmd_vel", command_message(types, command, command_type, wall + t - began))
            for t, command in episode.commands
        ),
        *((step.time - began, "/emrld/steps", _step(types, step, began)) for step in episode.steps),
        (ended, "/emrld/episode", types[ABOUT](text)),
    ]


def episode_of(rows: Mapping[str, Sequence[tuple[int, Any]]], told: Mapping[str, Any]) -> Episode:
    """The episode whose messages were written, by topic, each with its time in ns.

    Raises:
        KeyError, ValueError, TypeError, AttributeError: they are not of an episode, or not whole.
    """
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


def command_message(types: Any, command: Command, command_type: str, stamp: float) -> Any:
    """The stamp is in s since 1970, whatever clock the episode lived by."""
    twist = _twist(types, command)
    if command_type == TWIST:
        return twist
    return types[command_type](_header(types, stamp, ""), twist)


def odometry_message(types: Any, odometry: Odometry) -> Any:
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
