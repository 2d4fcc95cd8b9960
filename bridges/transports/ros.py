"""ROS 2, by rclpy: for robots' own computers and other machines with ROS."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions, get_current_signal_handlers_options
from std_msgs.msg import Empty

from bridges.clock import RealClock
from bridges.messages import TWIST, TWIST_STAMPED, Command, Odometry
from bridges.ros_messages import command_of, fill_odometry, fill_twist, odometry_of
from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.discovery import Seen, find_robot, nobody_resets, until
from bridges.transports.receiving import ReceivingEnd, ReceivingLink

RESET_SERVICE = "reset_simulation"  # std_srvs/srv/Empty, of a simulated robot
_ODOMETRY = "nav_msgs/msg/Odometry"
_TYPES = {TWIST: Twist, TWIST_STAMPED: TwistStamped}
_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
_MATCHING = 1.0  # s that two ends that know each other may need to match
_FAREWELL = 0.5  # s for what was sent last to arrive
_SHUT_DOWN = (
    " (rclpy was shut down in this process, as its signal handlers do with all that it has: call"
    " rclpy.init with signal_handler_options=SignalHandlerOptions.NO)"
)
_HANDLERS = (
    "this program has called rclpy.init with rclpy's signal handlers: on SIGINT or SIGTERM they"
    " shut down all that rclpy has in this process, the robot's publisher too, before zero velocity"
    " can be sent, and a real robot drives on. Call"
    " rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)"
)
_LOOK = 0.1  # s at most between the executor's looks at whether it is to end


class RosLink(ReceivingLink):
    """A RobotLink through rclpy, as the node `emrld_bridge`."""

    def __init__(self, settings: LinkSettings, clock: RealClock) -> None:
        super().__init__(clock)
        self._settings = settings
        self._session: _Session | None = None

    def open(self) -> None:
        """Connects; see RobotLink.

        Raises:
            TransportError: ROS or the robot does not let it; the message says why.

        Warns:
            RuntimeWarning: rclpy's signal handlers would end the link before a robot is stopped.
        """
        deadline = time.monotonic() + self._settings.connect_timeout
        self.close()
        self.begin_anew()
        if get_current_signal_handlers_options() != SignalHandlerOptions.NO:
            warnings.warn(_HANDLERS, RuntimeWarning, stacklevel=2)
        self._session = session = _Session("emrld_bridge", self._settings, self.fail)
        try:
            node = session.node
            node.create_subscription(OdometryMessage, names.ODOMETRY, self._take_odometry, _QOS)
            self._reset = node.create_publisher(Empty, names.RESET, _QOS)
            session.start()
            self._type = find_robot(session.look, self._settings, session.place)
            self._commands = publisher = node.create_publisher(
                _TYPES[self._type], names.COMMANDS, _QOS
            )
            late = max(deadline, time.monotonic() + _MATCHING)
            if not until(lambda: publisher.get_subscription_count() > 0, late):
                raise TransportError(
                    f"the robot was found in {session.place}, but its subscription to"
                    f" {node.resolve_topic_name(names.COMMANDS)} does not match ours, which"
                    " is reliable and volatile"
                )
            session.check_odometry()
        except BaseException:
            self.close()
            raise

    def send(self, command: Command) -> None:
        """Publishes a velocity command."""
        message = _TYPES[self.command_type]()
        if self.command_type == TWIST_STAMPED:
            assert self._session is not None
            message.header.stamp = self._session.node.get_clock().now().to_msg()
            fill_twist(message.twist, command)
        else:
            fill_twist(message, command)
        _publish(self._commands, message)

    def request_reset(self) -> None:
        """Asks a simulated robot to go back to its start; see RobotLink."""
        self.check_open()
        listeners = self._reset.get_subscription_count
        if not until(lambda: listeners() > 0, time.monotonic() + _MATCHING):
            name = names.topic(self._settings, names.RESET)
            raise TransportError(nobody_resets(name))
        _publish(self._reset, Empty())

    def close(self) -> None:
        """Disconnects; may be called twice."""
        self._type = None
        if self._session is not None:
            self._session.close()
            self._session = None

    def _take_odometry(self, message: Any) -> None:
        self.put(odometry_of(message, self._clock.now()))


class RosEnd(ReceivingEnd):
    """A RobotEnd through rclpy, as the node `emrld_sim_turtlebot`.

    Where std_srvs is installed it can be reset by the service `reset_simulation`, too.
    """

    def __init__(self, settings: LinkSettings, clock: RealClock) -> None:
        super().__init__(clock)
        self._settings = settings
        self._session: _Session | None = None

    def open(self) -> None:
        """Begins to listen.

        Raises:
            TransportError: ROS does not let it; the message says why.
        """
        self.close()
        self.begin_anew()
        kind = names.end_type(self._settings)
        take = self._take_stamped if kind == TWIST_STAMPED else self._take_plain
        self._session = session = _Session("emrld_sim_turtlebot", self._settings, self.fail)
        try:
            node = session.node
            self._odometry = node.create_publisher(OdometryMessage, names.ODOMETRY, _QOS)
            node.create_subscription(Empty, names.RESET, self._take_reset, _QOS)
            self._offer_reset(node)
            node.create_subscription(_TYPES[kind], names.COMMANDS, take, _QOS)
            session.start()
        except BaseException:
            self.close()
            raise

    def publish(self, odometry: Odometry, covariance: Sequence[float]) -> None:
        """Publishes odometry; the covariance of x, y, theta is its diagonal, 3 numbers."""
        if self._session is None:
            raise TransportError("the simulated robot's end is not open")
        message = OdometryMessage()
        fill_odometry(message, odometry, covariance)
        _publish(self._odometry, message)

    def close(self) -> None:
        """Disconnects; may be called twice."""
        if self._session is not None:
            self._session.close()
            self._session = None

    # rclpy looks at how many arguments a callback takes: one, the message

    def _take_plain(self, message: Any) -> None:
        self.put(command_of(message))

    def _take_stamped(self, message: Any) -> None:
        self.put(command_of(message.twist))

    def _take_reset(self, message: Any) -> None:
        self.put_reset()

    def _offer_reset(self, node: Any) -> None:
        """The service, where its type is installed: neither rclpy nor the messages need it."""
        with suppress(ImportError):
            from std_srvs.srv import Empty as EmptyService  # noqa: PLC0415

            node.create_service(EmptyService, RESET_SERVICE, self._serve_reset)

    def _serve_reset(self, request: Any, response: Any) -> Any:
        self.put_reset()
        return response


def _publish(publisher: Any, message: Any) -> None:
    """Sends a message.

    Raises:
        TransportError: the middleware refuses it.
    """
    try:
        publisher.publish(message)
    except Exception as error:  # RCLError is of a private module; InvalidHandle, ..
        raise TransportError(f"a message could not be sent: {error}") from error


class _Session:
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
        return Seen({e.topic_type for e in listeners}, odometry.count(_ODOMETRY), topics)

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
