"""What stops a robot whose loop hangs: a thread beside it.

A terminal that takes no more text, a policy that does not return, a debugger: whoever waits for one
of them does not guard the robot, which a real TurtleBot3 answers by driving on as it was told.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress

LOOK = 0.05  # s between looks at the loop, and between stops of a robot whose loop hangs
PATIENCE = 1.0  # s for the thread to end; it may hang in sending, as the loop did


class Minder:
    """Stops a robot, again and again, while it drives and its loop has not ticked for too long.

    Nothing is locked, for the loop may hang anywhere, in sending too. What it sends just as it is
    found to hang may come after a stop; so it looks at `stalled` at each of its ticks.

    Args:
        stop: sends zero velocity once; called on the minder's thread.
        seconds: real ones that may pass between two ticks; None: as many as one likes, for a robot
            in virtual time, which does not drive on while nobody waits for it.

    Attributes:
        stalled: the loop has hung since `watch`.
    """

    def __init__(self, stop: Callable[[], None], seconds: float | None) -> None:
        self._stop, self._seconds = stop, seconds
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._driving = False
        self._ticked = 0.0  # when, in s of a monotonic clock
        self.stalled = False

    def start(self) -> None:
        """Begins to look; before `watch` it does nothing."""
        if self._seconds is not None:
            self._ended.clear()
            self._thread = threading.Thread(
                target=self._mind, args=(self._seconds,), name="minder", daemon=True
            )
            self._thread.start()

    def end(self) -> None:
        """Looks no more; may be called twice."""
        self._ended.set()
        if self._thread not in (None, threading.current_thread()):  # garbage is found on any
            self._thread.join(PATIENCE)
        self._thread = None

    def watch(self) -> None:
        """The robot drives from now on."""
        self.tick()
        self._driving = True

    def tick(self) -> None:
        """The loop goes on."""
        self._ticked = time.monotonic()

    def rest(self) -> None:
        """The robot stands: nobody need tick."""
        self._driving = False

    def forgive(self) -> None:
        """Forgets that the loop has hung."""
        self.stalled = False

    def _mind(self, seconds: float) -> None:
        while not self._ended.wait(LOOK):
            if not self._driving:
                continue
            if time.monotonic() - self._ticked > seconds:
                self.stalled = True
            if self.stalled:
                with suppress(Exception):  # it may go through a moment later
                    self._stop()
