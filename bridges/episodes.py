"""What is known of an episode that a robot drove."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bridges.messages import Command, Odometry

SUCCESS, ARENA, HORIZON = "success", "arena", "horizon"
WHOLE = (SUCCESS, ARENA, HORIZON)  # as the environment ends episodes; others were broken off


class Step(NamedTuple):
    """One control step."""

    time: float  # s of the clock, when the command was sent
    obs: np.ndarray  # [3] float32: x (m), y (m), theta (rad), before the action
    action: np.ndarray  # [2] float32, policy units, as sampled
    command: Command  # that was sent first; later ones of the step go on toward the action
    log_prob: float  # of the action, as the mean over its dimensions
    reward: float  # after the action
    done: bool  # the environment's rules end the episode here
    success: bool
    age: float  # s, how old the odometry was when the command was sent
    latency: float  # s from the moment that the command was due


class Episode(NamedTuple):
    """One episode."""

    began: float  # s of the clock
    began_wall: int  # ns since 1970, when it began
    steps: Sequence[Step]
    last_pose: np.ndarray  # [3] float32, after the last step, or where it was broken off
    ending: str  # one of WHOLE, or why it was broken off
    detail: str  # of the ending, for people; may be empty
    missed: int  # control steps whose command was late by more than a tick
    odometry: Sequence[Odometry]  # all that arrived
    commands: Sequence[tuple[float, Command]]  # all that was sent, with the clock's time

    @property
    def whole(self) -> bool:
        """Whether it ended as episodes of the environment end, so that it can be learned from."""
        return self.ending in WHOLE and len(self.steps) > 0
