"""Where a reset brings a simulated robot, and what is wrong when it does not get there."""

from __future__ import annotations

import math

from bridges.messages import BridgeError, Odometry
from bridges.safety import wrapped

SAME_PLACE = (0.1, 0.2)  # m and rad that a robot may be off its start after a reset


def is_there(here: Odometry | None, home: Odometry | None) -> bool:
    """Whether a robot is where a reset has brought it before; unknown places are none."""
    if here is None or home is None:
        return False
    way = math.hypot(here.x - home.x, here.y - home.y)
    turn = abs(wrapped(here.theta - home.theta))
    return way < SAME_PLACE[0] and turn < SAME_PLACE[1]


def not_reached(silent: float) -> BridgeError:
    """The error of a robot that does not get there and still tells where it is, or does not.

    Args:
        silent: real s since its last odometry; 0: it goes on.
    """
    if silent > 0:
        return BridgeError(
            f"no odometry has come for {silent:.0f} s, so the robot is not put back: its process "
            "has ended, or the network is gone"
        )
    return BridgeError(
        "the robot did not go back to its start: reset=service is for simulated robots"
    )
