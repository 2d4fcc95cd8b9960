"""The simulated robot at its end of a transport: rates, delays, losses, noise, faults, reset."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from bridges.clock import VirtualClock
from bridges.messages import STOP, Command, Odometry
from bridges.simulation.robot import SimulatedRobot
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.transports.memory import pair

AT_ONCE: dict[str, Any] = {"linear_acceleration": None, "angular_acceleration": None}
STEP = 0.01  # s between ticks
DRIVE = Command(0.2, 0.0)


class Recorder:
    """A robot's end that keeps what is told, and hands over what a test puts in."""

    def __init__(self) -> None:
        self.moment = 0.0
        self.told: list[Odometry] = []
        self.when: list[float] = []  # each was told
        self.covariance: Sequence[float] = ()
        self.commands: list[Command] = []
        self.resets = 0

    def open(self) -> None: ...

    def close(self) -> None: ...

    def wait(self, timeout: float) -> bool:
        return False

    def publish(self, odometry: Odometry, covariance: Sequence[float]) -> None:
        self.told.append(odometry)
        self.when.append(self.moment)
        self.covariance = covariance

    def take_commands(self) -> Sequence[Command]:
        taken, self.commands = self.commands, []
        return taken

    def take_resets(self) -> int:
        taken, self.resets = self.resets, 0
        return taken


def stand(moment: float) -> Command | None:
    """Tells a robot nothing."""
    return None


def simulated(
    seconds: float,
    tell: Callable[[float], Command | None] = stand,
    reset_at: float | None = None,
    step: float = STEP,
    **settings: Any,
) -> tuple[Recorder, SimulatedRobot]:
    """Simulates a robot that is told something before every tick."""
    end = Recorder()
    robot = SimulatedRobot(end, SimulatedRobotSettings(**settings))
    for i in range(round(seconds / step) + 1):
        end.moment = i * step
        if (command := tell(end.moment)) is not None:
            end.commands.append(command)
        if reset_at is not None and abs(end.moment - reset_at) < step / 2:
            end.resets = 1
        robot.tick(end.moment)
    return end, robot


def test_odometry_comes_at_its_rate_whatever_the_ticks_are() -> None:
    for step in (0.01, 0.025, 0.0333, 0.5):
        end, robot = simulated(10.0, step=step)
        stamps = [o.stamp for o in end.told]
        count = math.floor(round(round(10.0 / step) * step * 30, 6)) + 1  # the first one at 0
        assert robot.odometry == len(stamps) == count
        assert stamps == pytest.approx([k / 30 for k in range(count)], rel=0, abs=1e-9)
    end, _ = simulated(2.0, odometry_rate=20.0)
    assert len(end.told) == 41


def test_stamps_may_begin_at_another_time_and_go_on_as_time_does() -> None:
    end = Recorder()
    robot = SimulatedRobot(end, SimulatedRobotSettings(), 50.0, 1.7e9)
    robot.tick(51.0)

    stamps = [o.stamp - 1.7e9 for o in end.told]
    assert stamps == pytest.approx([k / 30 for k in range(31)], rel=0, abs=1e-6)
    assert end.told[-1].received == pytest.approx(51.0)


def test_odometry_is_of_its_moment() -> None:
    end, _ = simulated(12.0, lambda _: Command(0.2, 1.0), **AT_ONCE)

    for told in end.told:
        t = told.stamp
        at = [0.2 * math.sin(t), 0.2 * (1 - math.cos(t))]
        assert [told.x, told.y] == pytest.approx(at, rel=0, abs=1e-9)
        assert -math.pi < told.theta <= math.pi
        assert math.cos(told.theta - t) == pytest.approx(1.0)
        if t:  # the first one was told before the first command
            assert (told.linear, told.angular) == (0.2, 1.0)
        assert (told.frame, told.child_frame) == ("odom", "base_footprint")


def test_odometry_sees_drift() -> None:
    end, _ = simulated(1.0, lambda _: Command(0.2, 1.0), **AT_ONCE, drift=-1.3)

    assert end.told[-1].angular == pytest.approx(-0.3)
    assert end.told[-1].theta == pytest.approx(-0.3)


def test_a_command_takes_effect_after_its_latency() -> None:
    def once(moment: float) -> Command | None:
        return DRIVE if moment == 1.0 else None

    timeless: dict[str, Any] = {**AT_ONCE, "command_timeout": None}
    for latency in (0.0, 0.2, 0.2071):  # the last is no multiple of a tick
        _, robot = simulated(2.0, once, **timeless, command_latency=latency)
        assert robot.body.x == pytest.approx(0.2 * (1.0 - latency), rel=0, abs=1e-9)


def test_odometry_leaves_after_its_latency_as_it_was() -> None:
    end, _ = simulated(3.0, lambda _: DRIVE, **AT_ONCE, odometry_latency=0.2)

    late = np.array(end.when) - np.array([o.stamp for o in end.told])
    assert len(end.told) == 85  # what was seen up to 2.8 s
    assert late.min() >= 0.2 - 1e-9
    assert late.max() < 0.2 + STEP
    assert end.told[-1].x == pytest.approx(0.2 * 2.8)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_as_many_get_lost_as_should(share: float) -> None:
    end, robot = simulated(100.0, lambda _: DRIVE, command_loss=share, odometry_loss=share, seed=5)

    for lost, whole in (
        (robot.lost_commands, robot.commands),
        (robot.lost_odometry, robot.odometry + robot.lost_odometry),
    ):
        assert whole in (10_001, 3001)
        # within four standard deviations of a binomial distribution
        assert abs(lost - share * whole) <= 4 * math.sqrt(whole * share * (1 - share))
    assert len(end.told) == robot.odometry
    assert (robot.body.x == 0.0) == (share == 1.0)


def test_noise_is_of_what_is_told_and_as_large_as_set() -> None:
    def circle(_: float) -> Command:
        return Command(0.1, 0.5)

    end, robot = simulated(100.0, circle, position_noise=0.02, heading_noise=0.1, seed=1)
    quiet, exact = simulated(100.0, circle)

    assert (robot.body.x, robot.body.y, robot.body.theta) == (
        *(exact.body.x, exact.body.y, exact.body.theta),
    )
    off = np.array([[a.x - b.x, a.y - b.y] for a, b in zip(end.told, quiet.told, strict=True)])
    turned = [math.remainder(a.theta - b.theta, math.tau) for a, b in zip(end.told, quiet.told)]  # noqa: B905
    # of 3001 numbers a standard deviation is known to 1.3 %, a mean to 1.8 % of it
    assert off.std(axis=0) == pytest.approx([0.02, 0.02], rel=0.05)
    assert np.std(turned) == pytest.approx(0.1, rel=0.05)
    assert np.abs(off.mean(axis=0)).max() < 0.02 * 0.08
    assert abs(np.corrcoef(off.T)[0, 1]) < 0.08
    assert end.covariance == pytest.approx((0.0004, 0.0004, 0.01))
    assert min(quiet.covariance) > 0  # zeros would mean that nobody knows


def test_the_seed_decides_all_chance_and_each_kind_for_itself() -> None:
    chance: dict[str, Any] = {"command_loss": 0.3, "odometry_loss": 0.3, "position_noise": 0.05}

    def tell(moment: float) -> Command:
        return Command(0.2, math.sin(moment))

    first, _ = simulated(20.0, tell, **chance, seed=4)
    again, _ = simulated(20.0, tell, **chance, seed=4)
    other, _ = simulated(20.0, tell, **chance, seed=5)
    assert first.told == again.told
    assert first.told != other.told
    complete, _ = simulated(20.0, tell, **{**chance, "odometry_loss": 0.0}, seed=4)
    assert set(first.told) < set(complete.told)  # noise and lost commands stay the same


def test_being_put_back() -> None:
    def tell(moment: float) -> Command | None:
        return DRIVE if moment < 2.0 else None

    end, robot = simulated(
        4.0, tell, reset_at=1.5, command_latency=0.1, command_timeout=None, start=[1.0, 0.5, 0.2]
    )
    assert robot.resets == 1
    before, after = ([o for o in end.told if low < o.stamp < low + 0.09] for low in (1.4, 1.501))
    assert all(o.x > 1.2 for o in before)
    assert len(after) == 2
    for told in after:  # the commands that were on their way at 1.5 s are forgotten
        assert (told.x, told.y, told.theta) == pytest.approx((1.0, 0.5, 0.2))
        assert told.linear == 0.0
    assert end.told[-1].x > 1.2


def test_with_a_timeout_lost_commands_stop_it() -> None:
    def tell(moment: float) -> Command | None:
        return DRIVE if moment <= 1.0 else None

    end, robot = simulated(4.0, tell, **AT_ONCE)

    assert robot.body.x == pytest.approx(0.2 * 1.5)  # until half a second after the last
    assert end.told[-1].linear == 0.0
    assert robot.state().mood == "timeout"


@pytest.mark.parametrize("fault", ["silent", "freeze", "nan", "jump", "out_of_order"])
def test_faults_begin_when_it_has_driven_a_while(fault: str) -> None:
    def tell(moment: float) -> Command:
        return STOP if moment < 1.0 else DRIVE

    good, _ = simulated(6.0, tell, **AT_ONCE)
    end, robot = simulated(6.0, tell, **AT_ONCE, fault=fault, fault_after=2.0)

    assert robot.state().mood == "fault"
    begun = next(i for i, o in enumerate(good.told) if o.stamp >= 3.0 - 1e-9)
    assert end.told[:begun] == good.told[:begun]
    rest, true = end.told[begun:], good.told[begun:]
    if fault == "silent":
        assert rest == []
    elif fault == "freeze":
        assert rest == [good.told[begun - 1]] * len(true)
    elif fault == "nan":
        assert all(math.isnan(o.x + o.y) and math.isnan(o.theta) for o in rest)
        assert [o.stamp for o in rest] == [o.stamp for o in true]
    elif fault == "jump":
        assert [o.x for o in rest] == pytest.approx([o.x + 1.0 for o in true])
        assert [o.y for o in rest] == [o.y for o in true]
    else:
        assert rest[0::2] == true[1::2]
        assert rest[1::2] == true[0 : len(rest) : 2]


def test_being_put_back_ends_a_fault_until_it_has_driven_again() -> None:
    def tell(moment: float) -> Command:
        return STOP if 3.0 <= moment < 4.0 else DRIVE

    end, _ = simulated(7.0, tell, reset_at=3.0, fault="nan", fault_after=2.0)

    bad = [o.stamp for o in end.told if math.isnan(o.x)]
    assert bad[0] == pytest.approx(2.0, abs=0.04)
    assert max(stamp for stamp in bad if stamp < 5.0) == pytest.approx(3.0, abs=0.04)
    assert min(stamp for stamp in bad if stamp > 5.0) == pytest.approx(6.0, abs=0.04)


def test_moods_and_their_words() -> None:
    end = Recorder()
    robot = SimulatedRobot(end, SimulatedRobotSettings(), 100.0)

    def seen(moment: float, *commands: Command) -> str:
        end.commands = list(commands)
        robot.tick(moment)
        return robot.state().words

    assert seen(100.0) == "no bridge seen"
    assert seen(101.0, DRIVE) == "driving"
    assert seen(101.4, STOP) == "driving"  # still rolling
    assert seen(101.6, STOP) == "told to stand"
    assert seen(103.2) == "no bridge seen"
    assert seen(104.0, DRIVE) == "driving"
    assert seen(109.0) == "stopped by its command timeout"
    end.resets = 1
    assert seen(110.0) == "no bridge seen"
    assert robot.state().moment == pytest.approx(10.0)


def test_commands_a_second_are_counted() -> None:
    _, robot = simulated(5.0, lambda moment: DRIVE if round(moment / STEP) % 5 == 0 else None)

    assert robot.state().command_rate == pytest.approx(20.0)


def test_a_virtual_clock_lives_a_robot_in_memory() -> None:
    def tick(moment: float) -> None:
        robot.tick(moment)

    clock = VirtualClock(STEP, tick)
    link, end = pair(clock)
    end.open()
    robot = SimulatedRobot(end, SimulatedRobotSettings(**AT_ONCE), clock.now())
    link.open()

    for _ in range(20):  # two seconds of an arc
        link.send(Command(0.2, 0.5))
        clock.sleep_until(clock.now() + 0.1)
    newest = link.take()[-1]
    link.send(STOP)
    clock.sleep_until(clock.now() + 0.1)

    # a command is heard at the next tick
    t = newest.stamp - STEP
    assert newest.received == pytest.approx(newest.stamp, abs=STEP)
    assert newest.x == pytest.approx(0.4 * math.sin(0.5 * t))
    link.request_reset()
    assert link.wait(1.0)
    clock.sleep_until(clock.now() + 0.1)
    assert (link.take()[-1].x, robot.resets) == (0.0, 1)
