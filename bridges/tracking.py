"""The robot's pose since an episode began, made of odometry that is guarded as it comes in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bridges.messages import BridgeError, Odometry
from bridges.safety import Fault, fault_of, stale, wrapped

CLOCK_DRIFT = 1e-4  # s a second by which two clocks may part: quartzes that nobody sets
SAME_RATE = (0.6, 1.6)  # of two clocks' speeds; what differs less may be jitter


class Guard(NamedTuple):
    """What odometry is trusted."""

    watchdog: float  # s; what is older says nothing about where the robot is now
    max_linear: float  # m/s that the robot can drive; what goes faster has jumped
    max_angular: float  # rad/s
    geofence: float  # m; |x| and |y| of the pose may not exceed it; infinite: they may


class Tracker:
    """Follows odometry, and remembers the first fault in it.

    Attributes:
        newest: the last odometry that could be read; None: there was none since `forget`.
        fault: what was wrong first since `forget`; None: nothing.
    """

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        # s from a stamp to its arrival, by two clocks, at best; known from one episode to the next
        self._least_delay, self._measured_at = math.inf, 0.0
        self.forget()

    def forget(self) -> None:
        """Begins anew: poses that come next are not compared with those that came before."""
        self.newest: Odometry | None = None
        self.fault: Fault | None = None
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
            parted = CLOCK_DRIFT * (odometry.received - self._measured_at)
            delay = odometry.received - odometry.stamp
            self._least_delay = min(self._least_delay + parted, delay)
            self._measured_at = odometry.received
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
        return now - min(self.newest.received, self.newest.stamp + self._least_delay)

    def check(self, now: float) -> Fault | None:
        """Why the robot may not be driven on; None: it may. The first reason stays."""
        self.fault = self.fault or stale(self.age(now), self._guard.watchdog) or self._strayed()
        return self.fault

    def _strayed(self) -> Fault | None:
        x, y, fence = *(float(value) for value in self.pose()[:2]), self._guard.geofence
        if abs(x) <= fence and abs(y) <= fence:
            return None
        return Fault("arena", f"the robot is at ({x:.2f}, {y:.2f}) m; allowed: {fence:g} m")


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
