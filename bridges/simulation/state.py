"""What a spectator of a simulated robot sees, and the words for it."""

from __future__ import annotations

from typing import NamedTuple

from bridges.messages import Command, Odometry

SILENCE = 1.5  # s without a command after which nobody seems to be there

WORDS = {
    "timeout": "stopped by its command timeout",
    "driving": "driving",
    "standing": "told to stand",
    "nobody": "no bridge seen",
}


class State(NamedTuple):
    """A simulated robot at a moment."""

    moment: float  # s since it began
    x: float  # m, as it really is
    y: float  # m
    theta: float  # rad, not wrapped
    linear: float  # m/s, as it really is
    turning: float  # rad/s, drift included
    moving: bool
    command: Command  # what the velocities go to
    since_command: float | None  # s since the last one took effect; None: none since the start
    timed_out: bool
    command_rate: float  # commands a second that come in
    told: Odometry | None  # the last odometry that went out
    fault: str | None  # of odometry, if it has begun
    resets: int

    @property
    def doing(self) -> str:
        """What it is doing: one of timeout, driving, standing, nobody."""
        if self.timed_out:
            return "timeout"
        if self.moving:
            return "driving"
        if self.since_command is None or self.since_command > SILENCE:
            return "nobody"
        return "standing"

    @property
    def mood(self) -> str:
        """The same, but `fault` if there is one."""
        return self.doing if self.fault is None else "fault"

    @property
    def words(self) -> str:
        """Both for people."""
        doing = WORDS[self.doing]
        return doing if self.fault is None else f"{doing}; fault in odometry: {self.fault}"
