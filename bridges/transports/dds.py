"""Plain DDS, by CycloneDDS: reaches a robot with ROS 2 from a machine without it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from cyclonedds.core import DDSException
from cyclonedds.util import duration

from bridges.clock import RealClock
from bridges.messages import TWIST_STAMPED, Command, Odometry
from bridges.ros_messages import (
    command_of,
    fill_odometry,
    fill_stamp,
    fill_twist,
    odometry_of,
)
from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.dds_network import place
from bridges.transports.dds_node import Node, write
from bridges.transports.dds_types import EMPTY, ODOMETRY, TYPES
from bridges.transports.discovery import find_robot, nobody_resets, until
from bridges.transports.receiving import ONLY_LISTENS, ReceivingEnd, ReceivingLink

_ACKNOWLEDGED = 1.0  # s for the robot to say that it has all: zero velocity, as a rule
_MATCHING = 1.0  # s that two ends that know each other may need to match


class DdsLink(ReceivingLink):
    """A RobotLink over DDS."""

    def __init__(self, settings: LinkSettings, clock: RealClock) -> None:
        super().__init__(clock)
        self._settings = settings
        self._node: Node | None = None
        self._commands: Any = None

    def open(self, *, drives: bool = True) -> None:
        """Connects; see RobotLink.

        Raises:
            TransportError: the network or the robot does not let it; the message says why.
        """
        deadline = time.monotonic() + self._settings.connect_timeout
        self.close()
        self.begin_anew()
        self._node = node = Node(self._settings, self.fail)
        try:
            reader = node.reader(names.ODOMETRY, ODOMETRY, self._take_odometry)
            if drives and self._settings.alone:
                node.watch(names.COMMANDS)
            node.start()
            self._reset = node.writer(names.RESET, EMPTY)
            self._type = find_robot(node.look, self._settings, place(self._settings))
            matched = {names.ODOMETRY: lambda: bool(reader.matched_pub)}
            if drives:
                self._commands = writer = node.writer(names.COMMANDS, self._type)
                matched[names.COMMANDS] = lambda: bool(writer.matched_sub)
            self._match(matched, max(deadline, time.monotonic() + _MATCHING))
        except BaseException:
            self.close()
            raise

    def _match(self, matched: Mapping[str, Callable[[], bool]], late: float) -> None:
        """Waits for endpoints to match the robot's, to a moment of time.monotonic at most."""
        if until(lambda: all(each() for each in matched.values()), late):
            return
        missing = next((name for name, each in matched.items() if not each()), names.ODOMETRY)
        raise TransportError(
            f"the robot was found in {place(self._settings)}, but its endpoint of"
            f" {names.topic(self._settings, missing)} does not match ours: ours are"
            " reliable and volatile; it must publish odometry reliably, too"
        )

    def others(self) -> Sequence[str]:
        """Who else commands the robot now, in words."""
        return self._node.others() if self._node is not None else ()

    def send(self, command: Command) -> None:
        """Publishes a velocity command."""
        if self._type is not None and self._commands is None:
            raise TransportError(ONLY_LISTENS)
        message = TYPES[self.command_type]()
        if self.command_type == TWIST_STAMPED:
            fill_stamp(message.header.stamp, time.time())
            fill_twist(message.twist, command)
        else:
            fill_twist(message, command)
        write(self._commands, message)

    def request_reset(self) -> None:
        """Asks a simulated robot to go back to its start; see RobotLink."""
        self.check_open()
        if not until(lambda: bool(self._reset.matched_sub), time.monotonic() + _MATCHING):
            name = names.topic(self._settings, names.RESET)
            raise TransportError(nobody_resets(name))
        write(self._reset, TYPES[EMPTY]())

    def close(self) -> None:
        """Disconnects; may be called twice. What was sent last is waited for, if it gets lost."""
        if self._commands is not None:
            # when nobody says so, CycloneDDS 11.0 fails on its way to say that
            with suppress(AttributeError, DDSException):
                self._commands.wait_for_acks(duration(seconds=_ACKNOWLEDGED))
        self._type = self._commands = self._reset = None
        if self._node is not None:
            self._node.close()
            self._node = None

    def _take_odometry(self, message: Any) -> None:
        self.put(odometry_of(message, self._clock.now()))


class DdsEnd(ReceivingEnd):
    """A RobotEnd over DDS."""

    def __init__(self, settings: LinkSettings, clock: RealClock) -> None:
        super().__init__(clock)
        self._settings = settings
        self._node: Node | None = None

    def open(self) -> None:
        """Begins to listen.

        Raises:
            TransportError: the network does not let it; the message says why.
        """
        self.close()
        self.begin_anew()
        kind = names.end_type(self._settings)
        stamped = kind == TWIST_STAMPED
        self._node = node = Node(self._settings, self.fail)
        try:
            self._odometry = node.writer(names.ODOMETRY, ODOMETRY)
            node.reader(names.RESET, EMPTY, lambda _: self.put_reset())
            node.reader(
                names.COMMANDS,
                kind,
                lambda message: self.put(command_of(message.twist if stamped else message)),
            )
            node.start()
        except BaseException:
            self.close()
            raise

    def publish(self, odometry: Odometry, covariance: Sequence[float]) -> None:
        """Publishes odometry; the covariance of x, y, theta is its diagonal, 3 numbers."""
        if self._node is None:
            raise TransportError("the simulated robot's end is not open")
        message = TYPES[ODOMETRY]()
        fill_odometry(message, odometry, covariance)
        write(self._odometry, message)

    def close(self) -> None:
        """Disconnects; may be called twice."""
        self._odometry = None
        if self._node is not None:
            self._node.close()
            self._node = None
