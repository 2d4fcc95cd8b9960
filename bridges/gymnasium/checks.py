"""What Gymnasium's callers may ask for, and what they are told about it; without JAX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

MODES = ("rgb_array",)
METADATA: dict[str, Any] = {"render_modes": [*MODES], "render_fps": 10}


def check_mode(mode: str | None) -> None:
    """Refuses a render mode that there is not.

    Raises:
        ValueError: names it.
    """
    if mode is not None and mode not in MODES:
        raise ValueError(f"render_mode={mode!r} is unknown; there is {', '.join(MODES)}, and None")


def check_options(options: Mapping[str, Any] | None, allowed: Sequence[str]) -> dict[str, Any]:
    """The options of a reset.

    Raises:
        ValueError: there is one that means nothing.
    """
    known = dict(options or {})
    if wrong := sorted(set(known) - set(allowed)):
        raise ValueError(
            f"option {wrong[0]!r} of reset is unknown (there are: {', '.join(allowed) or 'none'})"
        )
    return known


def checked_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An action, or a batch of them, float32.

    Raises:
        ValueError: it has another shape, or is not finite.
    """
    numbers = np.asarray(action, np.float32)
    if numbers.shape != shape:
        raise ValueError(f"an action of shape {numbers.shape} is not allowed: it must be {shape}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"the action {action} is not finite")
    return numbers
