"""A node of rclpy with a context and a thread of its own, and what its graph shows of others."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.discovery import Seen

_ODOMETRY = "nav_msgs/msg/Odometry"
_FAREWELL = 0.5  # s for what was sent last to arrive
_LOOK = 0.1  # s at most between the executor's looks at whether it is to end
_SHUT_DOWN = (
    " (rclpy was shut down in this process, as its signal handlers do with all that it has: call"
    " rclpy.init with signal_handler_options=SignalHandlerOptions.NO)"
)
# what the graph calls those who have no name in ROS
_NAMELESS = ("_CREATED_BY_BARE_DDS_APP_", "_NODE_NAME_UNKNOWN_", "")


class Session:
    """A context of our own, with a node and a thread that serves its callbacks.

    No signal handler is taken over: whoever drives the robot has to stop it on SIGINT itself.

    Args:
        name: of the node.
        settings: where the robot is.
        fail: told what ends the thread, and more for people.
    """

    def __init__(
        self, name: str, settings: LinkSettings, fail: Callable[[Exception, str], None]
    ) -> None:
        if settings.peers or settings.interface:
            raise TransportError(
                "link.peers and link.interface are for robot=dds; with rclpy the middleware's own"
                " configuration counts, such as ROS_STATIC_PEERS (ROS 2 Iron and later) or"
                " CYCLONEDDS_URI"
            )
        number = names.domain_id(settings)
        names.topic(settings, "")  # a bad namespace is refused in our words
        self.place = f"domain {number} (rclpy)"
        self._context = Context()
        try:
            rclpy.init(
                context=self._context,
                domain_id=number,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self.node = Node(
                name,
                context=self._context,
                namespace=settings.namespace.strip("/") or None,
                start_parameter_services=False,
            )
        except Exception as error:  # rclpy has many kinds, RuntimeErrors among them
            self._context.try_shutdown()
            raise TransportError(f"rclpy does not join domain {number}: {error}") from error
        self._closing, self._fail = False, fail
        self.watches = False  # whether it matters who else commands the robot
        self.publishes = False  # whether we do
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)

    def start(self) -> None:
        """Begins to serve callbacks."""
        self._thread.start()

    def look(self) -> Seen:
        """What the ROS graph shows."""
        node = self.node
        odometry = [publisher.topic_type for publisher in self._publishers()]
        ours = {names.RESET} if odometry else {names.RESET, names.ODOMETRY}
        hidden = {node.resolve_topic_name(name) for name in ours}
        topics = {
            name: ", ".join(types)
            for name, types in node.get_topic_names_and_types()
            if name not in hidden
        }
        # rclpy need not remap what is asked for
        listeners = node.get_subscriptions_info_by_topic(node.resolve_topic_name(names.COMMANDS))
        types = {e.topic_type for e in listeners}
        return Seen(types, odometry.count(_ODOMETRY), topics, self.others())

    def others(self) -> Sequence[str]:
        """Who else publishes commands, in words; nobody where that does not matter.

        Raises:
            TransportError: the graph cannot be read.
        """
        if not self.watches:
            return ()
        topic = self.node.resolve_topic_name(names.COMMANDS)
        try:
            found = [_described(each) for each in self.node.get_publishers_info_by_topic(topic)]
        except Exception as error:  # RCLError is of a private module; InvalidHandle, ..
            raise TransportError(f"the ROS graph cannot be read: {error}") from error
        # rclpy does not tell which is ours. A second bridge has the same name: one is left then
        if self.publishes:
            found = _without_one(found, f"node {self.node.get_fully_qualified_name()} (")
        return sorted(found)

    def check_odometry(self) -> None:
        """Refuses odometry that our subscription does not match.

        Raises:
            TransportError: all of it is sent by best effort.
        """
        found = [each for each in self._publishers() if each.topic_type == _ODOMETRY]
        kinds = {each.qos_profile.reliability for each in found}
        if kinds == {ReliabilityPolicy.BEST_EFFORT}:
            raise TransportError(
                f"the robot was found in {self.place}, but it publishes"
                f" {self.node.resolve_topic_name(names.ODOMETRY)} by best effort, which our"
                " subscription does not match: it must publish odometry reliably"
            )

    def _publishers(self) -> Any:
        return self.node.get_publishers_info_by_topic(self.node.resolve_topic_name(names.ODOMETRY))

    def close(self) -> None:
        """Waits a moment for what was sent last, then ends everything, what is served first."""
        for publisher in self.node.publishers:
            with suppress(Exception):  # not every middleware can; leaving goes on
                publisher.wait_for_all_acked(Duration(seconds=_FAREWELL))
        self._closing = True
        if self._thread.is_alive():
            self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        """Serves callbacks.

        Not by `spin`, which ends when another thread shuts the executor down: that takes its guard
        conditions away while it may be about to wait for them, and then it waits for ever
        (github.com/ros2/rclpy/issues/968).
        """
        try:
            while not self._closing:
                self._executor.spin_once(timeout_sec=_LOOK)
        except Exception as error:  # a callback's, or rclpy's own; in a thread nobody would see it
            self._fail(error, "" if self._context.ok() else _SHUT_DOWN)


def _described(endpoint: Any) -> str:
    """A publisher of the graph, in words."""
    kind = endpoint.topic_type
    if endpoint.node_name in _NAMELESS:
        return f"a program without a name in ROS ({kind})"
    return f"node {endpoint.node_namespace.rstrip('/')}/{endpoint.node_name} ({kind})"


def _without_one(texts: Sequence[str], start: str) -> list[str]:
    """All but the first that starts so."""
    number = next((i for i, text in enumerate(texts) if text.startswith(start)), len(texts))
    return [*texts[:number], *texts[number + 1 :]]
