"""Where results go: a table for people and its numbers, dated, in `benchmarks/results/`."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from emrld_jax.runs.files import write_json, write_text

RESULTS = Path(__file__).parent / "results"


def named(name: str) -> str:
    """The name of a result, with the accelerator that it is of, if it is."""
    device = jax.devices()[0]
    kind = re.sub(r"[^a-z0-9]+", "-", device.device_kind.lower()).strip("-")
    return name if device.platform == "cpu" else f"{name}-{kind}"


def write_record(name: str, record: dict[str, Any], text: str) -> Path:
    """Prints and writes a Markdown table, and beside it a record as JSON; overwrites nothing.

    Returns:
        Their path without an ending.
    """
    RESULTS.mkdir(exist_ok=True)
    first = f"{name}-{datetime.now(UTC):%Y-%m-%d}"
    stems = (first, *(f"{first}_{i}" for i in range(2, 1000)))
    out = next(RESULTS / stem for stem in stems if not (RESULTS / f"{stem}.json").exists())
    write_json(out.with_suffix(".json"), record)
    write_text(out.with_suffix(".md"), text + "\n")
    print(f"{text}\nwrote {out}.json and .md")
    return out
