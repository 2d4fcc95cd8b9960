"""A robot in a few lines, in a clock of its own: for tests of what drives it, not of any wire."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from bridges.clock import VirtualClock
from bridges.commander import RobotRules
from bridges.messages import STOP, TWIST_STAMPED, Command, Odometry
from bridges.safety import Limits, limits_of
from bridges.tracking import Guard, Room

STEP = 0.01  # s
EVERY = 3  # steps from one odometry to the next

Change = Callable[[float, Odometry], Sequence[Odometry]]


class FakeRobot:
    """Both ends in one: it drives as it is told at once, and can tell wrong things.

    Attributes:
        change: (time, odometry) -> what is told instead.
        received: every command, with its time.
        delay: s from odometry's stamp to its arrival.
        drivers: others who command it.
        drives: whether the link was opened to send commands.
    """

    command_type = TWIST_STAMPED

    def __init__(self, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.clock = VirtualClock(STEP, self._tick)
        self.start = self.pose = start
        self.change: Change = lambda now, odometry: [odometry]
        self.received: list[tuple[float, Command]] = []
        self.resets = 0
        self.closed = 0
        self.stamp_rate, self.stamp_offset = 1.0, 1000.0
        self.delay = 0.0
        self.drives, self.drivers = True, list[str]()
        self._command = STOP
        self._sending: list[Odometry] = []
        self._arrived: list[Odometry] = []
        self._steps = 0

    def open(self, *, drives: bool = True) -> None:
        self.drives = drives

    def others(self) -> Sequence[str]:
        return self.drivers if self.drives else ()

    def close(self) -> None:
        self.closed += 1

    def send(self, command: Command) -> None:
        self.received.append((self.clock.now(), command))
        self._command = command

    def request_reset(self) -> None:
        self.resets += 1
        self.pose = self.start

    def wait(self, timeout: float) -> bool:
        end = self.clock.now() + timeout
        while not self._arrived and self.clock.now() < end - 1e-9:
            self.clock.sleep_until(min(end, self.clock.now() + STEP))
        return bool(self._arrived)

    def take(self) -> Sequence[Odometry]:
        taken, self._arrived = self._arrived, []
        return taken

    def _tick(self, now: float) -> None:
        x, y, theta = self.pose
        linear, angular = self._command
        self.pose = (
            x + linear * STEP * math.cos(theta),
            y + linear * STEP * math.sin(theta),
            theta + angular * STEP,
        )
        self._steps += 1
        if self._steps % EVERY == 0:
            x, y, theta = self.pose
            stamp = self.stamp_offset + self.stamp_rate * now
            truth = Odometry(
                stamp, math.nan, x, y, math.remainder(theta, math.tau), linear, angular
            )
            self._sending += self.change(now, truth)
        due = self.stamp_offset + self.stamp_rate * (now - self.delay) + 1e-9
        while self._sending and not self._sending[0].stamp > due:
            self._arrived.append(self._sending.pop(0)._replace(received=now))


def wide_limits() -> Limits:
    return limits_of((-0.22, -2.84), (0.22, 2.84), 0.0, 0.22, 2.84, 1e9, 1e9)


def rules(
    limits: Limits | None = None,
    watchdog: float = 0.5,
    arena: float = math.inf,
    room: Room | None = None,
    injected: float = 0.0,
    from_start: bool = True,
    dry_run: bool = False,
) -> RobotRules:
    guard = Guard(watchdog, 0.22, 2.84, arena, room or Room())
    return RobotRules(
        limits or wide_limits(),
        guard,
        injected=injected,
        from_start=from_start,
        dry_run=dry_run,
    )
