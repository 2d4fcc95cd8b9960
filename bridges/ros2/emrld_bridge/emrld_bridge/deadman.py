"""The node `emrld_deadman`: stops a robot to which nobody talks any more.

It belongs on the robot's own computer: `cmd_vel_in` is passed on to `cmd_vel`, and when nothing has
come in for a while, or this node is told to end, zero velocity is sent. It needs rclpy and
geometry_msgs alone.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

NAME = "emrld_deadman"
INPUT, OUTPUT = "cmd_vel_in", "cmd_vel"
TYPES = {"twist": Twist, "twist_stamped": TwistStamped}
NAMES = {"geometry_msgs/msg/Twist": "twist", "geometry_msgs/msg/TwistStamped": "twist_stamped"}
QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
TICK = 0.05  # s between looks at the time
STOPS = 5  # zero velocities that are sent to stop: some may get lost
# what would end or stop this node with the robot driving on: a terminal that is gone, Ctrl-Z, ..
SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
    if hasattr(signal, name)
]
PARAMETERS = (
    ("timeout", 0.5, "s without a command after which the robot is stopped"),
    (
        "command_type",
        "auto",
        "of both topics: twist (Humble's TurtleBot3), twist_stamped (Jazzy's); auto: what the "
        "robot listens to",
    ),
)


class Silence:
    """Says when zero velocity is due.

    Args:
        timeout: s without a command.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._last = 0.0
        self._left = 0  # zero velocities that are to be sent when it gets silent
        self.heard = False  # whether there ever was a command

    def command(self, now: float) -> None:
        """A command has come, at a time in s."""
        self._last, self._left, self.heard = now, STOPS, True

    def due(self, now: float) -> bool:
        """Whether to send zero velocity now; asked at each tick, true `STOPS` times in a row."""
        if self._left == 0 or now - self._last <= self._timeout:
            return False
        self._left -= 1
        return True


def main() -> None:
    """Passes commands on until a signal comes."""
    stopped: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda number, _: stopped.append(number))
    context = Context()
    # no handler of rclpy's: it would end the context before the robot is stopped
    rclpy.init(args=sys.argv, context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Node(NAME, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        relay(node, executor, lambda: bool(stopped))
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def relay(node: Any, executor: Any, stopped: Callable[[], bool]) -> None:
    """Passes commands on until it is stopped; then zero velocity is sent."""
    for name, default, description in PARAMETERS:
        about = ParameterDescriptor(description=description, read_only=True, dynamic_typing=True)
        node.declare_parameter(name, default, about)
    timeout = float(node.get_parameter("timeout").value)
    if not timeout > 0:
        raise SystemExit(f"timeout={timeout:g} is not allowed: it must be above 0")
    silence = Silence(timeout)
    kind = command_type(node, executor, stopped)
    if kind is None:
        return
    publisher = node.create_publisher(TYPES[kind], OUTPUT, QOS)

    def pass_on(message: Any) -> None:
        silence.command(time.monotonic())
        publisher.publish(message)

    node.create_subscription(TYPES[kind], INPUT, pass_on, QOS)
    node.get_logger().info(f"passes {kind} from {INPUT} on to {OUTPUT}")
    try:
        while not stopped():
            executor.spin_once(timeout_sec=TICK)
            if silence.due(time.monotonic()):
                publisher.publish(zero(node, kind))
    finally:
        if silence.heard:
            for _ in range(STOPS):
                publisher.publish(zero(node, kind))
                time.sleep(0.02)
            with suppress(Exception):  # not every middleware can
                publisher.wait_for_all_acked(Duration(seconds=0.5))


def command_type(node: Any, executor: Any, stopped: Callable[[], bool]) -> str | None:
    """The type of the robot's commands; None if this was stopped before it was known."""
    kind = str(node.get_parameter("command_type").value)
    if kind in TYPES:
        return kind
    if kind != "auto":
        raise SystemExit(f"command_type={kind} is none of auto, {', '.join(TYPES)}")
    node.get_logger().info(f"waits for somebody who listens to {OUTPUT}")
    topic = node.resolve_topic_name(OUTPUT)  # rclpy does not remap what is asked for below
    while not stopped():
        listened = node.get_subscriptions_info_by_topic(topic)
        kinds = {NAMES[end.topic_type] for end in listened if end.topic_type in NAMES}
        if len(kinds) > 1:
            raise SystemExit(
                f"{OUTPUT} is listened to as {' and as '.join(sorted(kinds))}: "
                "say by command_type which is the robot's"
            )
        if kinds:
            return kinds.pop()
        executor.spin_once(timeout_sec=TICK)
        time.sleep(TICK)
    return None


def zero(node: Any, kind: str) -> Any:
    """Zero velocity as a message."""
    message = TYPES[kind]()
    if kind == "twist_stamped":
        message.header.stamp = node.get_clock().now().to_msg()
    return message
