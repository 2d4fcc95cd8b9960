"""Time as the robot's loop sees it: real, a multiple of real, or made by whoever waits for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Seconds since some moment, which only ever grow."""

    def now(self) -> float:
        """The time, in s."""
        ...

    def sleep_until(self, moment: float) -> None:
        """Returns at the moment, or at once if it has passed."""
        ...


class RealClock:
    """The machine's monotonic clock, times a speed: for robots 1, for simulators what they take."""

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed  # s of this clock in a real one

    def now(self) -> float:
        """The time, in s."""
        return time.monotonic() * self.speed

    def sleep_until(self, moment: float) -> None:
        """Returns at the moment, or at once if it has passed."""
        time.sleep(max(0.0, (moment - self.now()) / self.speed))


def real(clock: Clock, seconds: float) -> float:
    """So many s of a clock in real ones; those of a virtual one pass for real."""
    return seconds / clock.speed if isinstance(clock, RealClock) else seconds


class VirtualClock:
    """Passes only while somebody sleeps, as fast as what happens meanwhile can be computed.

    Args:
        step: s; while time passes, `tick` is called after each of them.
        tick: advances what lives in this time, such as a simulated robot. (moment)
    """

    def __init__(self, step: float, tick: Callable[[float], None]) -> None:
        self._step, self._tick = step, tick
        self._steps = 0

    def now(self) -> float:
        """The time, in s."""
        return self._steps * self._step

    def sleep_until(self, moment: float) -> None:
        """Lets time pass, whole steps of it, up to the moment."""
        while self.now() + 1e-9 < moment:
            self._steps += 1
            self._tick(self.now())
