"""What stops a robot that nobody steps any more."""

from __future__ import annotations

import threading

from bridges.robot import TurtleBot3


class Minder:
    """Sends zero velocity when a robot has been left alone in the middle of an episode.

    Whoever learns between two steps, or looks at them in a debugger, does not guard the robot,
    which a real TurtleBot3 answers by driving on.

    Args:
        robot: connected.
        lock: held by whoever uses the robot.
        seconds: real ones that it may be left alone; None: as long as one likes, for a robot in
            virtual time.
    """

    def __init__(self, robot: TurtleBot3, lock: threading.RLock, seconds: float | None) -> None:
        self._robot, self._lock, self._seconds = robot, lock, seconds
        self._timer: threading.Timer | None = None

    def leave(self) -> None:
        """The robot is left alone from now on."""
        if self._seconds is not None:
            self._timer = threading.Timer(self._seconds, self._stop)
            self._timer.daemon = True
            self._timer.start()

    def back(self) -> None:
        """Somebody uses the robot again, and holds the lock."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def disconnect(self) -> None:
        """Stops the robot and disconnects."""
        with self._lock:
            self.back()
            self._robot.disconnect()

    def _stop(self) -> None:
        with self._lock:
            if self._timer is threading.current_thread():  # nobody has come back meanwhile
                self._robot.stop()
