"""What keeps a robot safe, over real DDS: the bridge and a simulated robot as processes."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.bridges import robot_bundles
from tests.bridges.wire import (
    AHEAD,
    WATCHDOG,
    World,
    assert_never_unsafe,
    drives,
    ended,
    stands,
    until,
)

pytest.importorskip("cyclonedds")

SHORT = robot_bundles.in_arena(2.5, horizon=8)

Worlds = Callable[[], World]


@pytest.fixture
def worlds(domain: int, tmp_path: Path) -> Iterator[Worlds]:
    """Makes worlds; those of a test go on side by side, as most of their time is waiting."""
    made: list[World] = []

    def another() -> World:
        folder = tmp_path / f"world_{len(made)}"
        folder.mkdir()
        made.append(World(domain, folder))
        return made[-1]

    yield another
    for each in made:
        for process in each.open:
            process.close()


def test_odometry_that_goes_wrong_stops_the_robot(worlds: Worlds) -> None:
    reasons = {
        "silent": "stale",
        "nan": "not finite",
        "jump": "jump",
        "out_of_order": "out of order",
    }
    sides = []
    for fault in reasons:
        world = worlds()
        simulator = world.simulator(f"fault={fault}", "fault_after=2.5", "command_timeout=null")
        sides.append((world, simulator, world.bridge()))

    for reason, (world, simulator, bridge) in zip(reasons.values(), sides, strict=True):
        ended(bridge, 2)  # a person would be asked to put the robot back, but nobody is there
        stands(simulator)
        (episode,) = world.episodes()
        assert episode.ending == reason
        assert not episode.whole
        # 2.5 s at 0.22 m/s, the watchdog's time, and what a busy machine needs to notice
        assert 0.3 < simulator.seen()[-1].x < 0.22 * (2.5 + WATCHDOG + 2.0)


def test_whatever_ends_the_bridge_stops_the_robot(worlds: Worlds) -> None:
    policies = {
        signal.SIGINT: (AHEAD, 130),
        signal.SIGTERM: (AHEAD, 143),
        "exception": (robot_bundles.that_breaks(0.3), 2),
        "geofence": (robot_bundles.in_arena(0.5), 0),
    }
    sides = {}
    for what, (policy, _) in policies.items():
        world = worlds()
        slow = ("max_linear=0.15", "linear_acceleration=0.5") if what == "geofence" else ()
        bridge = world.bridge(*slow, policy=policy)
        sides[what] = world, world.simulator("command_timeout=null"), bridge
    driving = {what for what in sides if isinstance(what, int)}

    def signaled() -> bool:
        """Each as soon as it drives: one that is late must not find its episode over."""
        for number in list(driving):
            if drives(sides[number][1]):
                sides[number][2].signal(number)
                driving.remove(number)
        return not driving

    until(signaled, "the robots drove")

    for what, (_, simulator, bridge) in sides.items():
        ended(bridge, policies[what][1])
        stands(simulator)
    for what in (signal.SIGINT, signal.SIGTERM):
        assert [episode.ending for episode in sides[what][0].episodes()] == ["interrupted"]
    assert "not finite" in " ".join(sides["exception"][2].lines)
    assert 0.2 < sides["exception"][1].seen()[-1].x < 0.3 + 0.22 * 2.5
    (episode,) = sides["geofence"][0].episodes()
    assert episode.ending == "arena"
    assert 0.5 < sides["geofence"][1].seen()[-1].x < 0.5 + 0.22 * 2.0
    # the policy asks for 0.22 m/s; it gets what is allowed, and 0.5 m/s^2 in ticks of 0.05 s
    told = [command.linear for _, command in episode.commands if command.linear]
    assert max(told) == pytest.approx(0.15)
    assert max(np.diff([0.0, *told])) < 0.025 + 1e-6
    assert max(seen.linear for seen in sides["geofence"][1].seen()) <= 0.15


def test_kills(worlds: Worlds) -> None:
    first, second = worlds(), worlds()
    robot, lonely = first.simulator(), first.bridge()
    near = robot_bundles.in_arena(0.7)  # an episode that is over soon
    left, bridge = second.simulator(), second.bridge(policy=near)
    victims = {"robot": (robot, robot), "bridge": (left, bridge)}

    def killed() -> bool:
        for name, (simulator, process) in list(victims.items()):
            if drives(simulator):
                process.signal(signal.SIGKILL)
                del victims[name]
        return not victims

    until(killed, "the robots drove")

    # the robot is killed: DDS takes it for connected for seconds more, the watchdog does not
    ended(lonely, 2)
    (episode,) = first.episodes()
    assert episode.ending == "stale"
    assert [command for _, command in episode.commands[-5:]] == [(0.0, 0.0)] * 5

    # the bridge is killed: the robot's own timeout has to stop it
    until(lambda: "timeout" in left.seen()[-1].words, "the robot's timeout stopped it")
    number = len(left.seen())
    until(lambda: len(left.seen()) > number + 3, "time passed")
    assert len({seen.x for seen in left.seen()[number + 1 :]}) == 1
    # and the next bridge goes on
    again = second.bridge(policy=near)
    ended(again, 0)
    assert [episode.whole for episode in second.episodes()] == [True]


def test_nothing_moves_in_a_dry_run_or_before_a_person_has_agreed(worlds: Worlds) -> None:
    first, second = worlds(), worlds()
    free, dry = first.simulator(), first.bridge("dry_run=true", policy=SHORT)
    waiting, asked = second.simulator(), second.bridge(yes=False)

    ended(dry, 0)
    assert len(first.episodes()[0].steps) == 8
    free.signal(signal.SIGINT)
    ended(free, 0)
    assert ": 0 commands came (0 lost)" in free.lines[-1]
    ended(asked, 2)  # nobody is there to agree
    assert any("Is the floor free?" in line for line in asked.lines)
    stands(waiting)
    assert {(seen.x, seen.linear) for seen in waiting.seen()} == {(0.0, 0.0)}


def test_losses_and_latency_are_never_unsafe(worlds: Worlds) -> None:
    """30 % of all messages get lost, all are 0.2 s late, both ways: in the simulator."""
    world = worlds()
    simulator = world.simulator(
        *("command_loss=0.3", "command_latency=0.2", "odometry_loss=0.3", "odometry_latency=0.2"),
        "command_timeout=null",
    )
    bridge = world.bridge("reset=service", policy=robot_bundles.in_arena(1.0))

    assert bridge.wait() in (0, 2), "\n".join(bridge.lines)
    stands(simulator)
    assert_never_unsafe(simulator.seen(), world.episodes())
