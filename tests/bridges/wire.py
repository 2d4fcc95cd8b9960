"""The bridge and a simulated robot as processes, over DDS on this machine.

The robot's own state is in the lines that the simulator prints, whatever its odometry tells.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from bridges import bundle
from bridges.bundle import Bundle
from bridges.episodes import Episode
from bridges.recording import read
from tests.bridges import robot_bundles
from tests.bridges.conftest import ROOT

WATCHDOG = 1.5  # s of the simulation, which is SPEED times ours: a busy machine may take a while
SPEED = 4.0
LIMIT = 40.0  # s of ours that nothing here may take
STATUS = re.compile(
    r"^\s*(?P<moment>[\d.]+) s  x (?P<x>\S+) y (?P<y>\S+) theta \S+  told (?P<linear>\S+) m/s "
    r"(?P<angular>\S+) rad/s, .* times a second  (?P<words>.*)$"
)
AHEAD = robot_bundles.constant((1.0, 0.0), log_std=-4.0)  # 0.22 m/s to a goal 2 m ahead


class Seen(NamedTuple):
    """The simulated robot as it really was."""

    x: float  # m
    linear: float  # m/s that it goes to
    words: str  # what it is doing


def seen_in(lines: list[str]) -> list[Seen]:
    """What a simulator has told in these lines."""
    found = [match for line in lines if (match := STATUS.match(line))]
    return [Seen(float(m["x"]), float(m["linear"]), m["words"]) for m in found]


class Process:
    """A command of the bridge, whose lines are read as they come."""

    def __init__(self, *arguments: str, before: tuple[str, ...] = ()) -> None:
        self.lines: list[str] = []
        self.process = subprocess.Popen(
            [*before, sys.executable, "-u", "-m", *arguments],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        """Its exit code."""
        code = self.process.wait(LIMIT)
        self._thread.join(5)
        return code

    def close(self) -> None:
        self.process.kill()
        self.process.wait(LIMIT)
        self._thread.join(5)
        if self.process.stdout is not None:
            self.process.stdout.close()

    def seen(self) -> list[Seen]:
        """What a simulator has told so far."""
        return seen_in(list(self.lines))


class World:
    """A simulated robot of its own name, and a bridge that is told to drive it."""

    def __init__(self, domain: int, folder: Path) -> None:
        name = f"r{abs(hash(str(folder))) % 10**9}"
        self.folder = folder
        self.shared = [f"link.domain_id={domain}", f"link.namespace={name}", f"speed={SPEED}"]
        self.open: list[Process] = []

    def simulator(self, *arguments: str) -> Process:
        """Tells where it is 20 times a second of ours."""
        own = ("bridges.sim_turtlebot", "robot=dds", "view=null", "status_every=0.05")
        return self._started(*own, *self.shared, *arguments)

    def bridge(self, *arguments: str, policy: Bundle = AHEAD, yes: bool = True) -> Process:
        bundle.write(self.folder / "policy.safetensors", policy)
        own = (f"bundle={self.folder}/policy.safetensors", f"out={self.folder}/out")
        mode = ("robot=dds", "mode=collect", "episodes=1", f"watchdog={WATCHDOG}")
        given = (*own, *mode, *self.shared, *arguments, *(["--yes"] if yes else []))
        return self._started("bridges.run", *given)

    def episodes(self) -> list[Episode]:
        return list(read(self.folder / "out" / "recording_0").episodes)

    def _started(self, *arguments: str) -> Process:
        process = Process(*arguments)
        self.open.append(process)
        return process


def until(holds: Callable[[], Any], what: str) -> None:
    late = time.monotonic() + LIMIT
    while not holds():
        assert time.monotonic() < late, f"it never came that {what}"
        time.sleep(0.02)


def drives(simulator: Process) -> bool:
    return any(seen.linear > 0.1 and seen.x > 0.2 for seen in simulator.seen())


def stands(simulator: Process) -> None:
    """The robot does not move any more, and was told so: its own timeout did not have to help."""
    until(lambda: simulator.seen()[-1].linear == 0, "the robot stood still")
    number = len(simulator.seen())
    until(lambda: len(simulator.seen()) > number + 3, "time passed")
    last = simulator.seen()[number:]
    assert {seen.linear for seen in last} == {0.0}
    assert len({seen.x for seen in last}) == 1
    assert not any("timeout" in seen.words for seen in last), last


def ended(bridge: Process, code: int) -> None:
    assert bridge.wait() == code, "\n".join(bridge.lines)


def assert_never_unsafe(simulator: list[Seen], episodes: list[Episode]) -> None:
    """Whatever happened, the robot stands where it may, and what happened is recorded."""
    assert simulator[-1].linear == 0
    assert len({seen.x for seen in simulator[-3:]}) == 1
    assert not any("timeout" in seen.words for seen in simulator)
    # 2.5 m is the arena; 2 s more than the watchdog allows are far above any latency here
    assert max(seen.x for seen in simulator) < 2.5 + 0.22 * (WATCHDOG + 2.0)
    assert episodes
    for episode in episodes:
        assert episode.ending in ("success", "arena", "horizon", "stale")
        assert [command for _, command in episode.commands[-5:]] == [(0.0, 0.0)] * 5
