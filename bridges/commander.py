"""Velocities on their way to a robot: limited, repeated, and zero to stop it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bridges.clock import Clock
from bridges.messages import STOP, Command
from bridges.safety import Limits
from bridges.tracking import Guard
from bridges.transports.base import RobotLink

STOPS = 5  # zero velocities that are sent to stop: some may get lost
BETWEEN_STOPS = 0.02  # s
SOON = 1e-6  # s: a moment this near has come


@dataclass(frozen=True)
class RobotRules:
    """How a robot is driven.

    Attributes:
        limits: of its commands.
        guard: of its odometry.
        injected: rad/s that are added to every action.
        tick: s between repetitions of a command, which robots with a command timeout need.
        patience: s to wait for odometry before it is given up.
        from_start: poses are seen from where the episode began; otherwise as odometry has them.
        dry_run: publish nothing.
    """

    limits: Limits
    guard: Guard
    injected: float = 0.0
    tick: float = 0.05
    patience: float = 10.0
    from_start: bool = True
    dry_run: bool = False


class Commander:
    """Sends what comes nearest to an action, again and again.

    All methods but `brake` are for one thread.

    Attributes:
        sent: all that was published since `begin`, with the clock's time of each.
    """

    def __init__(self, link: RobotLink, clock: Clock, rules: RobotRules) -> None:
        self._link, self._clock, self._rules = link, clock, rules
        self.begin()

    def begin(self) -> None:
        """From rest, with nothing sent yet."""
        self.sent: list[tuple[float, Command]] = []
        self._target = self._last = STOP
        self._last_at = -math.inf

    def aim(self, action: Sequence[float] | np.ndarray) -> None:
        """What `advance` goes toward: linear (m/s) and angular (rad/s) velocity."""
        asked = Command(float(action[0]), float(action[1]) + self._rules.injected)
        self._target = self._rules.limits.clamp(asked)

    def advance(self) -> Command:
        """Sends what comes nearest to the action by now."""
        passed = min(self._clock.now() - self._last_at, self._rules.tick)
        return self._send(self._rules.limits.toward(self._target, self._last, passed))

    def is_due(self) -> bool:
        """Whether a tick has passed since the last command."""
        return self._clock.now() - self._last_at > self._rules.tick - SOON

    def stop(self) -> None:
        """Sends zero velocity, several times.

        Raises:
            Exception: the last one could not be sent, whatever has kept it from being sent.
        """
        self._target = STOP
        for left in reversed(range(STOPS)):
            with suppress(*(Exception,) * bool(left)):
                self._send(STOP)
            self._clock.sleep_until(self._clock.now() + BETWEEN_STOPS)

    def stop_again(self) -> None:
        """Sends zero velocity once more, if that can be done."""
        with suppress(Exception):  # it may go through a moment later
            self._send(STOP)

    def brake(self) -> None:
        """Sends zero velocity, from any thread."""
        self._publish(self._clock.now(), STOP)

    def _send(self, command: Command) -> Command:
        self._last, self._last_at = command, self._clock.now()
        self._publish(self._last_at, command)
        return command

    def _publish(self, moment: float, command: Command) -> None:
        if not self._rules.dry_run:
            self._link.send(command)
            self.sent.append((moment, command))
