"""The metrics of a run: one JSON line an iteration, and the same for TensorBoard."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Self

from tensorboardX import SummaryWriter

from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.files import write_text

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

    def sync(self) -> None:
        """Has the system put on disk what was written, before a checkpoint that needs it."""
        os.fsync(self._file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._events.close()


def read_metrics(path: Path) -> list[Record]:
    """All records of a metrics.jsonl, without a last line that was cut off.

    Raises:
        ConfigError: a whole line is not a record; the message names it.
    """
    return [_record(path, i, line) for i, line in enumerate(_whole_lines(path), start=1)]


def last_stage(record: Record) -> int:
    """Number of the last stage of adaptation that a record tells of."""
    return max(int(name.rsplit("_", 1)[1]) for name in record if name.startswith("adapt/return_"))


def _whole_lines(path: Path) -> list[str]:
    if not path.is_file():
        return []
    text = path.read_text(errors="replace")
    return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]


def _record(path: Path, number: int, line: str) -> Record:
    try:
        record = json.loads(line)
    except ValueError as error:
        raise ConfigError(f"{path}, line {number} is not JSON: {error}") from error
    if not isinstance(record, dict) or not isinstance(record.get("iteration"), int):
        raise ConfigError(f"{path}, line {number} is not a record with a whole number 'iteration'")
    return record


def _keep_before(path: Path, start: int) -> None:
    """Drops what was written after the checkpoint that a resumed run starts from."""
    if path.is_file():
        lines = enumerate(_whole_lines(path), start=1)
        kept = [line for i, line in lines if _record(path, i, line)["iteration"] < start]
        write_text(path, "".join(kept))
