"""Files that a command is about to make."""

from __future__ import annotations

import tempfile
from pathlib import Path

from emrld_jax.runs.config import ConfigError


def check_new_npz(out: Path) -> None:
    """Makes the folder of a new .npz file, and refuses a path that it cannot be written to.

    Raises:
        ConfigError: names the file and what is wrong.
    """
    if out.suffix != ".npz":
        raise ConfigError(f"out={out} must end in .npz")
    if out.exists():
        raise ConfigError(f"{out} exists; choose another file with out=PATH")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out.parent):
            pass
    except OSError as error:
        raise ConfigError(f"out={out} cannot be written: {error}") from error
