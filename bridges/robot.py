"""A TurtleBot3 over any transport: its pose since an episode began, and commands it may have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import numpy as np

from bridges.clock import Clock, RealClock, real
from bridges.commander import SOON, Commander, RobotRules
from bridges.home import is_there, not_reached
from bridges.messages import BridgeError, Command, Odometry
from bridges.minder import Minder
from bridges.safety import Fault, RobotFault
from bridges.tracking import Tracker, check_clocks
from bridges.transports.base import RobotLink

CLOCK_WINDOW = 1.0  # s over which the speed of the robot's clock is measured
RESET_TAKES = 0.3  # s before which odometry may still be from before a reset
RESET_SHOWS = 1.0  # s in which a reset shows in odometry; then it is asked for again
GONE = 0.5  # of its patience that a reset waits for a robot that says nothing
RESTS = 1.0  # s at most that zero velocity is sent on leaving, until odometry shows it
AT_REST = (0.01, 0.1)  # m/s and rad/s that odometry may show of a robot that stands


class Observation(NamedTuple):
    """What a policy sees of the robot."""

    pose: np.ndarray  # [3] float32: x (m), y (m), theta (rad, continuous), since `begin`
    age: float  # s, of the odometry that it is made of


class TurtleBot3(AbstractContextManager):
    """A robot to drive; as a context it is connected, and at the end stands still.

    All methods are for one thread. Between `send_action` and the next one, call `hold`: it repeats
    the command and guards the robot. From `send_action` to `stop` a thread of its own sends zero
    velocity if nothing is called for longer than the guard's watchdog (in real seconds; not in
    virtual time, where nothing drives on meanwhile). The fault is then "stalled".

    Attributes:
        odometry: all that arrived since `begin`.
    """

    def __init__(self, link: RobotLink, clock: Clock, rules: RobotRules) -> None:
        self._link, self._clock, self._rules = link, clock, rules
        self.odometry: list[Odometry] = []
        self._commander = Commander(link, clock, rules)
        self._tracker = Tracker(rules.guard)
        self._home: Odometry | None = None  # where a reset brings it
        self._connected = False
        patience = rules.guard.watchdog if isinstance(clock, RealClock) else None
        self._minder = Minder(self._commander.brake, patience)

    def __enter__(self) -> TurtleBot3:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()

    @property
    def command_type(self) -> str:
        """What commands are sent as, one of `bridges.messages.COMMAND_TYPES`."""
        return self._link.command_type

    @property
    def commands(self) -> list[tuple[float, Command]]:
        """All that was published since `begin`, with the clock's time of each."""
        return self._commander.sent

    def connect(self) -> None:
        """Finds the robot, and compares its clock with ours.

        Raises:
            TransportError: it is not there.
            BridgeError: it sends no odometry, its clock runs at another speed, or others command
                it.
        """
        self._connected = True
        self._tracker = Tracker(self._rules.guard)  # nothing is known of its clock yet
        try:
            self._link.open(drives=not self._rules.dry_run)
            first = self._await_odometry()
            self._listen(first.received + CLOCK_WINDOW)
            check_clocks(first, self._tracker.newest or first, CLOCK_WINDOW)
            if fault := self._other_driver():  # one that has come meanwhile
                raise BridgeError(fault.detail)
            self._minder.start()
        except BaseException:
            self._connected = False
            self._link.close()
            raise

    def begin(self) -> None:
        """Begins an episode where the robot is now.

        Raises:
            BridgeError: there is no odometry.
            RobotFault: there is none that can be trusted, or it is outside arena or room.
        """
        self.go_on()
        self._await_odometry()
        self._commander.begin()
        self.odometry = self.odometry[-1:]
        if self._rules.from_start:
            self._tracker.start_here()
        if fault := self.check():
            raise RobotFault(fault)

    def go_on(self) -> None:
        """Lets a robot drive again, from rest, that was stopped because nothing was called."""
        self._minder.tick()
        if self._minder.stalled:
            self.stop()
            self._minder.forgive()

    def get_observation(self) -> Observation:
        """The newest pose; NaN and infinitely old if there is none."""
        self._take()
        return Observation(self._tracker.pose(), self._tracker.age(self._clock.now()))

    def send_action(self, action: Sequence[float] | np.ndarray) -> Command:
        """Commands a velocity.

        Args:
            action: linear (m/s) and angular (rad/s) velocity.

        Returns:
            What was really sent now: limited, and not far from what was sent before. `hold` goes on
            toward the action.

        Raises:
            RobotFault: the robot may not be driven on; it was stopped.
        """
        if fault := self.check():
            self.stop()
            raise RobotFault(fault)
        self._commander.aim(action)
        self._minder.watch()
        return self._commander.advance()

    def hold(
        self, until: float, interrupted: Callable[[], str | None] = lambda: None
    ) -> Fault | None:
        """Repeats the command up to a moment, unless something is wrong: then it stops the robot.

        Args:
            until: the clock's time, s.
            interrupted: asked at each tick; a text stops the robot, too.

        Returns:
            Why the robot was stopped before the moment; None if it was not.
        """
        while self._clock.now() < until - SOON:
            self._listen(min(until, self._clock.now() + self._rules.tick))
            reason = interrupted()
            if fault := (Fault("interrupted", reason) if reason else self.check()):
                self.stop()
                return fault
            # at the last moment the next action is sent instead
            if self._commander.is_due() and self._clock.now() < until - SOON:
                self._commander.advance()
        return None

    def check(self) -> Fault | None:
        """Why the robot may not be driven on; None: it may. The first reason since `begin`."""
        self._take()
        if self._minder.stalled:
            most = self._rules.guard.watchdog
            return Fault("stalled", f"the robot was left alone for more than {most:g} s")
        if other := self._other_driver():
            return other
        return self._tracker.check(self._clock.now())

    def stop(self) -> None:
        """Sends zero velocity, several times.

        Raises:
            Exception: the last one could not be sent, whatever has kept it from being sent.
        """
        self._commander.stop()
        self._minder.rest()

    def reset(self) -> None:
        """Has a simulated robot put back to its start.

        Raises:
            BridgeError: it does not go there.
        """
        deadline = self._clock.now() + self._rules.patience
        while self._clock.now() < deadline and self._silent() < GONE * self._rules.patience:
            if not self._rules.dry_run:
                self._link.request_reset()
            self._listen(self._clock.now() + RESET_TAKES)
            shows = self._clock.now() + RESET_SHOWS
            while self._clock.now() < shows - SOON:
                if is_there(self._tracker.newest, self._home):
                    return
                self._listen(min(shows, self._clock.now() + self._rules.tick))
            # the first time it is wherever the reset has brought it
            self._home = self._home or self._tracker.newest
        silent = self._silent()
        raise not_reached(real(self._clock, silent) if silent > self._rules.guard.watchdog else 0)

    def disconnect(self) -> None:
        """Stops the robot, waits until it stands, and disconnects; may be called twice."""
        if not self._connected:
            return
        self._connected = False
        try:
            self.stop()
        finally:
            try:
                self._come_to_rest()
            finally:
                self._minder.end()
                self._link.close()

    def _other_driver(self) -> Fault | None:
        if others := self._link.others():
            return Fault("other driver", f"others command the robot, too: {', '.join(others)}")
        return None

    def _await_odometry(self) -> Odometry:
        self._take()
        self._tracker.forget()
        deadline = self._clock.now() + self._rules.patience
        while self._tracker.newest is None:
            if self._clock.now() > deadline:
                seconds = real(self._clock, self._rules.patience)
                raise BridgeError(f"no odometry came within {seconds:g} s")
            self._listen(self._clock.now() + self._rules.tick)
        return self._tracker.newest

    def _silent(self) -> float:
        """s since any odometry came."""
        return self._clock.now() - self.odometry[-1].received

    def _come_to_rest(self) -> None:
        """Repeats zero velocity until the robot is seen to stand: messages may get lost."""
        began = self._clock.now()
        while not self._rules.dry_run and self._clock.now() < began + RESTS:
            self._listen(self._clock.now() + self._rules.tick)
            newest = self._tracker.newest
            if newest is not None and newest.received > began:
                speeds = (newest.linear, newest.angular)
                if all(abs(x) < most for x, most in zip(speeds, AT_REST, strict=True)):
                    return
            self._commander.stop_again()

    def _listen(self, until: float) -> None:
        """Takes odometry up to a moment."""
        while (left := until - self._clock.now()) > SOON:
            self._link.wait(left)
            self._take()

    def _take(self) -> None:
        self._minder.tick()
        messages = self._link.take()
        self.odometry += messages
        self._tracker.take(messages)
