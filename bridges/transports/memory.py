"""A robot in the same process: for simulation at any speed, and for tests."""

from __future__ import annotations

from collections.abc import Sequence

from bridges.clock import Clock
from bridges.messages import Command, Odometry
from bridges.ros_messages import wrapped
from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.discovery import Seen, find_robot
from bridges.transports.receiving import ONLY_LISTENS, ReceivingEnd, ReceivingLink


class Wire:
    """What connects ends of one process: those with the same domain and namespace meet."""

    def __init__(self) -> None:
        self.links: list[MemoryLink] = []
        self.ends: list[MemoryEnd] = []


PROCESS = Wire()  # connects ends that are made by name


def pair(clock: Clock, settings: LinkSettings | None = None) -> tuple[MemoryLink, MemoryEnd]:
    """A link and the robot's end that it reaches, on a wire of their own; neither is open.

    Args:
        clock: the time. A VirtualClock passes while the link waits.
        settings: of both; its command type is what the robot takes.
    """
    wire, settings = Wire(), settings or LinkSettings()
    return MemoryLink(settings, clock, wire), MemoryEnd(settings, clock, wire)


class MemoryLink(ReceivingLink):
    """A RobotLink to a robot in this process."""

    def __init__(self, settings: LinkSettings, clock: Clock, wire: Wire = PROCESS) -> None:
        super().__init__(clock)
        self._settings, self._wire = settings, wire
        self.drives = True
        self.place = _place(settings)

    def open(self, *, drives: bool = True) -> None:
        """Connects; see RobotLink.

        Raises:
            TransportError: no robot is there in time, or it takes another type of command.
        """
        self.close()
        self.begin_anew()
        place = f"domain {names.domain_id(self._settings)} of this process"
        self.drives = drives
        self._type = find_robot(self._look, self._settings, place, settle=0.0, lease=0.0)
        self._wire.links.append(self)

    def others(self) -> Sequence[str]:
        """Who else commands the robot now, in words."""
        links = [each for each in tuple(self._wire.links) if each.place == self.place]
        driving = sum(each.drives for each in links if each is not self)
        return ["another link of this process"] * (
            driving if self.drives and self._settings.alone else 0
        )

    def send(self, command: Command) -> None:
        """Gives the robot a velocity command."""
        if not self.drives:
            raise TransportError(ONLY_LISTENS)
        for end in self._ends():
            if end.command_type == self.command_type:
                end.put(Command(float(command.linear), float(command.angular)))

    def request_reset(self) -> None:
        """Asks a simulated robot to go back to its start."""
        self.check_open()
        if not self._ends():
            raise TransportError("nobody listens: the robot's end is closed")
        for end in self._ends():
            end.put_reset()

    def close(self) -> None:
        """Disconnects; may be called twice."""
        self._type = None
        if self in self._wire.links:
            self._wire.links.remove(self)

    def arrive(self, odometry: Odometry) -> None:
        """Takes odometry, at this moment."""
        theta = wrapped(odometry.theta)
        self.put(odometry._replace(received=self._clock.now(), theta=theta))

    def _ends(self) -> list[MemoryEnd]:
        return [end for end in tuple(self._wire.ends) if end.place == self.place]

    def _look(self) -> Seen:
        ends = self._ends()
        topics = {f"{e.place[1]}": e.command_type for e in tuple(self._wire.ends)}
        return Seen({end.command_type for end in ends}, len(ends), topics, self.others())


class MemoryEnd(ReceivingEnd):
    """A RobotEnd in this process."""

    def __init__(self, settings: LinkSettings, clock: Clock, wire: Wire = PROCESS) -> None:
        super().__init__(clock)
        self._wire = wire
        self.place = _place(settings)
        self.command_type = names.end_type(settings)

    def open(self) -> None:
        """Begins to listen."""
        self.close()
        self._wire.ends.append(self)

    def publish(self, odometry: Odometry, covariance: Sequence[float]) -> None:
        """Publishes odometry; nobody reads the covariance here."""
        if self not in self._wire.ends:
            raise TransportError("the simulated robot's end is not open")
        for link in tuple(self._wire.links):  # others may open and close meanwhile
            if link.place == self.place:
                link.arrive(odometry)

    def close(self) -> None:
        """Disconnects; may be called twice."""
        if self in self._wire.ends:
            self._wire.ends.remove(self)


def _place(settings: LinkSettings) -> tuple[int, str]:
    return names.domain_id(settings), names.topic(settings, names.COMMANDS)
