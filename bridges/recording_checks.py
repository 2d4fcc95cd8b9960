"""What the index of a recording must say, and what must be true of its episodes."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bridges.episodes import ARENA, HORIZON, SUCCESS, WHOLE, Episode
from bridges.messages import BridgeError

FORMAT = "emrld-recording"
VERSION = 1
INDEX = "index.json"

_KINDS: dict[str, Any] = {
    "bundle": str,
    "environment": str,
    "task": dict,
    "control_period": (float, int),
    "horizon": int,
    "noise": bool,
    "dry_run": bool,
    "command_type": str,
    "driving": dict,
}
_ENTRY = {"bag", "sha256", "ending", "steps"}


class RecordingError(BridgeError):
    """A recording is refused; the message names it and says why."""


def read_index(folder: Path) -> dict[str, Any]:
    """The index of a recording's folder.

    Raises:
        RecordingError: there is none, or it is not as it must be.
    """
    path = folder / INDEX
    if not path.is_file():
        raise RecordingError(f"{folder} is no recording: it has no {INDEX}")
    try:
        index = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path} is not JSON ({error})") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise RecordingError(f"{path} does not say format {FORMAT!r}")
    if index.get("version") != VERSION:
        raise RecordingError(
            f"{path} has version {index.get('version')!r}; version {VERSION} is read"
        )
    for name, kind in {**_KINDS, "episodes": list}.items():
        if type(index.get(name)) not in (kind if isinstance(kind, tuple) else (kind,)):
            raise RecordingError(f"{path}: {name} is missing, or of another type")
    for number, entry in enumerate(index["episodes"]):
        if not isinstance(entry, dict) or not entry.keys() >= _ENTRY:
            raise RecordingError(f"{path}: episodes[{number}] lacks one of {', '.join(_ENTRY)}")
        if entry["bag"] != f"episode_{number:03d}":
            raise RecordingError(f"{path}: episodes[{number}] is in bag {entry['bag']!r}")
    return index


def problem_of(episode: Episode, horizon: int) -> str | None:
    """What cannot be true of a recorded episode; None: nothing."""
    steps = episode.steps
    if len(steps) > horizon:
        return f"it has {len(steps)} steps; at most {horizon} are allowed"
    if not np.isfinite(episode.last_pose).all() and episode.ending in WHOLE:
        return "its last pose is not finite"
    if any(b.time <= a.time for a, b in pairwise(steps)):
        return "its steps are not in the order of time"
    if any(step.done or step.success for step in steps[:-1]):
        return "it goes on after a step that ends it"
    last = steps[-1] if steps else None
    ends = (last is not None and last.done, last is not None and last.success)
    expected = {SUCCESS: (True, True), ARENA: (True, False)}.get(episode.ending, (False, False))
    if last is None and episode.ending == ARENA:
        expected = (False, False)  # it was outside before it could act
    if ends != expected or (episode.ending == HORIZON and len(steps) != horizon):
        return f"its last step does not end in {episode.ending!r}"
    return None
