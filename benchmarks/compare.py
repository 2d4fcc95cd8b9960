"""Two results of `benchmarks.throughput` compared: `python -m benchmarks.compare A.json B.json`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np


def table(a: dict[str, Any], b: dict[str, Any]) -> str:
    """Medians of what both have measured, and B's over A's, as Markdown."""
    first = {row["what"]: row for row in a["rows"]}
    lines = ["| what | A | B | B / A | |", "|---|---|---|---|---|"]
    for row in b["rows"]:
        if row["what"] in first:
            x, y = (float(np.median(r["values"])) for r in (first[row["what"]], row))
            ratio = f"{y / x:.2f}" if x else ""
            lines.append(f"| {row['what']} | {x:.4g} | {y:.4g} | {ratio} | {row['unit']} |")
    return "\n".join(lines)


def main() -> None:
    """Reads both and prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__)
    parser.add_argument("a", type=Path, help="a result, such as benchmarks/results/NAME.json")
    parser.add_argument("b", type=Path, help="another one, whose values are divided by a's")
    options = parser.parse_args()
    try:
        a, b = (json.loads(path.read_text()) for path in (options.a, options.b))
    except (OSError, ValueError) as error:
        parser.error(str(error))
    for name, record in (("A", a), ("B", b)):
        machine = record["machine"]
        where = f"{machine['cores']} x {machine['cpu']}"
        print(f"{name}: {record['command']}, commit {record['code']['commit'][:7]}, {where}")
    print(table(a, b))


if __name__ == "__main__":
    main()
