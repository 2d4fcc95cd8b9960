"""Files that exist as a whole or not at all, also when the process is killed while it writes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


def write_text(path: Path, text: str) -> None:
    """Writes a text into a file beside `path` and puts that in its place."""
    partial = path.with_name(f"{path.name}.partial")
    partial.write_text(text)
    os.replace(partial, path)


def write_json(path: Path, value: Any) -> None:
    """Writes JSON, as `write_text` does."""
    write_text(path, json.dumps(value, indent=2) + "\n")
