"""How a TurtleBot3 moves: its velocities ramp to the commanded ones, and its pose follows exactly.

Nothing here depends on how time is cut into calls (up to rounding), nor on any clock.
"""

from __future__ import annotations

import math

import numpy as np

from bridges.messages import STOP, Command
from bridges.simulation.settings import SimulatedRobotSettings, of_length

# Gauss-Legendre quadrature over [0, 1] for the path while velocities change: with at most
# LONGEST seconds at a time its error is below rounding for the turns that a robot makes.
_NODES, _WEIGHTS = (values.tolist() for values in np.polynomial.legendre.leggauss(5))
LONGEST = 0.1  # s
_TINY = 1e-12  # s, and of a velocity's change its part: rounding, not time


def displacement(
    theta: float, linear: tuple[float, float], angular: tuple[float, float], seconds: float
) -> tuple[float, float]:
    """How far a robot gets whose velocities change evenly.

    An arc if they do not change at all, of any length; otherwise give it at most LONGEST seconds.

    Args:
        theta: rad, the heading at first.
        linear: m/s forward, at first and at last.
        angular: rad/s counterclockwise, at first and at last.
        seconds: how long it takes.

    Returns:
        Along x and along y, in m.
    """
    (v, v_end), (w, w_end) = linear, angular
    if v == v_end and w == w_end:
        half = w * seconds / 2
        chord = v * seconds * (math.sin(half) / half if half else 1.0)
        return chord * math.cos(theta + half), chord * math.sin(theta + half)
    x = y = 0.0
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        share = (node + 1) / 2
        speed = (v + share * (v_end - v)) * seconds * weight / 2
        heading = theta + (w * share + (w_end - w) * share**2 / 2) * seconds
        x += speed * math.cos(heading)
        y += speed * math.sin(heading)
    return x, y


class TurtleBot3:
    """The robot itself: where it is, how fast it is, and what it was last told.

    Attributes:
        x, y: m.
        theta: rad, counterclockwise from the x axis, not wrapped.
        linear: m/s forward, as it really is.
        angular: rad/s counterclockwise that its wheels turn it, as it really is.
        target: what the velocities go to: the last command, cut to what the robot can do.
        timed_out: it was stopped because no command came in time.

    Raises:
        SettingError: the start is not three numbers.
    """

    def __init__(self, settings: SimulatedRobotSettings) -> None:
        self._settings = settings
        self._start = of_length("start", settings.start, "x, y, theta")
        self.reset()

    def reset(self) -> None:
        """Puts the robot back to its start, at rest; commands are forgotten."""
        self.x, self.y, self.theta = self._start
        self.linear = self.angular = 0.0
        self.target = STOP
        self.timed_out = False
        self._patience = math.inf  # s until the command times out

    @property
    def moving(self) -> bool:
        """Whether its wheels turn, or are told to."""
        return any((self.linear, self.angular, *self.target))

    @property
    def turning(self) -> float:
        """rad/s counterclockwise, drift included."""
        return self.angular + (self._settings.drift if self.moving else 0.0)

    def command(self, command: Command) -> bool:
        """Takes a velocity command, unless it is no number: then it is as if it had not come."""
        if not all(math.isfinite(value) for value in command):
            return False
        settings = self._settings
        linear = _bounded(self._cut(command.linear), settings.max_linear)
        angular = _bounded(self._cut(command.angular), settings.max_angular)
        self._aim(Command(linear, angular))
        self.timed_out = False
        timeout = settings.command_timeout
        self._patience = math.inf if timeout is None else timeout
        return True

    def advance(self, seconds: float) -> None:
        """Lets time pass."""
        while seconds > 0:
            piece = min(seconds, self._until_change())
            self._move(piece)
            self._patience -= piece
            if self._patience <= _TINY:
                self.timed_out = self.target != STOP
                self._aim(STOP)
                self._patience = math.inf
            seconds -= piece

    def _aim(self, target: Command) -> None:
        self.target = target
        self.linear = _approach(self.linear, target.linear, self._settings.linear_acceleration, 0)
        self.angular = _approach(
            self.angular, target.angular, self._settings.angular_acceleration, 0
        )

    def _cut(self, value: float) -> float:
        """Toward zero, by the same product as the robot's own node: 0.29 * 100 is below 29."""
        quantum = self._settings.quantization
        return value if quantum is None else math.trunc(value * (1 / quantum)) / (1 / quantum)

    def _until_change(self) -> float:
        """s for which each velocity changes evenly, or not at all; not more than LONGEST if any."""
        settings = self._settings
        linear = _ramp(self.linear, self.target.linear, settings.linear_acceleration)
        angular = _ramp(self.angular, self.target.angular, settings.angular_acceleration)
        ramps = [time for time in (linear, angular) if time > 0]
        return min(self._patience, *ramps, LONGEST) if ramps else self._patience

    def _move(self, seconds: float) -> None:
        settings, target, drift = self._settings, self.target, self.turning - self.angular
        linear = _approach(self.linear, target.linear, settings.linear_acceleration, seconds)
        angular = _approach(self.angular, target.angular, settings.angular_acceleration, seconds)
        rates = (self.angular + drift, angular + drift)
        x, y = displacement(self.theta, (self.linear, linear), rates, seconds)
        self.x, self.y = self.x + x, self.y + y
        self.theta += sum(rates) / 2 * seconds
        self.linear, self.angular = linear, angular


def _bounded(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _ramp(value: float, goal: float, acceleration: float | None) -> float:
    """s until the value is at its goal."""
    return 0.0 if acceleration is None else abs(goal - value) / acceleration


def _approach(value: float, goal: float, acceleration: float | None, seconds: float) -> float:
    """The value some seconds later, on its way to its goal."""
    left = goal - value
    if acceleration is None or abs(left) <= acceleration * seconds * (1 + _TINY):
        return goal
    return value + math.copysign(acceleration * seconds, left)
