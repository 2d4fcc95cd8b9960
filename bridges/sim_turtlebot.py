"""A simulated TurtleBot3 as a process of its own: `python -m bridges.sim_turtlebot robot=dds`."""

from __future__ import annotations

import signal
import threading
from dataclasses import replace

from bridges.clock import RealClock
from bridges.command_line import configured, run_command
from bridges.settings import SettingError
from bridges.simulation.process import SimTurtleBotConfig, simulate
from bridges.transports.choice import end, resolved

EXAMPLES = (
    "robot=dds drift=-1.3",
    "robot=dds speed=10 view=null link.domain_id=30",
    "robot=rclpy command_type=twist position_noise=0.01 command_loss=0.3 command_latency=0.2",
)
# Ctrl-C, a request to end, a terminal that is gone (Windows has no such signal). Who does not end
# properly is taken for a robot for some seconds more.
SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]


def main() -> int:
    """Simulates a robot until it is interrupted."""
    config = configured(
        "bridges.sim_turtlebot",
        "Simulates a TurtleBot3 that a bridge can drive as it drives a real one.",
        EXAMPLES,
        SimTurtleBotConfig(),
    )
    if config is None:
        return 0
    if config.link.command_type != "auto":
        raise SettingError("link.command_type is the bridge's; the robot's is command_type")
    stop = threading.Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: stop.set())
    clock = RealClock(config.speed)
    config = replace(config, robot=resolved(config.robot))
    robot = end(config.robot, replace(config.link, command_type=config.command_type), clock)
    robot.open()
    try:
        simulate(config, robot, clock, stop.is_set, lambda line: print(line, flush=True))
    finally:
        robot.close()
    return 0


if __name__ == "__main__":
    run_command(main)
