"""What keeps a robot safe, in small pieces that change nothing: limits, and the guard of odometry.

A fault ends an episode with zero velocity. The age of odometry is judged, never whether the robot
is "connected": DDS calls a robot that was killed connected for many seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from bridges.messages import BridgeError, Command, Odometry

ROBOT_LINEAR = 0.22  # m/s, TurtleBot3 Burger (and Waffle, which could do 0.26)
ROBOT_ANGULAR = 2.84  # rad/s, TurtleBot3 Burger
JUMP_DISTANCE = 0.1  # m that odometry may move more than the robot can, between two messages
JUMP_ANGLE = 0.3  # rad
JUMP_FACTOR = 1.5  # times the robot's speed limits that still count as driving


class Fault(NamedTuple):
    """Why a robot may not be driven on."""

    reason: str  # "stale", "not finite", "out of order", "jump", "arena", "room", "stalled", ..
    detail: str  # for people


class RobotFault(BridgeError):
    """The robot was stopped because it may not be driven on."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(f"the robot was stopped ({fault.reason}): {fault.detail}")
        self.fault = fault


@dataclass(frozen=True)
class Limits:
    """What commands may be, in m/s and rad/s, and how fast they may change."""

    linear: tuple[float, float]  # least and most
    angular: tuple[float, float]
    linear_acceleration: float  # m/s^2
    angular_acceleration: float  # rad/s^2

    def clamp(self, command: Command) -> Command:
        """The nearest command within the limits.

        Raises:
            BridgeError: the command is not finite.
        """
        if not (math.isfinite(command.linear) and math.isfinite(command.angular)):
            raise BridgeError(f"the command {command} is not finite")
        return Command(
            _within(command.linear, *self.linear), _within(command.angular, *self.angular)
        )

    def toward(self, target: Command, current: Command, seconds: float) -> Command:
        """The command nearest to the target that can follow the current one `seconds` later."""
        linear, angular = self.linear_acceleration * seconds, self.angular_acceleration * seconds
        return Command(
            _within(target.linear, current.linear - linear, current.linear + linear),
            _within(target.angular, current.angular - angular, current.angular + angular),
        )


def limits_of(
    low: tuple[float, float],
    high: tuple[float, float],
    injected: float,
    max_linear: float,
    max_angular: float,
    linear_acceleration: float,
    angular_acceleration: float,
) -> Limits:
    """The smaller of a policy's limits and a robot's.

    Args:
        low: the least that the policy may ask for: linear (m/s) and angular (rad/s) velocity.
        high: the most.
        injected: rad/s that are added to the policy's angular velocity. They stand for what the
            robot does by itself, so the policy's window moves with them; the robot's does not.
        max_linear: of the robot, m/s.
        max_angular: of the robot, rad/s.
        linear_acceleration: m/s^2.
        angular_acceleration: rad/s^2.

    Raises:
        BridgeError: nothing is within both.
    """
    linear = (max(low[0], -max_linear), min(high[0], max_linear))
    angular = (max(low[1] + injected, -max_angular), min(high[1] + injected, max_angular))
    if linear[0] > linear[1] or angular[0] > angular[1]:
        raise BridgeError(
            f"no command is allowed: the policy's are {low} to {high} with {injected:g} rad/s "
            f"added, the robot's at most {max_linear:g} m/s and {max_angular:g} rad/s"
        )
    return Limits(linear, angular, linear_acceleration, angular_acceleration)


def fault_of(
    previous: Odometry | None,
    odometry: Odometry,
    *,
    watchdog: float,
    max_linear: float,
    max_angular: float,
) -> Fault | None:
    """What is wrong with odometry; None: nothing.

    Args:
        previous: what it follows on; None: it is the first.
        watchdog: s of the robot's clock that may pass between two messages.
        max_linear: m/s that the robot can drive; what goes faster has not driven.
        max_angular: rad/s.
    """
    unreadable = _not_finite(odometry)
    if unreadable or previous is None:
        return unreadable
    passed = odometry.stamp - previous.stamp
    if passed < 0:
        return Fault("out of order", f"odometry went back in time by {-passed:.3f} s")
    if passed > watchdog:
        return Fault("stale", f"odometry left out {passed:.2f} s; allowed: {watchdog:g} s")
    return _jumped(previous, odometry, passed, max_linear, max_angular)


def stale(arrived: float, age: float, watchdog: float) -> Fault | None:
    """A fault if the newest odometry is older than allowed.

    Args:
        arrived: s since it came.
        age: s since it was made; not less, for it may have been held up on its way.
        watchdog: s that are allowed.
    """
    if age <= watchdog:
        return None
    if not arrived <= watchdog:
        return Fault("stale", f"no odometry for {arrived:.2f} s; allowed: {watchdog:g} s")
    return Fault(
        "stale",
        f"odometry comes, but {age:.2f} s old by its stamps; allowed: {watchdog:g} s. Either the "
        "network holds it up, or the robot's clock is slower than this one",
    )


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi], in rad."""
    return math.remainder(angle, 2 * math.pi)


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _not_finite(odometry: Odometry) -> Fault | None:
    values = {
        "the stamp": odometry.stamp,
        "x": odometry.x,
        "y": odometry.y,
        "the heading": odometry.theta,
        "the linear velocity": odometry.linear,
        "the angular velocity": odometry.angular,
    }
    for name, value in values.items():
        if not math.isfinite(value):
            return Fault("not finite", f"{name} in odometry is {value}")
    return None


def _jumped(
    previous: Odometry, odometry: Odometry, passed: float, max_linear: float, max_angular: float
) -> Fault | None:
    way = math.hypot(odometry.x - previous.x, odometry.y - previous.y)
    if way > JUMP_DISTANCE + JUMP_FACTOR * max_linear * passed:
        return Fault("jump", f"odometry jumped by {way:.2f} m in {passed:.3f} s")
    turn = abs(wrapped(odometry.theta - previous.theta))
    if turn > JUMP_ANGLE + JUMP_FACTOR * max_angular * passed:
        return Fault("jump", f"odometry jumped by {turn:.2f} rad in {passed:.3f} s")
    return None
