"""What benchmarks of speed share: repeated timings, and a table of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np


class Row(NamedTuple):
    """A measurement: what, in which unit, and a value a repetition."""

    what: str
    unit: str
    values: list[float]


def seconds(call: Callable[[], Any], repetitions: int) -> np.ndarray:
    """Wall-clock times of a call, after one that compiles and one that warms up."""
    times = []
    for _ in range(repetitions + 2):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return np.array(times[2:])


def rate(what: str, unit: str, amount: float, times: np.ndarray) -> Row:
    """An amount over times in s."""
    return Row(what, unit, [float(amount / t) for t in times])


def duration(what: str, times: np.ndarray) -> Row:
    """Times in s, as ms."""
    return Row(what, "ms", [float(1e3 * t) for t in times])


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    return "\n".join(["| what | median | range | |", "|---|---|---|---|", body(rows)])


def body(rows: list[Row]) -> str:
    """The rows without the table's head."""
    lines = []
    for row in rows:
        span = f"{min(row.values):.4g} to {max(row.values):.4g}" if len(row.values) > 1 else ""
        lines.append(f"| {row.what} | {np.median(row.values):.4g} | {span} | {row.unit} |")
    return "\n".join(lines)
