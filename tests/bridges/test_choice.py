"""A transport by its name, and what is said where its package is missing."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType

import pytest

from bridges import bags
from bridges.clock import RealClock, VirtualClock
from bridges.messages import BridgeError
from bridges.transports import choice
from bridges.transports.base import LinkSettings, TransportError

# Each package is made missing before anything has imported it, so in a process of its own.
MISSING = """
import sys
sys.modules.update(cyclonedds=None, rclpy=None)
from bridges.clock import RealClock
from bridges.transports import choice
from bridges.transports.base import LinkSettings, TransportError
assert not {"jax", "numpy"} & set(sys.modules)
for make in (choice.link, choice.end):
    for name in ("rclpy", "dds", "auto"):
        try:
            make(name, LinkSettings(), RealClock())
        except TransportError as error:
            print(error)
make = choice.link("memory", LinkSettings(), RealClock())
"""


def test_a_missing_package_is_told_with_what_to_do() -> None:
    done = subprocess.run(
        [sys.executable, "-c", MISSING], check=True, capture_output=True, text=True, timeout=60
    )

    lines = done.stdout.splitlines()
    assert len(lines) == 6
    for rclpy, dds, auto in (lines[:3], lines[3:]):
        assert "source its setup" in rclpy
        assert "pip install -e '.[dds,robot]'" in dds
        assert auto == dds


def test_auto_is_rclpy_where_that_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", ModuleType("rclpy"))
    assert choice.resolved("auto") == "rclpy"
    # ROS 1's messages, as Debian has them, say nothing
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setitem(sys.modules, "nav_msgs", ModuleType("nav_msgs"))
    assert choice.resolved("auto") == "dds"
    assert choice.resolved("memory") == "memory"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(TransportError, match="no transport 'zenoh'; there are auto, rclpy, dds"):
        choice.link("zenoh", LinkSettings(), RealClock())


@pytest.mark.parametrize("name", ["dds", "rclpy"])
def test_only_memory_has_virtual_time(name: str) -> None:
    with pytest.raises(TransportError, match="needs real time"):
        choice.end(name, LinkSettings(), VirtualClock(0.1, lambda _: None))


def test_missing_rosbags_is_told_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    bags.rosbags.cache_clear()
    with pytest.raises(BridgeError, match=r"pip install -e '\.\[robot\]'.*docs/bridge/robot\.md"):
        bags.rosbags()
