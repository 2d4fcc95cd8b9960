"""What tests of the bridge share: DDS that stays on this machine, in domains of the tests' own."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest

from bridges import bundle, modes, run
from bridges.messages import STOP
from bridges.world import World
from tests.bridges import robot_bundles
from tests.bridges.fake_robot import FakeRobot

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 20.0  # s that no process may take to begin or to end
LOOPBACK = (
    "<CycloneDDS><Domain>"
    '<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer Address="127.0.0.1"/></Peers>'
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex></Discovery>"
    "</Domain></CycloneDDS>"
)
# the goal is 2 m ahead; slow noise leaves it there
AHEAD = robot_bundles.constant((0.9, 0.0), log_std=-4.0)

Run = Callable[..., int]


@pytest.fixture(scope="session", autouse=True)
def loopback() -> Iterator[None]:
    """DDS keeps to this machine, in this process and in those that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", LOOPBACK)
        patch.delenv("ROS_DOMAIN_ID", raising=False)
        patch.setenv("ROS_PYTHON_CHECK_FIELDS", "1")
        if os.environ.get("ROS_DISTRO") == "humble":
            patch.setenv("ROS_LOCALHOST_ONLY", "1")
        else:
            patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture(scope="session")
def domain() -> int:
    """A DDS domain of this test process; others beside it, or of another run, hardly have it."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid()))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return 2 + (crc32(run.encode()) // 8 * 8 + worker) % 96


@contextmanager
def limited(process: subprocess.Popen[str]) -> Iterator[None]:
    """Kills a process that is read from for longer than LIMIT; the read then finds its end."""
    killer = threading.Timer(LIMIT, process.kill)
    killer.start()
    try:
        yield
    finally:
        killer.cancel()


@contextmanager
def program(*arguments: str, **variables: str) -> Iterator[subprocess.Popen[str]]:
    """Runs Python in a process of its own from when it says "ready", and kills it at the end."""
    process = subprocess.Popen(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), **variables},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        with limited(process):
            assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.wait(LIMIT)
        process.stdin.close()
        process.stdout.close()


@contextmanager
def echo_robots(transport: str, domain: int, *robots: str) -> Iterator[subprocess.Popen[str]]:
    """Runs benchmarks.echo_robot, `namespace:command_type` each, and ends it in good order."""
    with program("-m", "benchmarks.echo_robot", transport, str(domain), *robots) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()
        process.wait(LIMIT)


@pytest.fixture
def main(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """`bridges.run` in this process; its exit code."""
    bundle.write(tmp_path / "policy.safetensors", AHEAD)

    def call(*arguments: str, robot: str = "memory", **settings: Any) -> int:
        given = {"bundle": tmp_path / "policy.safetensors", "out": tmp_path / "out", **settings}
        texts = [f"{name}={value}" for name, value in given.items()]
        monkeypatch.setattr(sys, "argv", ["run", f"robot={robot}", *texts, *arguments])
        return run.main()

    return call


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRobot:
    """A robot in place of one on a network."""
    robot = FakeRobot()
    monkeypatch.setattr(modes, "world", lambda config: World(robot, robot.clock))
    return robot


@pytest.fixture
def questions(monkeypatch: pytest.MonkeyPatch, fake: FakeRobot) -> list[int]:
    """A person says yes; how many commands had moved the robot by then, each time."""
    asked: list[int] = []
    monkeypatch.setattr("builtins.input", lambda: asked.append(moves(fake)))
    return asked


def moves(fake: FakeRobot) -> int:
    return sum(command != STOP for _, command in fake.received)
