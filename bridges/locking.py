"""A folder that one command writes to at a time."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bridges.messages import BridgeError


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other commands off a folder; one that stays empty is removed at the end.

    The system unlocks it when the process ends, however it does.

    Raises:
        BridgeError: another command has locked it.
        OSError: it cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BridgeError(
                f"another command is writing to {folder}: wait for its end, or choose another out="
            ) from error
        try:
            yield
        finally:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
    finally:
        os.close(handle)
