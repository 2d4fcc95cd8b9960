"""A teleoperated drive, cut into control periods."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bridges.bag_content import BagContent
from bridges.messages import BridgeError

MOVING = (0.005, 0.02)  # m/s and rad/s below which a robot stands still
GAP = 0.5  # s without odometry that is told
LEAST = (0.05, 2)  # m from where it began and control steps of a drive that shows anything
LONGEST_GAP = 2.0  # s without odometry that is refused within the drive


class Drive(NamedTuple):
    """A drive at the control period, N steps, seen from where it began."""

    pose: np.ndarray  # [N + 1, 3], before each action, and after the last
    action: np.ndarray  # [N, 2], mean commands of each period: m/s and rad/s
    notes: tuple[str, ...]


def resampled(content: BagContent, period: float) -> Drive:
    """The drive from the first motion to the last, at the control period.

    Poses are interpolated between odometry messages. An action is the mean of what was commanded in
    its period (a command holds until the next one); without commands, the mean of odometry's twist.

    Raises:
        BridgeError: the robot hardly moves, or odometry is missing for too long.
    """
    start, end = _moving(content)
    number = max(1, math.ceil((end - start) / period - 1e-6))
    moments = start + period * np.arange(number + 1)
    notes = list(content.notes)
    _check_gaps(content.time, start, end, notes)
    pose = np.stack([np.interp(moments, content.time, column) for column in content.pose.T], axis=1)
    if len(content.command):
        action = _held_means(content.command_time, content.command, moments)
    else:
        notes.append("no commands are in the bag: actions are odometry's velocities")
        action = _held_means(content.time, content.twist, moments)
    _check_moved(pose, number)
    return Drive(aligned(pose), action, tuple(notes))


def aligned(pose: np.ndarray) -> np.ndarray:
    """Poses seen from the first one. [L, 3] -> [L, 3]."""
    x, y, theta = pose[0]
    cos, sin = math.cos(theta), math.sin(theta)
    dx, dy = pose[:, 0] - x, pose[:, 1] - y
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, pose[:, 2] - theta], axis=1)


def _moving(content: BagContent) -> tuple[float, float]:
    """When the robot begins to be driven and when it has stopped, in s."""
    time, values = content.time, content.twist
    if len(content.command):
        time, values = content.command_time, content.command
    (moving,) = np.nonzero((np.abs(values) > MOVING).any(axis=1))
    if not len(moving):
        raise BridgeError("the robot is never driven in this bag")
    start = max(time[moving[0]], content.time[0])
    # the last velocity holds until the next one, or to the end of the bag
    end = min([content.time[-1], *time[moving[-1] + 1 : moving[-1] + 2]])
    if end <= start:
        raise BridgeError("the drive is not within the odometry of this bag")
    return float(start), float(end)


def _check_moved(pose: np.ndarray, number: int) -> None:
    way = float(np.max(np.hypot(*(pose[:, :2] - pose[0, :2]).T)))
    if way < LEAST[0] or number < LEAST[1]:
        raise BridgeError(
            f"the robot hardly moves in this bag: {way:.3f} m from where it began, in {number} "
            f"control step{'s' * (number > 1)}; a demonstration needs at least {LEAST[0]:g} m and "
            f"{LEAST[1]} steps"
        )


def _check_gaps(time: np.ndarray, start: float, end: float, notes: list[str]) -> None:
    inside = time[(time >= start) & (time <= end)]
    gaps = np.diff(np.concatenate([[start], inside, [end]]))
    longest = float(np.max(gaps))
    if longest > LONGEST_GAP:
        raise BridgeError(
            f"odometry is missing for {longest:.1f} s of the drive; at most {LONGEST_GAP:g} s can "
            "be bridged"
        )
    number = int(np.sum(gaps > GAP))
    notes.append(
        f"odometry: {len(inside)} messages in {end - start:.1f} s, longest gap {longest:.2f} s, "
        f"{number} above {GAP:g} s"
    )


def _held_means(time: np.ndarray, values: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Means over the periods between moments of values that hold until the next. [N, 2]."""
    edges = np.unique(np.concatenate([moments, time[(time > moments[0]) & (time < moments[-1])]]))
    index = np.searchsorted(time, edges[:-1] + 1e-9, side="right") - 1
    held = np.where((index >= 0)[:, None], values[np.maximum(index, 0)], 0.0)
    integral = np.concatenate([np.zeros((1, 2)), np.cumsum(held * np.diff(edges)[:, None], axis=0)])
    at = integral[np.searchsorted(edges, moments)]
    means: np.ndarray = np.diff(at, axis=0) / np.diff(moments)[:, None]
    return means
