"""Files that a command is about to make."""

from __future__ import annotations

import tempfile
from pathlib import Path

from emrld_jax.runs.config import ConfigError


def check_new_npz(out: Path) -> None:
    """Refuses a path that a new .npz file cannot be written to, and leaves nothing behind.

    Raises:
        ConfigError: names the file and what is wrong.
    """
    if out.suffix != ".npz":
        raise ConfigError(f"out={out} must end in .npz")
    if out.exists():
        raise ConfigError(f"{out} exists; choose another file with out=PATH")
    existing = next(folder for folder in out.absolute().parents if folder.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise ConfigError(f"out={out}: {existing} cannot be written ({error.strerror})") from error
