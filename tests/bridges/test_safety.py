"""Limits of commands and the guard of odometry, with worked numbers."""

from __future__ import annotations

import math

import pytest

from bridges.messages import STOP, BridgeError, Command, Odometry
from bridges.safety import Fault, Limits, fault_of, limits_of, stale, wrapped

GENTLE = {"linear_acceleration": 1.0, "angular_acceleration": 4.0}


def drifting(injected: float) -> Limits:
    """The bounds of two_wheeled_drift's actions, on a TurtleBot3 Burger."""
    return limits_of((0.0, -1.5), (0.15, 1.5), injected, 0.22, 2.84, **GENTLE)


def guarded(previous: Odometry | None, odometry: Odometry) -> str | None:
    fault = fault_of(previous, odometry, watchdog=0.5, max_linear=0.22, max_angular=2.84)
    return fault.reason if fault else None


def odometry(stamp: float = 10.0, x: float = 0.0, y: float = 0.0, theta: float = 0.0) -> Odometry:
    return Odometry(stamp, 3.0, x, y, theta, 0.1, 0.0)


def test_the_smaller_limit_holds() -> None:
    wide = limits_of((0.0, -2.84), (0.22, 2.84), 0.0, 0.15, 5.0, **GENTLE)
    narrow = drifting(0.0)

    assert wide.clamp(Command(1.0, -9.0)) == Command(0.15, -2.84)
    assert narrow.clamp(Command(1.0, 9.0)) == Command(0.15, 1.5)
    assert narrow.clamp(Command(-0.1, -1.6)) == Command(0.0, -1.5)
    assert narrow.clamp(Command(0.1, 0.5)) == Command(0.1, 0.5)


def test_an_injected_turn_moves_the_policys_window_but_not_the_robots() -> None:
    limits = drifting(-1.4)

    assert limits.angular[0] == -2.84
    assert limits.angular[1] == pytest.approx(0.1)
    assert limits.clamp(Command(0.1, 1.5)).angular == pytest.approx(0.1)


def test_limits_that_exclude_each_other_are_refused() -> None:
    with pytest.raises(BridgeError, match="no command is allowed"):
        drifting(5.0)


@pytest.mark.parametrize("command", [Command(math.nan, 0.0), Command(0.1, math.inf)])
def test_a_command_that_is_no_number_is_refused(command: Command) -> None:
    with pytest.raises(BridgeError, match="not finite"):
        drifting(0.0).clamp(command)


def test_commands_change_no_faster_than_allowed() -> None:
    limits = drifting(0.0)

    first = limits.toward(Command(0.15, -1.5), STOP, 0.05)
    assert first == pytest.approx((0.05, -0.2))
    assert limits.toward(Command(0.06, -0.3), first, 0.05) == Command(0.06, -0.3)


@pytest.mark.parametrize("angle", [0.0, 3.1, -3.1, 6.3, -40.0])
def test_wrapping_changes_an_angle_by_whole_turns(angle: float) -> None:
    assert abs(wrapped(angle)) <= math.pi
    assert (angle - wrapped(angle)) / (2 * math.pi) == pytest.approx(
        round((angle - wrapped(angle)) / (2 * math.pi))
    )


@pytest.mark.parametrize(
    ("following", "reason"),
    [
        (odometry(10.03, x=0.007), None),
        (odometry(10.03, x=0.10), None),  # noise: below 0.1 + 1.5 * 0.22 * 0.03 = 0.1099
        (odometry(10.03, x=0.12), "jump"),
        (odometry(10.03, y=-0.12), "jump"),
        (odometry(10.03, theta=0.42), None),  # below 0.3 + 1.5 * 2.84 * 0.03 = 0.4278
        (odometry(10.03, theta=0.44), "jump"),
        (odometry(10.03, theta=2 * math.pi - 0.1), None),  # -0.1
        (odometry(10.4, x=0.2), None),  # below 0.1 + 1.5 * 0.22 * 0.4 = 0.232
        (odometry(10.51), "stale"),
        (odometry(9.99), "out of order"),
        (odometry(10.0), None),  # the same again is no news, and no harm
        (odometry(10.0, x=0.2), "jump"),
        (odometry(math.nan), "not finite"),
        (odometry(10.03, x=math.nan), "not finite"),
        (odometry(10.03, y=math.inf), "not finite"),
        (odometry(10.03, theta=-math.inf), "not finite"),
        (odometry(10.03)._replace(linear=math.nan), "not finite"),
        (odometry(10.03)._replace(angular=math.nan), "not finite"),
    ],
)
def test_odometry_is_guarded(following: Odometry, reason: str | None) -> None:
    assert guarded(odometry(10.0), following) == reason


def test_the_first_odometry_need_only_be_finite() -> None:
    assert guarded(None, odometry(x=100.0)) is None
    assert guarded(None, odometry(x=math.nan)) == "not finite"


def test_what_is_too_old_is_a_fault() -> None:
    assert stale(0.5, 0.5, 0.5) is None
    assert stale(0.51, 0.51, 0.5) == Fault("stale", "no odometry for 0.51 s; allowed: 0.5 s")
    late = stale(0.1, 0.6, 0.5)
    assert late is not None
    assert late.detail.startswith("odometry comes, but 0.60 s old by its stamps; allowed: 0.5 s")
    assert stale(math.nan, math.nan, 0.5) is not None
