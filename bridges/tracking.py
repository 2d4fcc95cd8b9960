"""The robot's pose since an episode began, made of odometry that is guarded as it comes in."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bridges.messages import BridgeError, Odometry
from bridges.safety import Fault, fault_of, stale, wrapped

DELAYS_KNOWN = 5.0  # s for which a delay is remembered; in them two clocks part by little
SAME_RATE = (0.6, 1.6)  # of two clocks' speeds; what differs less may be jitter


class Room(NamedTuple):
    """A rectangle of poses, m."""

    x_low: float = -math.inf
    x_high: float = math.inf
    y_low: float = -math.inf
    y_high: float = math.inf

    def holds(self, x: float, y: float) -> bool:
        """Whether a place is inside; NaN is not."""
        return self.x_low <= x <= self.x_high and self.y_low <= y <= self.y_high


class Guard(NamedTuple):
    """What odometry is trusted, and where the robot may be."""

    watchdog: float  # s; what is older says nothing about where the robot is now
    max_linear: float  # m/s that the robot can drive; what goes faster has jumped
    max_angular: float  # rad/s
    arena: float  # m; |x| and |y| of the pose may not exceed it: the environment ends there
    room: Room = Room()  # what there is of it here


class Delays:
    """How long odometry is on its way at best, by two clocks that show different times.

    Clocks part (a simulation's that cannot keep up by percents), so the best of the last seconds
    counts; and a robot's clock may be set back.
    """

    def __init__(self) -> None:
        self._rising = deque[tuple[float, float]]()  # (received, delay); what is least comes first

    @property
    def least(self) -> float:
        """s from a stamp to its arrival; infinite if there was none."""
        return self._rising[0][1] if self._rising else math.inf

    def take(self, odometry: Odometry) -> None:
        """Learns from one more, which is the newest."""
        delay = odometry.received - odometry.stamp
        while self._rising and self._rising[-1][1] >= delay:
            self._rising.pop()
        self._rising.append((odometry.received, delay))
        while self._rising[0][0] < odometry.received - DELAYS_KNOWN:
            self._rising.popleft()


class Tracker:
    """Follows odometry, and remembers the first fault in it.

    Attributes:
        newest: the last odometry that could be read; None: there was none since `forget`.
        fault: what was wrong first since `forget`; None: nothing.
    """

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._delays = Delays()  # known from one episode to the next
        self.fault: Fault | None = None
        self.forget()

    def forget(self) -> None:
        """Begins anew: poses that come next are not compared with those that came before."""
        if self.fault and self.fault.reason == "out of order":
            self._delays = Delays()  # its clock was set back: all that comes would seem late
        self.newest: Odometry | None = None
        self.fault = None
        self._heading = 0.0  # rad, of the newest odometry, not wrapped
        self._origin = (0.0, 0.0, 0.0)

    def take(self, messages: Sequence[Odometry]) -> None:
        """Odometry in the order of its arrival."""
        for odometry in messages:
            previous = self.newest
            fault = fault_of(
                previous,
                odometry,
                watchdog=self._guard.watchdog,
                max_linear=self._guard.max_linear,
                max_angular=self._guard.max_angular,
            )
            self.fault = self.fault or fault
            if fault and fault.reason in ("not finite", "out of order"):
                continue
            if previous is None:
                self._heading = odometry.theta
            elif odometry.stamp == previous.stamp:
                continue  # the same again: it gets no younger
            else:
                self._heading += wrapped(odometry.theta - previous.theta)
            self._delays.take(odometry)
            self.newest = odometry

    def start_here(self) -> None:
        """Poses are seen from the newest odometry, from now on."""
        if self.newest is not None:
            self._origin = (self.newest.x, self.newest.y, self._heading)

    def pose(self) -> np.ndarray:
        """x (m), y (m) and theta (rad, continuous) of the newest odometry, [3] float32."""
        if self.newest is None:
            return np.full(3, np.nan, np.float32)
        x, y, theta = self._origin
        dx, dy = self.newest.x - x, self.newest.y - y
        cos, sin = math.cos(theta), math.sin(theta)
        pose = [cos * dx + sin * dy, cos * dy - sin * dx, self._heading - theta]
        return np.array(pose, np.float32)

    def age(self, now: float) -> float:
        """How old the newest odometry is at a time of our clock, in s; infinite if there is none.

        Since it arrived, or since its stamp if that is longer: what was held up on its way is old
        when it arrives. The robot's clock may show another time than ours; it runs as fast, so what
        came through fastest tells the difference.
        """
        if self.newest is None:
            return math.inf
        return now - min(self.newest.received, self.newest.stamp + self._delays.least)

    def check(self, now: float) -> Fault | None:
        """Why the robot may not be driven on; None: it may. The first reason stays."""
        self.fault = self.fault or self._too_old(now) or self._strayed()
        return self.fault

    def _too_old(self, now: float) -> Fault | None:
        arrived = math.inf if self.newest is None else now - self.newest.received
        return stale(arrived, self.age(now), self._guard.watchdog)

    def _strayed(self) -> Fault | None:
        x, y = (float(value) for value in self.pose()[:2])
        arena, room = self._guard.arena, self._guard.room
        here = f"the robot is at ({x:.2f}, {y:.2f}) m; allowed: "
        if not (abs(x) <= arena and abs(y) <= arena):
            return Fault("arena", f"{here}{arena:g} m")
        if not room.holds(x, y):
            return Fault(
                "room",
                f"{here}x from {room.x_low:g} to {room.x_high:g}, y from "
                f"{room.y_low:g} to {room.y_high:g} m (room=)",
            )
        return None


def check_clocks(first: Odometry, last: Odometry, seconds: float) -> None:
    """Refuses odometry of about so many seconds whose clock runs at another speed than ours.

    Raises:
        BridgeError: it does, or there is too little odometry to tell.
    """
    passed = last.received - first.received
    if passed < seconds / 2:
        raise BridgeError("the robot sends hardly any odometry; is it running?")
    rate = (last.stamp - first.stamp) / passed
    if not SAME_RATE[0] < rate < SAME_RATE[1]:
        raise BridgeError(
            f"the robot's clock runs {rate:.2f} times as fast as this one: give speed= the value "
            "that its simulator has, or 1 for a real robot"
        )
