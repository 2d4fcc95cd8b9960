"""ROS 2, by rclpy: for robots' own computers and other machines with ROS."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions, get_current_signal_handlers_options
from std_msgs.msg import Empty

from bridges.clock import RealClock
from bridges.messages import TWIST, TWIST_STAMPED, Command, Odometry
from bridges.ros_messages import command_of, fill_odometry, fill_twist, odometry_of
from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.discovery import find_robot, nobody_resets, until
from bridges.transports.receiving import ONLY_LISTENS, ReceivingEnd, ReceivingLink
from bridges.transports.ros_session import Session

RESET_SERVICE = "reset_simulation"  # std_srvs/srv/Empty, of a simulated robot
_TYPES = {TWIST: Twist, TWIST_STAMPED: TwistStamped}
_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
_MATCHING = 1.0  # s that two ends that know each other may need to match
_HANDLERS = (
    "this program has called rclpy.init with rclpy's signal handlers: on SIGINT or SIGTERM they"
    " shut down all that rclpy has in this process, the robot's publisher too, before zero velocity"
    " can be sent, and a real robot drives on. Call"
    " rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)"
)


class RosLink(ReceivingLink):
    """A RobotLink through rclpy, as the node `emrld_bridge`."""

    def __init__(self, settings: LinkSettings, clock: RealClock) -> None:
        super().__init__(clock)
        self._settings = settings
        self._session: Session | None = None
        self._commands: Any = None

    def open(self, *, drives: bool = True) -> None:
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
        self._session = session = Session("emrld_bridge", self._settings, self.fail)
        try:
            node = session.node
            node.create_subscription(OdometryMessage, names.ODOMETRY, self._take_odometry, _QOS)
            self._reset = node.create_publisher(Empty, names.RESET, _QOS)
            session.watches = drives and self._settings.alone
            session.start()
            self._type = find_robot(session.look, self._settings, session.place)
            if drives:
                self._match(session, max(deadline, time.monotonic() + _MATCHING))
            session.check_odometry()
        except BaseException:
            self.close()
            raise

    def _match(self, session: Session, late: float) -> None:
        """Makes the publisher of commands, and waits for the robot, to a time.monotonic at most."""
        node = session.node
        self._commands = publisher = node.create_publisher(
            _TYPES[self.command_type], names.COMMANDS, _QOS
        )
        session.publishes = True
        if not until(lambda: publisher.get_subscription_count() > 0, late):
            raise TransportError(
                f"the robot was found in {session.place}, but its subscription to"
                f" {node.resolve_topic_name(names.COMMANDS)} does not match ours, which"
                " is reliable and volatile"
            )

    def others(self) -> Sequence[str]:
        """Who else commands the robot now, in words."""
        return self._session.others() if self._session is not None else ()

    def send(self, command: Command) -> None:
        """Publishes a velocity command."""
        if self._type is not None and self._commands is None:
            raise TransportError(ONLY_LISTENS)
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
        self._type = self._commands = None
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
        self._session: Session | None = None

    def open(self) -> None:
        """Begins to listen.

        Raises:
            TransportError: ROS does not let it; the message says why.
        """
        self.close()
        self.begin_anew()
        kind = names.end_type(self._settings)
        take = self._take_stamped if kind == TWIST_STAMPED else self._take_plain
        self._session = session = Session("emrld_sim_turtlebot", self._settings, self.fail)
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
