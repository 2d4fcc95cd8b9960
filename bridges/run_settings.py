"""The settings of `bridges.run`."""

from __future__ import annotations

from dataclasses import dataclass, field

from bridges.safety import ROBOT_ANGULAR, ROBOT_LINEAR
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.transports.base import LinkSettings
from bridges.transports.choice import NAMES
from emrld_jax.fields import setting

MODES = ("collect", "adapt", "execute", "all")


@dataclass
class RunConfig:
    """All settings of driving a robot."""

    bundle: str | None = setting(None, "the policy: a file of emrld_jax.export; required")
    robot: str = setting(
        "auto",
        "how the robot is reached: rclpy (ROS 2), dds (without ROS), memory (a simulated one in "
        "this process); auto: rclpy where it can be imported, else dds",
        choices=NAMES,
    )
    mode: str = setting(
        "all",
        "collect: drive episodes and record them; adapt: learn from them (needs JAX, no robot); "
        "execute: drive episodes of the adapted policy; all: one after another",
        choices=MODES,
    )
    episodes: int = setting(5, "whole episodes to collect, and to execute", at_least=1)
    out: str | None = setting(
        None,
        "folder for recordings, adapted policies, picture and summary; what is there is gone on "
        "with; null: robot/NAME of the bundle, simulated/NAME with robot=memory, dry_run/NAME with "
        "dry_run=true",
    )
    recordings: list[str] = setting(
        [], "folders to adapt from, in the order of the inner steps; []: those in out"
    )
    deterministic: bool = setting(
        True, "execute the mean action; false: with the policy's noise, as in collecting"
    )
    reset: str = setting(
        "ask",
        "before an episode: ask a person to put the robot back, or call a simulator's service "
        "(robot=memory always does)",
        choices=("ask", "service"),
    )
    yes: bool = setting(False, "nobody need confirm that the robot may move; --yes is the same")
    dry_run: bool = setting(
        False, "publish nothing: the robot does not move; with mode=collect or mode=execute"
    )
    residual_angular_velocity: float = setting(
        0.0,
        "rad a control period that are added to the policy's turns: the paper's drift on a robot "
        "that has none (-0.65 there)",
    )
    watchdog: float = setting(
        0.5, "s; the robot stops when its odometry is older, or its loop hangs", above=0
    )
    max_linear: float = setting(ROBOT_LINEAR, "m/s that the robot may be told", above=0)
    max_angular: float = setting(ROBOT_ANGULAR, "rad/s that the robot may be told", above=0)
    linear_acceleration: float = setting(2.5, "m/s^2 at most between commands", above=0)
    angular_acceleration: float = setting(31.25, "rad/s^2 at most between commands", above=0)
    room: list[float] | None = setting(
        None,
        "[x from, x to, y from, y to] in m, of the poses that the policy sees: where there is "
        "room for the robot; outside it is stopped. null: the environment's whole arena",
    )
    origin: str = setting(
        "start",
        "where the policy sees the robot from: the pose at the episode's start, or odometry's own "
        "origin",
        choices=("start", "odometry"),
    )
    speed: float = setting(
        1.0, "of the clock: what the simulator has; 1 for a robot", above=0, at_most=100
    )
    seed: int = setting(0, "of the policy's noise", at_least=0)
    link: LinkSettings = field(default_factory=LinkSettings)
    sim: SimulatedRobotSettings = field(default_factory=SimulatedRobotSettings)
