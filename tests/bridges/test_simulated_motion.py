"""How the simulated TurtleBot3 moves, against circles, fine sums and worked numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from bridges.messages import STOP, Command
from bridges.settings import SettingError
from bridges.simulation.model import TurtleBot3
from bridges.simulation.settings import SimulatedRobotSettings

PLAIN: dict[str, Any] = {
    "linear_acceleration": None,
    "angular_acceleration": None,
    "quantization": None,
    "command_timeout": None,
}


def robot(**settings: Any) -> TurtleBot3:
    return TurtleBot3(SimulatedRobotSettings(**settings))


def exactly(value: Any) -> Any:
    """Equal but for rounding."""
    return pytest.approx(value, rel=0, abs=1e-12)


def pose(body: TurtleBot3) -> list[float]:
    return [body.x, body.y, body.theta]


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.5), (0.05, -2.5), (-0.1, 0.7), (0.22, 1e-7)])
def test_constant_velocities_make_a_circle(v: float, w: float) -> None:
    body = robot(**PLAIN)
    body.command(Command(v, w))
    body.advance(3.0)

    circle = [v / w * math.sin(3 * w), v / w * 2 * math.sin(1.5 * w) ** 2, 3 * w]
    assert pose(body) == pytest.approx(circle, rel=1e-9, abs=1e-12)


def test_a_whole_circle_leads_back_from_any_start() -> None:
    body = robot(**PLAIN, start=[1.0, -2.0, 0.3])
    body.command(Command(0.2, 0.5))
    body.advance(4 * math.pi)

    assert pose(body) == exactly([1.0, -2.0, 0.3 + 2 * math.pi])


def test_straight_ahead_and_turning_on_the_spot() -> None:
    body = robot(**PLAIN, start=[0.0, 0.0, math.pi / 2])
    body.command(Command(0.2, 0.0))
    body.advance(5.0)
    assert pose(body) == exactly([0.0, 1.0, math.pi / 2])
    body.command(Command(0.0, 2.0))
    body.advance(10.0)
    assert pose(body) == exactly([0.0, 1.0, math.pi / 2 + 20])  # not wrapped


def fine_sum(commands: list[Command], seconds: float, rates: tuple[float, float]) -> np.ndarray:
    """The pose by Euler's rule of steps of 10 microseconds, velocities ramping by the same rule.

    Commands last `seconds` each; rates are the accelerations. Ramps overshoot by a step at most.
    """
    dt = 1e-5
    count = round(seconds / dt)
    v, w = np.zeros(1), np.zeros(1)
    for command in commands:
        for values, goal, rate in ((0, command.linear, rates[0]), (1, command.angular, rates[1])):
            last = (v, w)[values][-1]
            way = np.minimum(np.arange(1, count + 1) * dt * rate, abs(goal - last))
            new = last + np.sign(goal - last) * way
            if values == 0:
                v = np.concatenate([v, new])
            else:
                w = np.concatenate([w, new])
    return np.stack([v, w])


@pytest.mark.parametrize("drift", [0.0, -1.3])
def test_ramps_equal_a_fine_sum(drift: float) -> None:
    commands = [Command(0.2, 1.0), Command(0.05, -1.5), Command(0.22, 0.5), Command(-0.1, 2.0)]
    body = robot(**{**PLAIN, "linear_acceleration": 0.3, "angular_acceleration": 3.2}, drift=drift)
    for command in commands:
        body.command(command)
        body.advance(0.5)

    v, w = fine_sum(commands, 0.5, (0.3, 3.2))
    middle = (w[:-1] + w[1:]) / 2 + drift
    theta = np.concatenate([[0.0], np.cumsum(middle) * 1e-5])
    heading, speed = (theta[:-1] + theta[1:]) / 2, (v[:-1] + v[1:]) / 2
    x, y = (np.sum(speed * f(heading)) * 1e-5 for f in (np.cos, np.sin))
    assert pose(body) == pytest.approx([x, y, theta[-1]], rel=0, abs=1e-7)


def test_how_time_is_cut_does_not_matter() -> None:
    generator = np.random.default_rng(3)
    whole, cut = robot(drift=0.4), robot(drift=0.4)
    for _ in range(30):
        command = Command(*generator.uniform([-0.3, -3.0], [0.3, 3.0]))
        seconds = float(generator.uniform(0.1, 0.9))  # sometimes the command times out
        parts = generator.dirichlet(np.ones(17)) * seconds
        for body, pieces in ((whole, [seconds]), (cut, parts.tolist())):
            body.command(command)
            for piece in pieces:
                body.advance(piece)
        assert pose(cut) == pytest.approx(pose(whole), rel=0, abs=1e-11)
        assert cut.timed_out == whole.timed_out == (seconds > 0.5)


def test_velocities_ramp_by_the_accelerations() -> None:
    body = robot()  # 2.5 m/s^2, 31.25 rad/s^2
    body.command(Command(0.22, -2.5))
    body.advance(0.04)
    assert (body.linear, body.angular) == exactly((0.1, -1.25))
    body.advance(0.06)
    assert (body.linear, body.angular) == (0.22, -2.5)
    body.command(STOP)
    body.advance(0.044)
    assert (body.linear, body.angular) == exactly((0.11, -1.125))
    body.advance(0.1)
    assert (body.linear, body.angular) == (0.0, 0.0)
    assert not body.moving


def test_the_way_to_full_speed_and_to_a_halt() -> None:
    body = robot()
    body.command(Command(0.22, 0.0))
    body.advance(0.4)
    body.command(STOP)
    body.advance(0.4)

    # 0.088 s up, 0.312 s at 0.22 m/s, 0.088 s down
    assert body.x == exactly(0.22 * (0.088 / 2 + 0.312 + 0.088 / 2))


@pytest.mark.parametrize(
    ("told", "done"),
    [
        (Command(0.219, 1.009), Command(0.21, 1.0)),
        (Command(-0.219, -1.009), Command(-0.21, -1.0)),
        (Command(0.0099, -0.0099), Command(0.0, 0.0)),
        (Command(0.15, -1.3), Command(0.15, -1.3)),
        # as on the robot: 100 times 0.29 is 28.999999999999996 in double precision
        (Command(0.0, 0.29), Command(0.0, 0.28)),
        (Command(0.5, -5.0), Command(0.22, -2.84)),
        (Command(-0.5, 5.0), Command(-0.22, 2.84)),
    ],
)
def test_commands_are_cut_toward_zero_and_to_the_limits(told: Command, done: Command) -> None:
    body = robot()
    body.command(told)

    assert body.target == exactly(done)


def test_an_uncut_command_is_bounded_too() -> None:
    body = robot(quantization=None, max_linear=0.1)
    body.command(Command(0.123456, 0.123456))

    assert body.target == (0.1, 0.123456)


@pytest.mark.parametrize("cuts", [1, 7, 1000])
def test_a_command_times_out_to_the_moment(cuts: int) -> None:
    body = robot(linear_acceleration=None)
    body.command(Command(0.2, 0.0))
    for _ in range(cuts):
        body.advance(2.0 / cuts)

    assert body.x == pytest.approx(0.2 * 0.5, rel=0, abs=1e-9)
    assert body.timed_out
    assert body.target == STOP
    body.command(Command(0.2, 0.0))
    assert not body.timed_out


def test_repeated_commands_do_not_time_out() -> None:
    body = robot(linear_acceleration=None)
    for _ in range(10):
        body.command(Command(0.2, 0.0))
        body.advance(0.45)

    assert body.x == exactly(0.9)
    assert not body.timed_out


def test_standing_is_no_timeout() -> None:
    body = robot()
    body.command(STOP)
    body.advance(2.0)

    assert not body.timed_out


def test_without_a_timeout_it_drives_on() -> None:
    body = robot(command_timeout=None, linear_acceleration=None)
    body.command(Command(0.2, 0.0))
    body.advance(60.0)

    assert body.x == exactly(12.0)


def test_what_is_no_number_is_not_obeyed_and_keeps_nothing_alive() -> None:
    body = robot(linear_acceleration=None)
    assert body.command(Command(0.2, 0.0))
    body.advance(0.3)
    for bad in (Command(math.nan, 0.0), Command(0.2, math.inf)):
        assert not body.command(bad)
    body.advance(0.3)

    assert body.x == exactly(0.1)
    assert body.timed_out


def test_drift_turns_a_robot_that_drives_and_no_other() -> None:
    body = robot(**PLAIN, drift=-1.3)
    body.advance(5.0)
    assert pose(body) == [0.0, 0.0, 0.0]
    body.command(Command(0.15, 1.3))  # holds against it
    body.advance(2.0)
    assert pose(body) == exactly([0.3, 0.0, 0.0])
    assert (body.angular, body.turning) == (1.3, 0.0)
    body.command(Command(0.15, 0.0))
    body.advance(1.0)
    assert body.theta == exactly(-1.3)
    body.command(STOP)
    body.advance(9.0)
    assert body.theta == exactly(-1.3)
    assert body.turning == 0.0


def test_the_papers_drift_is_half_of_it_in_a_step_of_half_a_second() -> None:
    body = robot(**PLAIN, drift=-1.3)
    body.command(Command(0.0, 0.5))
    body.advance(0.5)

    assert body.theta == exactly(-0.65 + 0.5 * 0.5)


def test_being_put_back_forgets_everything() -> None:
    body = robot(start=[0.5, -0.5, 1.0])
    body.command(Command(0.2, 1.0))
    body.advance(0.7)
    assert body.timed_out
    body.command(Command(0.2, 1.0))
    body.reset()

    assert pose(body) == [0.5, -0.5, 1.0]
    assert (body.linear, body.angular, body.target, body.timed_out) == (0.0, 0.0, STOP, False)
    body.advance(3.0)
    assert pose(body) == [0.5, -0.5, 1.0]


def test_a_start_is_three_numbers() -> None:
    with pytest.raises(SettingError, match=r"start=\[1,2\] is not allowed.*\[x, y, theta\]"):
        robot(start=[1.0, 2.0])
