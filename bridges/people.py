"""What whoever runs a robot is asked and told."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from bridges.bundle import Zone
from bridges.episodes import Episode
from bridges.messages import BridgeError
from bridges.summary import line
from bridges.task import distance_to_goal
from bridges.world import Drivable

Ask = Callable[[str], None]  # puts a question, returns when somebody lets it go on

STILL = 0.05  # m from its start within which a robot stands, as far as anybody can tell
SHOW_EVERY = 0.1  # real s at least between changes of the line


def ask(question: str) -> None:
    """Waits for ENTER.

    Raises:
        BridgeError: there is nobody to ask.
    """
    print(f"{question}\nENTER goes on, Ctrl-C ends: ", end="", flush=True)
    try:
        input()
    except EOFError as error:
        raise BridgeError(
            "there is nobody to ask (no terminal): --yes lets the robot move, and reset=service "
            "puts a simulated one back"
        ) from error


def confirm_motion(bundle: Drivable, zone: Zone) -> str:
    """The question before a robot moves for the first time."""
    x, y = zone.goal
    side = "left" if y >= 0 else "right"
    room = "" if zone.arena is None else f", and stays within {zone.arena:g} m of it each way"
    return (
        f"The robot is going to drive, at up to {bundle.action.high[0]:g} m/s. It starts where it "
        f"stands now{room}. Its goal is {x:.2f} m ahead and {abs(y):.2f} m to the {side}. Is the "
        "floor free?"
    )


def stood_still(episode: Episode) -> bool:
    """Whether a robot stayed where it was for a whole episode."""
    points = np.array([*(step.obs for step in episode.steps), episode.last_pose])[:, :2]
    return episode.whole and bool(np.max(np.hypot(*(points - points[0]).T)) < STILL)


class Progress:
    """A line that changes while a robot drives, on a terminal, and one for each episode.

    Args:
        what: what is driven, for people.
        of: how many whole episodes there shall be.
        zone: the task's.
        period: s a control step.
        virtual: the robot takes no time, so nobody waits for an episode's end.
    """

    def __init__(
        self, what: str, of: int, zone: Zone, period: float, virtual: bool = False
    ) -> None:
        self._what, self._of, self._zone, self._period = what, of, zone, period
        self._virtual = virtual
        self._live = sys.stdout.isatty()
        self._shown = -SHOW_EVERY
        self._done = 0

    def begin(self, done: int) -> None:
        """An episode begins, after `done` whole ones."""
        self._done = done
        if not self._virtual:
            most = self._zone.horizon * self._period
            print(
                f"{self._what}: episode {done + 1} of {self._of} begins, at most {most:g} s",
                flush=True,
            )

    def show(self, episode: Episode) -> None:
        """Shows how far the episode has come."""
        if not self._live or time.monotonic() - self._shown < SHOW_EVERY:
            return
        self._shown = time.monotonic()
        print(f"\r\x1b[2K{self._status(episode)}", end="", flush=True)

    def end(self, episode: Episode) -> None:
        """Tells how an episode ended."""
        start = "\r\x1b[2K" if self._live else ""
        print(f"{start}{self._what}: {self._ended(episode)}", flush=True)

    def _status(self, episode: Episode) -> str:
        steps, horizon = len(episode.steps), self._zone.horizon
        left = (horizon - steps + (self._of - self._done - 1) * horizon) * self._period
        successes = "".join(" success" for step in episode.steps if step.success)
        x, y = (float(value) for value in episode.last_pose[:2])
        return (
            f"{self._what}: episode {self._done + 1} of {self._of}, step {steps} of {horizon}, at "
            f"most {left:.0f} s left, return {sum(step.reward for step in episode.steps):.1f}"
            f"{successes}, {distance_to_goal(self._zone, x, y):.2f} m from the goal, missed "
            f"deadlines {episode.missed}"
        )

    def _ended(self, episode: Episode) -> str:
        return line(self._done + 1, self._of, episode, self._period)
