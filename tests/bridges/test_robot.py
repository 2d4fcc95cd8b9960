"""The robot's pose, its commands, and what stops it, in a clock that the test owns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bridges.clock import RealClock
from bridges.commander import STOPS
from bridges.messages import STOP, BridgeError, Command, Odometry
from bridges.robot import TurtleBot3
from bridges.safety import RobotFault, limits_of
from bridges.tracking import Guard, Room, Tracker
from bridges.transports.base import TransportError
from bridges.transports.memory import pair
from tests.bridges.fake_robot import FakeRobot, rules


def connected(fake: FakeRobot, **changes: Any) -> TurtleBot3:
    robot = TurtleBot3(fake, fake.clock, rules(**changes))
    robot.connect()
    robot.begin()
    return robot


def drive(robot: TurtleBot3, fake: FakeRobot, action: tuple[float, float], seconds: float) -> Any:
    robot.send_action(action)
    return robot.hold(fake.clock.now() + seconds)


def appears(fake: FakeRobot, after: float) -> None:
    """Somebody else begins to command the robot."""

    def change(now: float, odometry: Odometry) -> Sequence[Odometry]:
        fake.drivers = ["node /teleop"] if now > after else []
        return [odometry]

    fake.change = change


def stops_at_the_end(fake: FakeRobot) -> int:
    commands = [command for _, command in fake.received]
    return next((i for i, c in enumerate(reversed(commands)) if c != STOP), len(commands))


def test_poses_are_seen_from_where_the_episode_began() -> None:
    fake = FakeRobot(start=(3.0, -1.0, math.pi / 2))
    robot = connected(fake)
    assert np.allclose(robot.get_observation().pose, 0)

    assert drive(robot, fake, (0.2, 0.0), 2.0) is None
    robot.stop()
    drive(robot, fake, (0.0, 0.0), 0.1)

    # 0.4 m ahead: along the world's y, the episode's x
    assert fake.pose == pytest.approx((3.0, -0.6, math.pi / 2))
    assert robot.get_observation().pose == pytest.approx([0.4, 0.0, 0.0], abs=1e-6)


def test_poses_can_be_those_of_odometry() -> None:
    fake = FakeRobot(start=(0.5, -1.0, 0.3))

    pose = connected(fake, from_start=False).get_observation().pose

    assert pose == pytest.approx([0.5, -1.0, 0.3])


def test_the_heading_goes_on_after_a_whole_turn() -> None:
    fake = FakeRobot(start=(0.0, 0.0, 3.0))
    robot = connected(fake)

    drive(robot, fake, (0.0, -2.0), 6.0)
    drive(robot, fake, (0.0, 0.0), 0.1)

    assert robot.get_observation().pose[2] == pytest.approx(-12.0, abs=1e-5)


def test_what_was_sent_is_returned_and_repeated() -> None:
    fake = FakeRobot()
    limits = limits_of((0.0, -1.5), (0.15, 1.5), -1.3, 0.22, 2.84, 1.0, 10.0)
    robot = connected(fake, limits=limits, injected=-1.3)

    # after a tick of 0.05 s: 0.05 m/s and 0.5 rad/s from rest
    assert robot.send_action((9.0, 0.5)) == pytest.approx((0.05, -0.5))
    robot.hold(fake.clock.now() + 0.5)

    sent = [command for _, command in fake.received]
    assert [c.linear for c in sent[:3]] == pytest.approx([0.05, 0.1, 0.15])
    assert [c.angular for c in sent[:3]] == pytest.approx([-0.5, -0.8, -0.8])
    assert all(command == pytest.approx((0.15, -0.8)) for command in sent[2:])
    assert len(sent) == 10  # every 0.05 s, until the next action
    assert robot.commands == fake.received


def test_the_age_counts_from_the_arrival_or_the_delayed_stamp() -> None:
    tracker = Tracker(Guard(0.5, 0.22, 2.84, math.inf))
    tracker.take([Odometry(100.0, 5.0, 0, 0, 0, 0, 0), Odometry(100.1, 5.1, 0, 0, 0, 0, 0)])
    assert tracker.age(5.15) == pytest.approx(0.05)

    # held up on its way: stamped 0.1 s after the one before, and arrived 0.7 s after it
    tracker.take([Odometry(100.2, 5.8, 0, 0, 0, 0, 0)])
    assert tracker.age(5.8) == pytest.approx(0.6, abs=1e-3)  # clocks may part a little
    fault = tracker.check(5.8)
    assert fault is not None
    assert fault.reason == "stale"


def test_what_is_held_up_from_an_episodes_beginning_is_old_by_what_was_seen_before() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    fake.delay = 0.7  # from now on: each is as old when it arrives, and they come as often

    with pytest.raises(RobotFault, match="stale"):
        robot.begin()

    fake.delay = 0.0
    robot.begin()
    assert robot.get_observation().age < 0.05
    robot.disconnect()
    fake.delay = 0.7
    robot.connect()  # another connection: for all that is known the robot's clock is late
    robot.begin()


def messages(rate: float, seconds: float, delay: Callable[[float], float]) -> list[Odometry]:
    """At 10 Hz, by a robot's clock of another rate; `delay` is on the way, s."""
    moments = [0.1 * k for k in range(round(10 * seconds))]
    return [Odometry(rate * m, m + delay(m), 0, 0, 0, 0, 0) for m in moments]


def test_clocks_that_part_make_nothing_old() -> None:
    """A simulation that cannot keep up, for ten minutes, with jitter on the way."""
    tracker = Tracker(Guard(0.5, 0.22, 2.84, math.inf))
    for message in messages(0.97, 600, lambda m: 0.05 * math.sin(m) ** 2):
        tracker.take([message])
        assert tracker.check(message.received) is None


def test_a_queue_that_grows_makes_odometry_old() -> None:
    tracker = Tracker(Guard(0.5, 0.22, 2.84, math.inf))
    tracker.take(messages(1.0, 3.0, lambda m: 0.0))
    late = messages(1.0, 6.0, lambda m: 0.3 * max(0.0, m - 3.0))[30:]
    faults = []
    for message in late:
        tracker.take([message])
        faults.append(tracker.check(message.received))
    assert faults[15] is None  # 0.45 s late
    assert faults[-1] is not None
    assert faults[-1].reason == "stale"
    assert "odometry comes" in faults[-1].detail


def test_a_clock_that_is_set_back_ends_one_episode_only() -> None:
    tracker = Tracker(Guard(0.5, 0.22, 2.84, math.inf))
    before = messages(1.0, 3.0, lambda m: 0.0)
    after = [m._replace(stamp=m.stamp - 1.0) for m in messages(1.0, 6.0, lambda m: 0.0)[30:]]
    tracker.take([*before, after[0]])
    fault = tracker.check(3.0)
    assert fault is not None
    assert fault.reason == "out of order"
    tracker.forget()
    tracker.take(after[1:])
    assert tracker.check(after[-1].received) is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda o: [], "stale"),
        (lambda o: [o._replace(stamp=1003.0)], "stale"),  # the same again and again
        (lambda o: [o._replace(x=math.nan)], "not finite"),
        (lambda o: [o._replace(x=o.x + 1)], "jump"),
        (lambda o: [o, o._replace(stamp=o.stamp - 0.02)], "out of order"),
    ],
)
def test_odometry_that_cannot_be_trusted_stops_the_robot(change: Any, reason: str) -> None:
    fake = FakeRobot()
    robot = connected(fake)
    fake.change = lambda now, odometry: change(odometry) if now > 3.0 else [odometry]

    fault = drive(robot, fake, (0.1, 0.0), 10.0)

    assert fault is not None
    assert fault.reason == reason
    assert stops_at_the_end(fake) == STOPS
    last_driving = max(when for when, command in fake.received if command != STOP)
    assert 2.9 < last_driving < 3.6
    with pytest.raises(RobotFault, match=reason):
        robot.send_action((0.1, 0.0))
    assert stops_at_the_end(fake) == 2 * STOPS


def test_after_a_fault_another_episode_may_begin() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    fake.change = lambda now, o: [o._replace(x=o.x + (1 if now > 2.0 else 0))]
    assert drive(robot, fake, (0.1, 0.0), 2.0) is not None

    robot.begin()

    assert drive(robot, fake, (0.1, 0.0), 1.0) is None


@pytest.mark.parametrize(
    ("fence", "reason"),
    [({"arena": 0.3}, "arena"), ({"arena": 2.5, "room": Room(-0.1, 0.3, -1.0, 1.0)}, "room")],
)
def test_the_geofence_stops_the_robot(fence: dict[str, Any], reason: str) -> None:
    fake = FakeRobot()
    robot = connected(fake, **fence)

    fault = drive(robot, fake, (0.2, 0.0), 10.0)

    assert fault is not None
    assert fault.reason == reason
    assert 0.3 < fake.pose[0] < 0.3 + 0.2 * 0.15
    assert stops_at_the_end(fake) == STOPS


def test_an_interruption_stops_the_robot() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    robot.send_action((0.1, 0.0))

    fault = robot.hold(99.0, lambda: "SIGTERM" if fake.clock.now() > 2 else None)

    assert fault == ("interrupted", "SIGTERM")
    assert stops_at_the_end(fake) == STOPS


def test_a_dry_run_publishes_nothing() -> None:
    fake = FakeRobot()
    with TurtleBot3(fake, fake.clock, rules(dry_run=True)) as robot:
        robot.begin()
        assert robot.send_action((0.1, 0.5)) == Command(0.1, 0.5)
        robot.hold(fake.clock.now() + 1.0)
        robot.stop()

    assert not fake.received
    assert fake.resets == 0


def test_leaving_stops_and_disconnects_once() -> None:
    fake = FakeRobot()
    with TurtleBot3(fake, fake.clock, rules()) as robot:
        robot.begin()
        robot.send_action((0.1, 0.0))
        robot.disconnect()

    assert stops_at_the_end(fake) >= STOPS
    assert fake.closed == 1


def test_leaving_waits_until_the_robot_is_seen_to_stand() -> None:
    fake = FakeRobot()
    with TurtleBot3(fake, fake.clock, rules()) as robot:
        robot.begin()
        robot.send_action((0.1, 0.0))
        robot.hold(fake.clock.now() + 1)
        lost = fake.clock.now() + 0.4
        send = fake.send
        fake.send = lambda command: send(command) if fake.clock.now() > lost else None  # type: ignore[method-assign]

    assert fake.received[-1][0] == pytest.approx(lost, abs=0.1)
    assert fake.received[-1][1] == STOP
    assert fake.clock.now() < lost + 0.2


@pytest.mark.parametrize("error", [TransportError, RuntimeError])
def test_commands_that_cannot_be_sent_keep_nobody_from_trying_again(error: type) -> None:
    fake = FakeRobot()
    robot = connected(fake)
    tries: list[Command] = []

    def fails(command: Command) -> None:
        tries.append(command)
        raise error("no network")

    fake.send = fails  # type: ignore[method-assign]
    with pytest.raises(error, match="no network"):
        robot.stop()
    assert tries == [STOP] * STOPS


def test_leaving_goes_on_trying_where_commands_cannot_be_sent_for_a_while() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    robot.send_action((0.1, 0.0))
    send, back = fake.send, fake.clock.now() + 0.4

    def fails(command: Command) -> None:
        if fake.clock.now() < back:
            raise TransportError("no network")
        send(command)

    fake.send = fails  # type: ignore[method-assign]
    with pytest.raises(TransportError, match="no network"):
        robot.disconnect()

    assert fake.received[-1][1] == STOP
    assert fake.received[-1][0] == pytest.approx(back, abs=0.1)
    assert fake.closed == 1


def test_an_exception_stops_the_robot() -> None:
    fake = FakeRobot()

    def goes_wrong() -> None:
        with TurtleBot3(fake, fake.clock, rules()) as robot:
            robot.begin()
            robot.send_action((0.1, 0.0))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        goes_wrong()

    assert stops_at_the_end(fake) >= STOPS


@pytest.mark.parametrize("rate", [0.1, 10.0])
def test_a_robot_whose_clock_runs_at_another_speed_is_refused(rate: float) -> None:
    fake = FakeRobot()
    fake.stamp_rate = rate
    with pytest.raises(BridgeError, match=f"runs {rate:.2f} times as fast"):
        TurtleBot3(fake, fake.clock, rules()).connect()

    assert fake.closed == 1


def test_a_robot_that_tells_nothing_is_refused() -> None:
    fake = FakeRobot()
    fake.change = lambda now, odometry: []
    with pytest.raises(BridgeError, match="no odometry came within 10 s"):
        TurtleBot3(fake, fake.clock, rules()).connect()

    assert not fake.received


def test_silence_is_told_in_real_seconds() -> None:
    clock = RealClock(speed=8.0)
    link, end = pair(clock)
    end.open()
    with pytest.raises(BridgeError, match=r"no odometry came within 0\.1 s"):
        TurtleBot3(link, clock, replace(rules(), patience=0.8)).connect()
    end.close()


def test_another_driver_stops_the_robot_and_lets_no_episode_begin() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    appears(fake, after=3.0)

    fault = drive(robot, fake, (0.1, 0.0), 10.0)

    assert fault is not None
    assert fault.reason == "other driver"
    assert "node /teleop" in fault.detail
    assert stops_at_the_end(fake) == STOPS
    assert max(when for when, command in fake.received if command != STOP) < 3.15
    with pytest.raises(RobotFault, match="other driver"):
        robot.send_action((0.1, 0.0))
    with pytest.raises(RobotFault, match="other driver"):
        robot.begin()


def test_another_driver_lets_no_robot_connect_but_one_that_is_only_listened_to() -> None:
    fake = FakeRobot()
    appears(fake, after=0.0)
    with pytest.raises(BridgeError, match="others command the robot, too: node /teleop"):
        TurtleBot3(fake, fake.clock, rules()).connect()
    assert fake.closed == 1

    robot = connected(fake, dry_run=True)
    assert drive(robot, fake, (0.1, 0.0), 1.0) is None


def test_a_link_that_receives_no_more_stops_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeRobot()
    take = fake.take

    def fail() -> Sequence[Odometry]:
        if fake.clock.now() > 3.0:
            raise TransportError("nothing is received any more")
        return take()

    monkeypatch.setattr(fake, "take", fail)
    robot = connected(fake)
    with pytest.raises(TransportError, match="received any more"):
        drive(robot, fake, (0.1, 0.0), 10.0)
    with pytest.raises(TransportError, match="received any more"):
        robot.disconnect()

    assert stops_at_the_end(fake) >= STOPS
    assert fake.clock.now() < 3.2
    assert fake.closed == 1


def test_a_reset_brings_a_simulated_robot_back() -> None:
    fake = FakeRobot(start=(1.0, 2.0, 0.5))
    robot = connected(fake)
    robot.reset()
    robot.begin()
    drive(robot, fake, (0.2, 0.3), 5.0)
    robot.stop()

    robot.reset()
    robot.begin()

    assert fake.pose == (1.0, 2.0, 0.5)
    assert np.allclose(robot.get_observation().pose, 0)


def test_a_robot_that_takes_no_reset_is_told() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    robot.reset()
    drive(robot, fake, (0.2, 0.0), 3.0)
    robot.stop()
    fake.start = fake.pose

    with pytest.raises(BridgeError, match="did not go back to its start"):
        robot.reset()


def test_a_robot_that_is_gone_is_told_when_it_is_to_be_reset() -> None:
    fake = FakeRobot()
    robot = connected(fake)
    robot.reset()
    drive(robot, fake, (0.2, 0.0), 3.0)
    robot.stop()
    killed = fake.clock.now()
    fake.change, fake.request_reset = lambda now, odometry: [], lambda: None  # type: ignore[method-assign]

    with pytest.raises(BridgeError, match=r"no odometry has come for [56] s.*has ended") as error:
        robot.reset()

    assert 5 < fake.clock.now() - killed < 7  # of 10 s that others have
    assert "reset=service" not in str(error.value)
