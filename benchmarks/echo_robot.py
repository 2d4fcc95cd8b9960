"""Robots that answer every command with odometry: for measuring and testing transports.

`python -m benchmarks.echo_robot TRANSPORT DOMAIN [NAMESPACE:COMMAND_TYPE ...]` runs them until its
input ends; it prints `ready` once all listen.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

from bridges.clock import RealClock
from bridges.messages import Odometry
from bridges.transports.base import LinkSettings, RobotEnd
from bridges.transports.choice import end

COVARIANCE = (0.01, 0.02, 0.03)  # of x, y (m^2) and theta (rad^2)


def echo(robot: RobotEnd, going_on: Callable[[], bool]) -> None:
    """Answers while it is to go on.

    The odometry of a command has it as x and y, as theta and as velocities; that of resets has
    their number, negative, as x. Its stamp in s counts answers.
    """
    answers = 0

    def answer(x: float, y: float) -> None:
        nonlocal answers
        answers += 1
        robot.publish(Odometry(float(answers), 0.0, x, y, y, x, y), COVARIANCE)

    while going_on():
        robot.wait(0.1)
        if resets := robot.take_resets():
            answer(-float(resets), 0.0)
        for command in robot.take_commands():
            answer(command.linear, command.angular)


def main() -> int:
    """Runs the robots."""
    transport, domain, *robots = sys.argv[1:]
    pairs = [text.split(":") for text in robots or [":twist_stamped"]]
    ends = [
        end(transport, LinkSettings(int(domain), namespace, command_type=kind), RealClock())
        for namespace, kind in pairs
    ]
    over = threading.Event()
    threads = []
    for robot in ends:
        robot.open()
        arguments = (robot, lambda: not over.is_set())
        threads.append(threading.Thread(target=echo, args=arguments))
        threads[-1].start()
    print("ready", flush=True)
    sys.stdin.read()
    over.set()
    for thread, robot in zip(threads, ends, strict=True):
        thread.join()
        robot.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
