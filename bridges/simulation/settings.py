"""What a simulated robot can do, and what goes wrong with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bridges.settings import SettingError
from bridges.simulation.faults import FAULTS
from emrld_jax.fields import setting


@dataclass
class SimulatedRobotSettings:
    """The simulated robot. All seconds are of its own clock, so `speed` times faster than ours."""

    drift: float = setting(
        0.0,
        "rad/s that it turns by itself while it drives, beside what its wheels do; odometry sees "
        "it. The paper's -0.65 rad a step of 0.5 s are -1.3",
    )
    start: list[float] = setting(
        [0.0, 0.0, 0.0], "x (m), y (m), theta (rad) where it begins and is put back to"
    )
    max_linear: float = setting(0.22, "m/s, either way: a TurtleBot3 Burger's", above=0)
    max_angular: float = setting(2.84, "rad/s, either way: a TurtleBot3 Burger's", above=0)
    linear_acceleration: float | None = setting(
        2.5, "m/s^2, of either sign; null: new velocities are there at once", above=0
    )
    angular_acceleration: float | None = setting(
        31.25,
        "rad/s^2, of either sign: wheels 0.08 m from the middle, at 2.5 m/s^2; null: at once",
        above=0,
    )
    quantization: float | None = setting(
        0.01, "m/s and rad/s that commands are cut to, toward zero; null: not cut", above=0
    )
    command_timeout: float | None = setting(
        0.5,
        "s without a command after which it stops; null: never, as a real one of ROS 2",
        above=0,
    )
    odometry_rate: float = setting(30.0, "Hz", above=0, at_most=1000)
    position_noise: float = setting(
        0.0, "m, standard deviation of what odometry says of x and of y", at_least=0
    )
    heading_noise: float = setting(
        0.0, "rad, standard deviation of what odometry says of theta", at_least=0
    )
    command_latency: float = setting(0.0, "s from a command's arrival to its effect", at_least=0)
    odometry_latency: float = setting(0.0, "s from a pose to its odometry's departure", at_least=0)
    command_loss: float = setting(0.0, "share of commands that gets lost", at_least=0, at_most=1)
    odometry_loss: float = setting(0.0, "share of odometry that gets lost", at_least=0, at_most=1)
    fault: str = setting(
        "none",
        "what goes wrong with odometry, to test who relies on it: silent, nothing is told; freeze, "
        "the last message again and again; nan; jump, x is 1 m off; out_of_order, every two "
        "messages swapped",
        choices=FAULTS,
    )
    fault_after: float = setting(
        3.0, "s after it first drives that the fault begins; being put back ends it", at_least=0
    )
    seed: int = setting(0, "of noise and losses", at_least=0)


def of_length(name: str, values: Sequence[float], meaning: str) -> tuple[float, ...]:
    """The values of a list setting, of which there must be as many as its meaning has words.

    Raises:
        SettingError: there are more or fewer.
    """
    if len(values) != len(meaning.split(", ")):
        written = ",".join(f"{value:g}" for value in values)
        raise SettingError(f"{name}=[{written}] is not allowed: it must be [{meaning}]")
    return tuple(values)
