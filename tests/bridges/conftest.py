"""What tests of the bridge share: DDS that stays on this machine, in domains of the tests' own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from zlib import crc32

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOOPBACK = (
    "<CycloneDDS><Domain>"
    '<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer Address="127.0.0.1"/></Peers>'
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex></Discovery>"
    "</Domain></CycloneDDS>"
)


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
def echo_robots(transport: str, domain: int, *robots: str) -> Iterator[subprocess.Popen[str]]:
    """Runs benchmarks.echo_robot in a process of its own, `namespace:command_type` each."""
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.echo_robot", transport, str(domain), *robots],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
        process.stdin.close()
        process.wait(20)
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()
