"""The simulated TurtleBot3 as a process of its own, reached over DDS."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from bridges.clock import RealClock
from bridges.messages import STOP, TWIST, TWIST_STAMPED, Command, Odometry
from bridges.transports.base import LinkSettings, RobotLink
from bridges.transports.choice import link as make_link
from tests.bridges.conftest import ROOT, limited

LIMIT = 15.0  # s of ours that nothing here may take


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "bridges.sim_turtlebot", *arguments]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


@contextmanager
def simulator(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Runs the command, without a page."""
    process = subprocess.Popen(
        command("robot=dds", "view=null", *arguments),
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=LIMIT)


@contextmanager
def bridge(domain: int, speed: float = 1.0) -> Iterator[RobotLink]:
    settings = LinkSettings(domain, connect_timeout=LIMIT)
    link = make_link("dds", settings, RealClock(speed))
    link.open()
    try:
        yield link
    finally:
        link.close()


def drive(
    link: RobotLink, command: Command | None, until: Callable[[Odometry], Any]
) -> list[Odometry]:
    """Sends a command with every odometry until one is as wanted; all of them."""
    taken: list[Odometry] = []
    late = time.monotonic() + LIMIT
    while True:
        link.wait(1.0)
        for odometry in link.take():
            taken.append(odometry)
            if until(odometry):
                return taken
            if command is not None:
                link.send(command)
        assert time.monotonic() < late, f"it never came; the last: {taken[-1:]}"


def test_a_drive_over_dds(domain: int) -> None:
    pytest.importorskip("cyclonedds")
    name = f"link.domain_id={domain}"
    with (
        simulator(name, "drift=0.5", "status_every=0.5", "seed=3") as process,
        bridge(domain) as link,
    ):
        assert link.command_type == TWIST_STAMPED
        first = drive(link, None, lambda o: True)[0]
        assert first.x == 0.0
        assert abs(first.stamp - time.time()) < LIMIT  # ROS's time

        # an arc of 0.2 m/s and 0.5 rad/s, until it has turned by 0.6 rad
        path = drive(link, Command(0.2, 0.0), lambda o: o.theta > 0.6)
        last = path[-1]
        assert last.linear == pytest.approx(0.2)
        assert last.angular == pytest.approx(0.5)
        # the way to full speed takes 0.08 s, which drift turns it through meanwhile
        circle = (0.4 * math.sin(last.theta), 0.4 * (1 - math.cos(last.theta)))
        assert (last.x, last.y) == pytest.approx(circle, abs=0.01)
        since = [30 * (o.stamp - path[0].stamp) for o in path]
        assert since == pytest.approx([round(each) for each in since], abs=1e-3)
        assert since == sorted(set(since))

        # nothing is sent any more: it stops by its own timeout
        rest = drive(link, None, lambda o: o.linear == 0.0)
        assert 0.3 < rest[-1].stamp - last.stamp < 3.0
        link.request_reset()
        drive(link, None, lambda o: o.x == o.y == o.theta == 0.0)
        # more than it can do, and less than it takes note of
        assert drive(link, Command(9.0, -9.0), lambda o: o.x > 0.05)[-1].linear <= 0.22
        drive(link, Command(0.009, 0.009), lambda o: (o.linear, o.angular) == (0.0, 0.0))

        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0
    lines = said.splitlines()
    assert f"over dds, domain {domain}: takes TwistStamped" in lines[0]
    assert "drift=0.5" in said
    assert any(line.endswith("driving") and "told +0.20 m/s" in line for line in lines)
    assert lines[-1].startswith("stopped after")
    assert lines[-1].endswith("put back 1 times")


def test_ten_times_as_fast(domain: int) -> None:
    pytest.importorskip("cyclonedds")
    arguments = (
        f"link.domain_id={domain}",
        "speed=10",
        "command_type=twist",
        "position_noise=0.01",
    )
    with simulator(*arguments) as process, bridge(domain, 10.0) as link:
        assert link.command_type == TWIST
        first = drive(link, None, lambda o: True)[0]
        last = drive(link, Command(0.1, 0.1), lambda o: o.stamp - first.stamp > 20.0)[-1]
        # within 0.4 s of ours, for who hears of either end late
        assert last.received - first.received == pytest.approx(20.0, abs=4.0)
        drive(link, STOP, lambda o: o.linear == 0.0)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0
    assert "stopped after" in said


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no such signal")
def test_a_terminal_that_is_gone_ends_it_properly(domain: int) -> None:
    """Or it would be seen, and taken for a robot, for some seconds more."""
    pytest.importorskip("cyclonedds")
    with simulator(f"link.domain_id={domain}", "link.namespace=hangs_up") as process:
        assert process.stdout is not None
        with limited(process):
            assert "over dds" in process.stdout.readline()
        process.send_signal(signal.SIGHUP)
        said, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0
    assert "stopped after" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("start=[1,2]",), "start=[1,2] is not allowed: it must be [x, y, theta]"),
        (("command_loss=1.5",), "command_loss=1.5 is not allowed: it must be at least 0"),
        (("link.command_type=twist",), "link.command_type is the bridge's; the robot's is"),
    ],
)
def test_what_is_wrong_is_told_at_once(arguments: tuple[str, ...], words: str) -> None:
    done = subprocess.run(
        command("view=null", *arguments),
        env=environment(),
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )

    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert words in done.stderr
    assert done.stdout == ""


def test_help_names_every_setting_and_needs_no_jax() -> None:
    code = (
        "import sys, runpy; sys.argv = ['x', '--help']\n"
        "try: runpy.run_module('bridges.sim_turtlebot', run_name='__main__')\n"
        "except SystemExit as end: assert not end.code\n"
        "sys.exit('jax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=True,
    )

    for name in ("drift=0.0", "speed=1.0", "view=8000", "fault=none", "link.domain_id=null"):
        assert f"\n  {name}\n" in done.stdout
