"""What asks the process to end, while a robot drives and while it does not."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from types import FrameType
from typing import Any

# Ctrl-C, a request to end, a terminal that is gone, Ctrl-\ and Ctrl-Z. What stops a process, or
# ends it at once, would leave a robot driving as it was last told. (Windows has the first two.)
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
SIGNALS = tuple(signal.Signals[name] for name in _NAMES if hasattr(signal, name))
HANGS = 1.0  # s after a signal in which a loop that does not hang has ended


class Interrupted(KeyboardInterrupt):
    """The process was asked to end by a signal."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number  # what a shell expects as the exit code


class Signals(AbstractContextManager):
    """Turns signals into `Interrupted`, raised at once or, while a robot drives, at its end.

    A loop that drives asks `reason` at each tick, so that nothing is broken off in the middle of
    sending a command. One that comes HANGS seconds after the first is raised at once there, too.
    What other libraries call back must not raise, or they swallow it: there `postponed` waits.
    """

    def __init__(self) -> None:
        self._received: int | None = None
        self._at = 0.0  # when, in s of a monotonic clock
        self._deferring = False
        self._postponing = ""  # what is waited for
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        self._before = {number: signal.signal(number, self._take) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def reason(self) -> str | None:
        """The name of the signal that came; None: none."""
        return None if self._received is None else signal.Signals(self._received).name

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Within, a signal waits for the end.

        Raises:
            Interrupted: at the end, if one came.
        """
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        self.check()

    @contextmanager
    def postponed(self, what: str) -> Iterator[None]:
        """Within, a signal waits for the end, however often it comes.

        For work with libraries that run Python where an exception gets lost, as JAX does while
        memory is collected.

        Args:
            what: is waited for, in words; whoever sends a signal is told at once.

        Raises:
            Interrupted: at the end, if one came.
        """
        self._postponing = what
        try:
            yield
        finally:
            self._postponing = ""
        self.check()

    def check(self) -> None:
        """Ends what a signal was to end, should its exception have been lost.

        Raises:
            Interrupted: one came.
        """
        if self._received is not None:
            raise Interrupted(self._received)

    def _take(self, number: int, _: FrameType | None) -> None:
        if self._received is None:
            self._received, self._at = number, time.monotonic()
        if self._postponing:
            text = f"\n{signal.Signals(number).name}: ends after {self._postponing}\n"
            with suppress(OSError):  # the terminal may be gone
                os.write(2, text.encode())  # `print` may be in the middle of a line
            return
        if not self._deferring or time.monotonic() - self._at > HANGS:
            raise Interrupted(number)
