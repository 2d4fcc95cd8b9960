"""A simulated robot in real time in this process, which drives on as a real TurtleBot3 does."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from bridges.clock import RealClock
from bridges.simulation.robot import SimulatedRobot
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.transports.memory import MemoryLink, pair


class Beside(NamedTuple):
    """A robot that lives on a thread of its own."""

    link: MemoryLink
    clock: RealClock
    robot: SimulatedRobot


@contextmanager
def beside() -> Iterator[Beside]:
    """No command stays away too long for it."""
    clock = RealClock()
    link, end = pair(clock)
    end.open()
    robot = SimulatedRobot(end, SimulatedRobotSettings(command_timeout=None), clock.now())
    ended = threading.Event()

    def live() -> None:
        while not ended.is_set():
            end.wait(0.005)
            robot.tick(clock.now())

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        yield Beside(link, clock, robot)
    finally:
        ended.set()
        thread.join(5)
        end.close()
