"""A simulated TurtleBot3 at one end of a transport: commands come in, odometry goes out."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from bridges.messages import STOP, Command, Odometry
from bridges.ros_messages import wrapped
from bridges.simulation.faults import Fault
from bridges.simulation.model import TurtleBot3
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.simulation.state import State
from bridges.transports.base import RobotEnd

RATE_WINDOW = 2.0  # s, over which commands a second are counted
LEAST_VARIANCE = 1e-6  # m^2, rad^2: of odometry without noise, for zero would mean unknown


class SimulatedRobot:
    """Lives by calls of `tick`, by a real clock's loop or as the `tick` of a VirtualClock.

    Args:
        end: its end of a transport, open.
        settings: what it can do and what goes wrong.
        moment: the time at which it begins, in s; its odometry is told from then on.
        stamp: what its odometry's stamps show then, in s; None: the same.

    Raises:
        SettingError: the settings' start is not three numbers.
    """

    def __init__(
        self,
        end: RobotEnd,
        settings: SimulatedRobotSettings,
        moment: float = 0.0,
        stamp: float | None = None,
    ) -> None:
        self._end, self._settings = end, settings
        self.body = TurtleBot3(settings)
        self._begin = self._now = moment
        self._stamps = 0.0 if stamp is None else stamp - moment
        self._fault = Fault(settings.fault)
        self._seen = 0  # poses that odometry was made of
        # What happens by chance: each on its own, so that a loss does not change the noise.
        seeds = np.random.SeedSequence(settings.seed).spawn(3)
        self._noise, self._lose_command, self._lose_odometry = map(np.random.default_rng, seeds)
        self._incoming: deque[tuple[float, Command]] = deque()  # by the moment of their effect
        self._outgoing: deque[tuple[float, Odometry]] = deque()  # of their departure
        self._arrivals: deque[float] = deque()  # of commands, in the last RATE_WINDOW
        self._last_command: float | None = None  # when the last one took effect
        self._driving_since: float | None = None
        self._told: Odometry | None = None
        self.commands = self.lost_commands = 0
        self.odometry = self.lost_odometry = 0
        self.resets = 0

    @property
    def next_odometry(self) -> float:
        """When the next odometry is due, in s; of use to whoever calls `tick`."""
        return self._begin + self._seen / self._settings.odometry_rate

    def tick(self, moment: float) -> None:
        """Lets time pass up to the moment (s), then takes what has come in, then tells odometry."""
        while (event := self._next_event()) <= moment:
            self._pass_until(event)
            if self._incoming and self._incoming[0][0] <= event:
                self._obey(self._incoming.popleft()[1])
            else:
                self._look()
        self._pass_until(moment)
        self._take(moment)
        while self._outgoing and self._outgoing[0][0] <= moment:
            self._tell(self._outgoing.popleft()[1])

    def state(self) -> State:
        """What a spectator may know now."""
        while self._arrivals and self._arrivals[0] <= self._now - RATE_WINDOW:
            self._arrivals.popleft()
        body, last = self.body, self._last_command
        return State(
            moment=self._now - self._begin,
            x=body.x,
            y=body.y,
            theta=body.theta,
            linear=body.linear,
            turning=body.turning,
            moving=body.moving,
            command=body.target,
            since_command=None if last is None else self._now - last,
            timed_out=body.timed_out,
            command_rate=len(self._arrivals) / RATE_WINDOW,
            told=self._told,
            fault=self._settings.fault if self._broken() else None,
            resets=self.resets,
        )

    def _next_event(self) -> float:
        effect = self._incoming[0][0] if self._incoming else math.inf
        return min(effect, self.next_odometry)

    def _pass_until(self, moment: float) -> None:
        self.body.advance(moment - self._now)
        self._now = max(self._now, moment)

    def _take(self, moment: float) -> None:
        """What has come in since the last tick: being put back, then commands."""
        if count := self._end.take_resets():
            self._put_back(count)
        for command in self._end.take_commands():
            self.commands += 1
            self._arrivals.append(moment)
            if self._lose_command.random() < self._settings.command_loss:
                self.lost_commands += 1
            elif self._settings.command_latency:
                self._incoming.append((moment + self._settings.command_latency, command))
            else:
                self._obey(command)

    def _put_back(self, count: int) -> None:
        self.resets += count
        self.body.reset()
        self._incoming.clear()
        self._fault.clear()
        self._driving_since = self._last_command = None

    def _obey(self, command: Command) -> None:
        if not self.body.command(command):
            return
        self._last_command = self._now
        if self._driving_since is None and self.body.target != STOP:
            self._driving_since = self._now

    def _broken(self) -> bool:
        since = self._driving_since
        return (
            self._settings.fault != "none"
            and since is not None
            and self._now - since >= self._settings.fault_after
        )

    def _look(self) -> None:
        """Makes odometry of the pose of this moment."""
        self._seen += 1
        settings, body = self._settings, self.body
        dx, dy, turn = self._noise.standard_normal(3)
        odometry = Odometry(
            stamp=self._now + self._stamps,
            received=self._now,
            x=body.x + settings.position_noise * float(dx),
            y=body.y + settings.position_noise * float(dy),
            theta=wrapped(body.theta + settings.heading_noise * float(turn)),
            linear=body.linear,
            angular=body.turning,
        )
        for told in self._fault.apply(odometry, self._broken()):
            self._outgoing.append((self._now + settings.odometry_latency, told))

    def _tell(self, odometry: Odometry) -> None:
        if self._lose_odometry.random() < self._settings.odometry_loss:
            self.lost_odometry += 1
            return
        settings = self._settings
        position = max(settings.position_noise**2, LEAST_VARIANCE)
        heading = max(settings.heading_noise**2, LEAST_VARIANCE)
        self._end.publish(odometry, (position, position, heading))
        self.odometry += 1
        self._told = odometry
