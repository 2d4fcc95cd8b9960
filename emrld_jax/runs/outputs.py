"""Files that a command is about to make."""

from __future__ import annotations

import tempfile
from pathlib import Path

from emrld_jax.runs.config import ConfigError


def check_new(out: Path, *endings: str) -> None:
    """Refuses a path that a new file with such an ending cannot be written to; leaves nothing.

    Raises:
        ConfigError: names the file and what is wrong.
    """
    if out.suffix not in endings:
        raise ConfigError(f"out={out} must end in {' or '.join(endings)}")
    if out.exists():
        raise ConfigError(f"{out} exists; choose another file with out=PATH")
    existing = next(folder for folder in out.absolute().parents if folder.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise ConfigError(f"out={out}: {existing} cannot be written ({error.strerror})") from error
