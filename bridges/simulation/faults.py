"""Odometry that goes wrong on purpose, to test what relies on it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bridges.messages import Odometry

FAULTS = ("none", "silent", "freeze", "nan", "jump", "out_of_order")
JUMP = 1.0  # m


class Fault:
    """One kind of fault, which odometry passes through once it has begun.

    Args:
        kind: one of FAULTS.
    """

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._last: Odometry | None = None  # of what was told before the fault began
        self._held: Odometry | None = None  # of a pair to be swapped, the first one

    def clear(self) -> None:
        """Begins anew, as if nothing had ever been wrong."""
        self._last = self._held = None

    def apply(self, odometry: Odometry, broken: bool) -> Sequence[Odometry]:
        """What is told in place of the odometry; `broken` says whether the fault has begun."""
        if not broken or self._kind == "none":
            self._last = odometry
            return [odometry]
        match self._kind:
            case "silent":
                return []
            case "freeze":
                return [self._last or odometry]
            case "nan":
                return [odometry._replace(x=math.nan, y=math.nan, theta=math.nan)]
            case "jump":
                return [odometry._replace(x=odometry.x + JUMP)]
            case _:
                return self._swapped(odometry)

    def _swapped(self, odometry: Odometry) -> Sequence[Odometry]:
        if self._held is None:
            self._held = odometry
            return []
        first, self._held = self._held, None
        return [odometry, first]
