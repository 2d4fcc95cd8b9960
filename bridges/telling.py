"""What a command tells at its end of all that is in its folder."""

from __future__ import annotations

import json
from pathlib import Path

from bridges import bundle
from bridges.bundle import Bundle
from bridges.files import write_bytes
from bridges.kept import ADAPTED, EXECUTION
from bridges.picture import draw
from bridges.recording import Recording, read
from bridges.recording_checks import INDEX
from bridges.summary import summarized, table


def tell(out: Path, first: Bundle) -> None:
    """Writes and prints the summary of a folder's recordings, and draws them.

    Args:
        out: the folder.
        first: the bundle that the command was given.

    Raises:
        BridgeError: a recording is damaged.
        OSError: nothing can be written.
    """
    folders = [path for path in out.iterdir() if (path / INDEX).is_file()]
    folders.sort(key=lambda path: (path.name == EXECUTION, path.name))
    recordings = {path.name: read(path) for path in folders}
    summaries = {name: summarized(recording) for name, recording in recordings.items()}
    for name, summary in summaries.items():
        print(f"\n{name}\n{table(summary)}")
    told = {
        "environment": first.environment.name,
        "task": first.task,
        "algorithm": first.algorithm,
        "control_period_s": first.control_period,
        "recordings": summaries,
    }
    write_bytes(out / "summary.json", (json.dumps(told, indent=2) + "\n").encode())
    titled = {_title(out, first, name, r): r for name, r in recordings.items()}
    drawn = bool(titled) and draw(first, titled, out / "paths")
    picture = "paths.png and paths.svg" if drawn else "no picture, for matplotlib is missing"
    print(f"\n{out}: summary.json, {picture}", flush=True)


def _title(out: Path, first: Bundle, name: str, recording: Recording) -> str:
    """What a recording is, for people."""
    path = out / ADAPTED
    known = [first, *([bundle.read(path)] if path.is_file() else [])]
    after = {one.content_sha256 for one in known if one.stage.adapted}
    if recording.header.bundle in after:
        return "after adaptation"
    return "before adaptation" if name == "recording_0" else name
