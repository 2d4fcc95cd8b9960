"""Where results go: a table for people and its numbers, dated, in `benchmarks/results/`."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def write_record(name: str, record: dict[str, Any], text: str) -> None:
    """Prints and writes a Markdown table, and beside it a record as JSON."""
    RESULTS.mkdir(exist_ok=True)
    out = RESULTS / f"{name}-{datetime.now(UTC):%Y-%m-%d}"
    out.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
    out.with_suffix(".md").write_text(text + "\n")
    print(f"{text}\nwrote {out}.json and .md")
