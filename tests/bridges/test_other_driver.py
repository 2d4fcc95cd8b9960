"""Somebody else who commands the robot, over real DDS between processes."""

from __future__ import annotations

import signal
import subprocess
import time
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds")

from bridges.clock import RealClock
from bridges.messages import TWIST, TWIST_STAMPED
from bridges.transports import discovery
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.dds import DdsEnd, DdsLink
from bridges.transports.dds_node import Node
from tests.bridges.conftest import LOOPBACK, program
from tests.bridges.wire import LIMIT, World, ended, stands, until

WRITER = """
import sys
from bridges.transports.base import LinkSettings
from bridges.transports.dds_node import Node
node = Node(LinkSettings(int(sys.argv[1]), sys.argv[2]), print)
writer = node.writer("cmd_vel", sys.argv[3])
node.start()
print("ready", flush=True)
sys.stdin.read()
"""


def writer(
    domain: int, namespace: str, kind: str, configuration: str = LOOPBACK
) -> AbstractContextManager[subprocess.Popen[str]]:
    """Another program that may command a robot, and sends nothing."""
    return program("-c", WRITER, str(domain), namespace, kind, CYCLONEDDS_URI=configuration)


def test_a_second_driver_is_refused_and_one_who_comes_later_ends_the_episode(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(domain, tmp_path)
    namespace = world.shared[1].removeprefix("link.namespace=")
    simulator = world.simulator("command_timeout=null")
    bridge = world.bridge("max_linear=0.05")  # it goes on until something ends it
    try:
        until(lambda: any(seen.linear > 0.02 for seen in simulator.seen()), "the robot drove")
        monkeypatch.setattr(discovery, "LEASE", 0.5)
        second = DdsLink(LinkSettings(domain, namespace, connect_timeout=LIMIT), RealClock())
        with pytest.raises(TransportError) as error:
            second.open()
        number = len(simulator.seen())
        until(lambda: len(simulator.seen()) > number + 3, "time passed")
        assert simulator.seen()[-1].linear > 0.02  # a second one that is refused disturbs nobody

        # of the type that this robot does not even take: a mistake that may be mended any moment
        with writer(domain, namespace, TWIST) as other:
            ended(bridge, 2)  # a person would be asked to put the robot back, but nobody is there
            stands(simulator)
    finally:
        for process in world.open:
            process.close()

    words = str(error.value)
    assert f"commanded by others at /{namespace}/cmd_vel in domain {domain}" in words
    assert f"(process {bridge.process.pid})" in words
    assert TWIST_STAMPED in words
    (episode,) = world.episodes()
    assert (episode.ending, episode.whole) == ("other driver", False)
    assert f"(process {other.pid})" in episode.detail
    assert [command for _, command in episode.commands[-5:]] == [(0.0, 0.0)] * 5


def test_one_who_was_killed_is_waited_for(domain: int, capsys: pytest.CaptureFixture[str]) -> None:
    settings = LinkSettings(domain, "widowed", connect_timeout=0.5)
    robot, watcher = DdsEnd(settings, RealClock()), Node(settings, print)
    watcher.watch("cmd_vel")
    watcher.start()
    robot.open()
    shown = LOOPBACK.replace("<Discovery>", "<Discovery><LeaseDuration>2s</LeaseDuration>")
    with writer(domain, "widowed", TWIST_STAMPED, shown) as other:
        until(watcher.others, "the other one was seen")
        other.send_signal(signal.SIGKILL)
        began = time.monotonic()
        link = DdsLink(settings, RealClock())
        link.open()  # in the same process: what is known of the other one is shared
        waited = time.monotonic() - began
        assert list(link.others()) == []
        until(lambda: len(watcher.others()) == 1, "our own link was all that was left")
    link.close()
    until(lambda: not watcher.others(), "the link that is closed was gone")
    watcher.close()
    robot.close()

    assert 0.5 < waited < 15
    told = capsys.readouterr().out
    assert told.count("waiting for up to 22 s") == 1
    assert f"(process {other.pid})" in told
