"""What a rosbag2 bag holds of a robot's drive, checked: odometry, and commands if there are any."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bridges import bag_messages, bags
from bridges.messages import COMMAND_TYPES, BridgeError, Odometry
from bridges.recording_checks import INDEX
from bridges.ros_messages import command_of, odometry_of

EPISODE = "/emrld/episode"  # the topic on which the bridge's own recordings tell how it drove
SPEED_LIMITS = (1.0, 8.0)  # m/s and rad/s that are no TurtleBot3's: other units, or a reset
NOISE = (0.05, 0.2)  # m and rad between two messages that are no motion


class BagContent(NamedTuple):
    """What a bag holds of a drive; times in s of the odometry's stamps."""

    time: np.ndarray  # [L], of odometry, increasing
    pose: np.ndarray  # [L, 3]: x (m), y (m), theta (rad, continuous), in odometry's frame
    twist: np.ndarray  # [L, 2]: m/s and rad/s, as odometry says
    command_time: np.ndarray  # [K]
    command: np.ndarray  # [K, 2]: m/s and rad/s; K is 0 if there are none
    notes: tuple[str, ...]  # for people
    injected: float = 0.0  # rad/s that the bridge added to what its policy asked for, if it drove


def read(path: Path, odometry_topic: str = "/odom", command_topic: str = "/cmd_vel") -> BagContent:
    """Reads a rosbag2 bag (sqlite3 or MCAP).

    Raises:
        BridgeError: it is none, lacks the topics, or what it says cannot be a TurtleBot3's drive.
    """
    if (path / INDEX).is_file():
        raise BridgeError(
            f"{path} is a whole recording of the bridge; give one of its episodes, such as "
            f"{path / 'episode_000'}"
        )
    kinds = {odometry_topic: (bag_messages.ODOMETRY,), command_topic: COMMAND_TYPES}
    rows = bags.messages(path, {**kinds, EPISODE: (bag_messages.ABOUT,)})
    if not rows[odometry_topic]:
        raise BridgeError(f"{path}: there is no odometry on {odometry_topic}")
    messages = [odometry_of(message, stamp) for stamp, message in rows[odometry_topic]]
    _check_frames({(m.frame, m.child_frame) for m in messages})
    values = np.array([(m.stamp, m.x, m.y, m.theta, m.linear, m.angular) for m in messages])
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise BridgeError(f"{path}: odometry message {row} is not finite: {messages[row]}")
    values, notes = _increasing(path, values)
    values[:, 3] = np.unwrap(values[:, 3])
    _check_speeds(path, values)
    commands = [
        (stamp - _delay(messages), *_command(message)) for stamp, message in rows[command_topic]
    ]
    table = np.array(commands, float).reshape(-1, 3)
    if not np.isfinite(table).all():
        raise BridgeError(f"{path}: a command on {command_topic} is not finite")
    return BagContent(
        *(values[:, 0], values[:, 1:4], values[:, 4:], table[:, 0], table[:, 1:], notes),
        _injected(path, [message.data for _, message in rows[EPISODE]]),
    )


def without_injected(content: BagContent) -> BagContent:
    """With commands as the policy asked for them. Those that stop the robot hold no more."""
    drives = (content.command != 0).any(axis=1)
    command = content.command - np.outer(drives, [0.0, content.injected])
    return content._replace(command=command, injected=0.0)


def _injected(path: Path, texts: Sequence[str]) -> float:
    """rad/s that the bridge added, as the episodes of its own recordings say."""
    try:
        about = [json.loads(text)["recording"] for text in texts[:1]]
        return sum(
            float(each["driving"].get("residual_angular_velocity", 0)) / each["control_period"]
            for each in about
        )
    except (ValueError, KeyError, TypeError, AttributeError, ZeroDivisionError) as error:
        raise BridgeError(
            f"{path}: {EPISODE} does not say how the bridge drove ({error!r})"
        ) from error


def _delay(messages: Sequence[Odometry]) -> float:
    """s from odometry's stamps to its arrivals in the bag; commands have no stamps of their own."""
    return float(np.median([message.received - message.stamp for message in messages]))


def _command(message: Any) -> Sequence[float]:
    return command_of(getattr(message, "twist", message))


def _check_frames(frames: set[tuple[str, str]]) -> None:
    if len(frames) > 1:
        raise BridgeError(f"odometry is of several frames: {sorted(frames)}")
    ((frame, child),) = frames
    if frame.strip("/").rpartition("/")[2] != "odom" or "base" not in child:
        raise BridgeError(
            f"odometry is of {child!r} in {frame!r}; a TurtleBot3's is of 'base_footprint' in "
            "'odom'"
        )


def _increasing(path: Path, values: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """In the order of stamps, each once."""
    if np.ptp(values[:, 0]) == 0:
        raise BridgeError(f"{path}: all odometry has the same stamp, {values[0, 0]:g} s")
    back = int(np.sum(np.diff(values[:, 0]) < 0))
    order = np.argsort(values[:, 0], kind="stable")
    values = values[order]
    values = values[np.append(True, np.diff(values[:, 0]) > 0)]
    notes = (f"{back} odometry messages came out of order and were sorted",) if back else ()
    return values, notes


def _check_speeds(path: Path, values: np.ndarray) -> None:
    passed = np.diff(values[:, 0])
    moved = (np.hypot(*np.diff(values[:, 1:3], axis=0).T), np.abs(np.diff(values[:, 3])))
    for way, noise, limit in zip(moved, NOISE, SPEED_LIMITS, strict=True):
        speed = (way - noise) / passed
        if np.max(speed) > limit:
            row = int(np.argmax(speed))
            raise BridgeError(
                f"{path}: between odometry messages {row} and {row + 1} ({passed[row]:.3f} s) the "
                f"robot moves {moved[0][row]:.2f} m and turns {moved[1][row]:.2f} rad, which no "
                f"TurtleBot3 does: are these m, rad and s? Was it reset?"
            )
