"""The metrics of a run: one JSON line an iteration, and the same for TensorBoard."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Self

from tensorboardX import SummaryWriter

Record = dict[str, Any]  # "iteration" and "<phase>/<name>"


class MetricsLog:
    """Appends records; `start` is the iteration of the first."""

    def __init__(self, lines: Path, tensorboard: Path, start: int) -> None:
        _keep_before(lines, start)
        self._file = lines.open("a", buffering=1)  # a line is on its way as soon as it is whole
        # events of iterations that are done again are hidden
        self._events = SummaryWriter(str(tensorboard), purge_step=start)

    def write(self, record: Record) -> None:
        self._file.write(json.dumps(record, allow_nan=False) + "\n")
        for name, value in record.items():
            if "/" in name:
                self._events.add_scalar(name, value, record["iteration"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._events.close()


def read_metrics(path: Path) -> list[Record]:
    """All records of a metrics.jsonl, without a last line that was cut off."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in _whole_lines(path)]


def _whole_lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]


def _keep_before(path: Path, start: int) -> None:
    """Drops what was written after the checkpoint that a resumed run starts from."""
    if path.is_file():
        kept = [line for line in _whole_lines(path) if json.loads(line)["iteration"] < start]
        path.write_text("".join(kept))
