"""What arrives on another thread waits here for the one that the transport's user calls from."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence

from bridges.clock import Clock, RealClock, VirtualClock
from bridges.messages import Command, Odometry
from bridges.transports.base import TransportError

ONLY_LISTENS = "the link was opened to listen only: it sends no commands"
KEPT = 1000  # the newest are kept where nobody takes them


class _Receiving:
    """What both ends have: a clock, and why nothing arrives any more."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._arrived = threading.Condition()
        self._failed: tuple[str, Exception] | None = None

    def fail(self, error: Exception, hint: str = "") -> None:
        """Nothing arrives any more, for what receives has ended; wakes who waits.

        Args:
            error: that has ended it; taking and waiting raise it as a TransportError.
            hint: more for people.
        """
        with self._arrived:
            words = f"nothing is received any more: {type(error).__name__}: {error}{hint}"
            self._failed = self._failed or (words, error)
            self._arrived.notify_all()

    def begin_anew(self) -> None:
        """Forgets what went wrong."""
        self._failed = None

    def _check(self) -> None:
        if self._failed is not None:
            words, error = self._failed
            raise TransportError(words) from error

    def _wait(self, there: Callable[[], bool], timeout: float) -> bool:
        """Waits up to `timeout` s of the clock; a virtual one is made to pass, step by step."""
        clock = self._clock
        if isinstance(clock, VirtualClock):
            deadline = clock.now() + timeout
            while not there() and clock.now() + 1e-9 < deadline:
                clock.sleep_until(clock.now() + 1e-6)  # one whole step
            self._check()
            return there()
        speed = clock.speed if isinstance(clock, RealClock) else 1.0
        with self._arrived:
            self._arrived.wait_for(
                lambda: there() or self._failed is not None, max(0.0, timeout / speed)
            )
            self._check()
            return there()


class ReceivingLink(_Receiving):
    """The receiving half of a RobotLink."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self._odometry: deque[Odometry] = deque(maxlen=KEPT)
        self._type: str | None = None

    @property
    def command_type(self) -> str:
        """What commands are sent as, one of COMMAND_TYPES."""
        if self._type is None:
            raise TransportError("the link to the robot is not open")
        return self._type

    def check_open(self) -> None:
        """Refuses to go on where there is no robot.

        Raises:
            TransportError: the link is not open.
        """
        _ = self.command_type

    def begin_anew(self) -> None:
        """Forgets what came, and what went wrong."""
        super().begin_anew()
        self._odometry.clear()

    def put(self, odometry: Odometry) -> None:
        """Keeps odometry, and wakes who waits for it."""
        with self._arrived:
            self._odometry.append(odometry)
            self._arrived.notify_all()

    def wait(self, timeout: float) -> bool:
        """Returns when odometry is there to take (True), or after `timeout` s (False)."""
        return self._wait(lambda: bool(self._odometry), timeout)

    def take(self) -> Sequence[Odometry]:
        """All odometry since the last call, in the order of arrival; never waits."""
        with self._arrived:
            self._check()
            taken = list(self._odometry)
            self._odometry.clear()
        return taken


class ReceivingEnd(_Receiving):
    """The receiving half of a RobotEnd."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self._commands: deque[Command] = deque(maxlen=KEPT)
        self._resets = 0

    def put(self, command: Command) -> None:
        """Keeps a command, and wakes who waits for it."""
        with self._arrived:
            self._commands.append(command)
            self._arrived.notify_all()

    def put_reset(self) -> None:
        """Keeps that a reset was asked for, and wakes who waits for it."""
        with self._arrived:
            self._resets += 1
            self._arrived.notify_all()

    def wait(self, timeout: float) -> bool:
        """Returns when a command or a reset is there (True), or after `timeout` s (False)."""
        return self._wait(lambda: bool(self._commands or self._resets), timeout)

    def take_commands(self) -> Sequence[Command]:
        """All commands since the last call, oldest first; never waits."""
        with self._arrived:
            self._check()
            taken = list(self._commands)
            self._commands.clear()
        return taken

    def take_resets(self) -> int:
        """How many resets have been asked for since the last call."""
        with self._arrived:
            taken, self._resets = self._resets, 0
        return taken
