"""What every transport offers: one end for the bridge, one for a simulated robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from bridges.messages import BridgeError, Command, Odometry
from emrld_jax.fields import setting


class TransportError(BridgeError):
    """The other side cannot be reached, or does not understand us; the message says what to do."""


@dataclass
class LinkSettings:
    """How the other side is reached."""

    domain_id: int | None = setting(
        None, "ROS domain; null: ROS_DOMAIN_ID, or 0", at_least=0, at_most=101
    )
    namespace: str = setting("", "of the robot's topics; empty: none")
    peers: list[str] = setting(
        [], "addresses to look for the robot at, where multicast does not work (dds)"
    )
    interface: str | None = setting(
        None, "network interface or its address (dds); null: the system's"
    )
    command_type: str = setting(
        "auto",
        "what the robot takes as velocity command; auto: what discovery says "
        "(a simulated robot: twist_stamped)",
        choices=("auto", "twist", "twist_stamped"),
    )
    connect_timeout: float = setting(10.0, "real s to wait for the robot to be found", above=0)
    alone: bool = setting(
        True,
        "nobody else may command the robot; false: others may, such as a person's joystick, and "
        "what comes of it is learned from",
    )


class RobotLink(Protocol):
    """The bridge's end; times are `bridges.clock` ones.

    All methods are called from one thread, but `send`: another may call it at the same time.
    """

    @property
    def command_type(self) -> str:
        """What commands are sent as, one of COMMAND_TYPES; known once it is open."""
        ...

    def open(self, *, drives: bool = True) -> None:
        """Connects: returns when a robot listens to our commands and we to its odometry.

        Who was killed is seen for some time more. While there seem to be several robots, or others
        who command this one, that time is waited.

        Args:
            drives: commands are to be sent. Otherwise we are not seen as somebody who does, and
                others may.

        Raises:
            TransportError: none is there in time, or it takes another type of command; there are
                several, or others command it.
        """
        ...

    def others(self) -> Sequence[str]:
        """Who else may command the robot now, in words.

        None for a link that only listens, or whose settings allow others.

        Cheap enough for every tick: nothing is waited for. They need not send anything.

        Raises:
            TransportError: that cannot be found out any more.
        """
        ...

    def wait(self, timeout: float) -> bool:
        """Returns when odometry is there to take (True), or after `timeout` s (False).

        Raises:
            TransportError: what receives has ended by an error, which it names.
        """
        ...

    def take(self) -> Sequence[Odometry]:
        """All odometry since the last call, in the order of arrival; never waits.

        The newest 1000 are kept for it. `received` is when each arrived, not when it is taken.

        Raises:
            TransportError: as `wait`.
        """
        ...

    def send(self, command: Command) -> None:
        """Publishes a velocity command, even if nothing is received any more: it may be zero.

        Raises:
            TransportError: it cannot be sent.
        """
        ...

    def request_reset(self) -> None:
        """Asks a simulated robot to go back to its start; its odometry shows when it has.

        Raises:
            TransportError: nobody listens, as with a real robot.
        """
        ...

    def close(self) -> None:
        """Disconnects; may be called twice, and `open` after it.

        Sends nothing: stopping is the robot's business. What was sent before still arrives.
        """
        ...


class RobotEnd(Protocol):
    """A simulated robot's end. All methods are called from one thread."""

    def open(self) -> None:
        """Begins to listen.

        Raises:
            TransportError: the network does not let it.
        """
        ...

    def wait(self, timeout: float) -> bool:
        """Returns when a command or a reset is there (True), or after `timeout` s (False)."""
        ...

    def publish(self, odometry: Odometry, covariance: Sequence[float]) -> None:
        """Publishes odometry; the covariance of x, y, theta is its diagonal, 3 numbers."""
        ...

    def take_commands(self) -> Sequence[Command]:
        """All commands since the last call, oldest first, at most 1000; never waits."""
        ...

    def take_resets(self) -> int:
        """How many resets have been asked for since the last call."""
        ...

    def close(self) -> None:
        """Disconnects; may be called twice, and `open` after it."""
        ...
