"""The paths that a page draws: of this episode and of some before."""

from __future__ import annotations

import math
from typing import Any

from bridges.simulation.state import State

STEP = 0.005  # m between points
MOST_POINTS = 3000  # of a path; then every second one is forgotten
MOST_PATHS = 12  # that are kept of earlier episodes

Point = list[float | None]  # x, y, and, if odometry says otherwise, its x and y


class Trace:
    """Where the robot has been; being put back begins a new path.

    Args:
        noisy: odometry differs from the truth, so both are kept.

    Attributes:
        path: this episode's.
        earlier: those before it, oldest first.
        revision: grows when anything but new points at the path's end has changed.
    """

    def __init__(self, noisy: bool) -> None:
        self.path: list[Point] = []
        self.earlier: list[list[Point]] = []
        self.revision = 0
        self._noisy = noisy
        self._resets = 0
        self._last = (math.inf, math.inf)

    def add(self, state: State) -> None:
        """Adds where the robot is now, if it has moved."""
        if state.resets != self._resets:
            self._resets = state.resets
            self._begin()
        place = (state.x, state.y)
        if math.dist(self._last, place) < STEP:
            return
        self._last = place
        self.path.append(self._point(state))
        if len(self.path) > MOST_POINTS:
            self.path = self.path[::2]
            self.revision += 1

    def drawing(self) -> dict[str, Any]:
        """All of it, for a page that opens."""
        return {"revision": self.revision, "path": self.path, "earlier": self.earlier}

    def _begin(self) -> None:
        if len(self.path) > 1:
            self.earlier = [*self.earlier, self.path][-MOST_PATHS:]
        self.path = []
        self._last = (math.inf, math.inf)
        self.revision += 1

    def _point(self, state: State) -> Point:
        true: Point = [round(state.x, 4), round(state.y, 4)]
        if state.told is None or not (self._noisy or state.fault):
            return true
        return [*true, number(state.told.x, 4), number(state.told.y, 4)]


def number(value: float, digits: int) -> float | None:
    """The value as JSON can say it: rounded; None if it is none."""
    return round(value, digits) if math.isfinite(value) else None
