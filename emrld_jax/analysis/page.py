"""The report: one self-contained page, with all that it shows inside of it."""

from __future__ import annotations

import json
import math
import os
import shlex
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from emrld_jax import algorithms
from emrld_jax.analysis.comparisons import THRESHOLDS, Comparison, compare
from emrld_jax.analysis.curves import AXES, Curve, curve
from emrld_jax.analysis.groups import (
    DEMOS_FILE,
    Group,
    Grouped,
    compared,
    differing_settings,
    on_each_problem,
)
from emrld_jax.analysis.loading import SPLITS, Run
from emrld_jax.analysis.paths import RUNS_DRAWN, drawn_runs
from emrld_jax.analysis.scores import MEASURES, Cell, Row, adaptations, headline
from emrld_jax.analysis.statistics import RESAMPLES, Estimate
from emrld_jax.runs.files import write_text

PAGE = resources.files("emrld_jax.analysis") / "page"
LINKED = (  # files of a run that the page links to, if they are there
    *("config.yaml", "provenance.json", "metrics.jsonl", "results.json"),
    *("learning_curve.svg", "trajectories.svg", "strides.svg"),
)


def write_report(grouped: Grouped, path: Path, title: str = "Runs compared") -> list[str]:
    """Writes the page, in a folder that is made if need be.

    Its links to the runs' files are relative to where it lies.

    Returns:
        The notes that stand on it: those on the groups, and on episodes that cannot be drawn.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    data = report_data(grouped, path, title)
    write_text(path, page(data))
    return data["notes"]


def page(data: dict[str, Any]) -> str:
    """The page with its data, styles and program inside."""
    parts = {
        "/*STYLE*/": (PAGE / "page.css").read_text(),
        "/*PROGRAM*/": "".join((PAGE / f"{name}.js").read_text() for name in PROGRAM),
        "/*DATA*/": embedded(data),  # last: nothing is put into what comes from files
    }
    text = (PAGE / "page.html").read_text()
    for mark, content in parts.items():
        text = text.replace(mark, content, 1)
    return text


PROGRAM = ("basics", "plots", "tables", "paths", "page")  # its files, in order


def embedded(data: Any) -> str:
    """JSON that cannot end the script element it stands in, whatever its texts say."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def report_data(grouped: Grouped, path: Path, title: str) -> dict[str, Any]:
    """All that the page shows, as JSON values."""
    groups = grouped.groups
    rows = headline(groups)
    drawn, notes = drawn_runs(groups)
    names = differing_settings([group.runs[0] for group in groups])
    settings = [compared(group.runs[0]) for group in groups]
    every = dict.fromkeys(name for own in settings for name in own)
    return {
        "title": title,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "resamples": RESAMPLES,
        "notes": [*grouped.notes, *notes],
        "skipped": [{"path": str(s.path), "reason": s.reason} for s in grouped.skipped],
        "groups": [_group(group, row, groups) for group, row in zip(groups, rows, strict=True)],
        "comparisons": [
            _comparison(comparison)
            for measure in MEASURES
            for split in SPLITS[::-1]
            for comparison in compare(groups, split, measure)
        ],
        "thresholds": _numbers(THRESHOLDS),
        "settings": [
            {
                "name": name,
                "differs": name in names,
                "values": [_shown(own[name]) if name in own else None for own in settings],
            }
            for name in sorted(every, key=lambda name: (name == DEMOS_FILE, "." in name, name))
        ],
        "runs": [
            _run(number, run, path) for number, group in enumerate(groups) for run in group.runs
        ],
        "drawn": drawn,
        "runsDrawn": RUNS_DRAWN,
    }


def _group(group: Group, row: Row, groups: Sequence[Group]) -> dict[str, Any]:
    plain = algorithms.starts_plain(group.algorithm)
    return {
        "problems": [
            ", ".join(own.problem) for own in on_each_problem(groups) if own.runs is group.runs
        ],
        "environment": group.environment,
        "demonstrations": group.demonstrations,
        "label": group.label,
        "seeds": list(group.seeds),
        "commits": list(group.commits),
        "cells": {"/".join(names): _cell(cell) for names, cell in row.cells.items()},
        "demonstrated": {split: _number(x) for split, x in row.demonstrated.items()},
        "seconds": _number(row.seconds),
        "envSteps": _number(row.env_steps),
        "iterations": group.runs[0].settings["meta.iterations"],
        "curves": {
            against: {
                f"{measure}/{when}": _curve(curve(group, measure, when, against))
                for measure in MEASURES
                for when in ("before", "after")
                if plain or when == "after"
            }
            for against in AXES
        },
        "adaptation": [
            {
                "split": found.split,
                "source": found.source,
                "steps": found.steps,
                "cells": {name: [_cell(c) for c in cells] for name, cells in found.cells.items()},
            }
            for found in adaptations(group)
        ],
    }


def _comparison(found: Comparison) -> dict[str, Any]:
    return {
        "problems": [", ".join(problem) for problem in found.problems],
        "split": found.split,
        "measure": found.measure,
        "references": {name: _number(value) for name, value in found.references.items()},
        "competitors": [
            {
                "label": own.label,
                "seeds": list(own.seeds),
                "score": _estimate(own.score),
                "profile": _estimate(own.profile),
            }
            for own in found.competitors
        ],
        "improvements": [
            {"first": own.first, "second": own.second, **_estimate(own.probability)}
            for own in found.improvements
        ],
    }


def _run(number: int, run: Run, page_path: Path) -> dict[str, Any]:
    record = run.provenance
    machine, packages = record.get("machine", {}), record["packages"]
    return {
        "group": number,
        "seed": run.seed,
        "path": str(run.path),
        "time": str(record.get("time", "")),
        "command": str(record.get("command", "")),
        "commits": list(run.commits),
        "resumed": len(record["resumed"]),
        "seconds": _number(run.seconds),
        "machine": ", ".join(
            str(machine[name]) for name in ("cpu", "device", "platform") if machine.get(name)
        ),
        "versions": f"Python {record.get('python', '?')}, "
        + ", ".join(f"{name} {version}" for name, version in packages.items()),
        "files": [{"name": name, "link": link} for name, link in _links(run, page_path)],
    }


def _links(run: Run, page_path: Path) -> Sequence[tuple[str, str]]:
    """Names and relative links of the run's files."""
    there = [name for name in LINKED if (run.path / name).is_file()]
    there += [f"evaluations/{name}/evaluation.json" for name in run.evaluations]
    folder = os.path.relpath(run.path.resolve(), page_path.resolve().parent)
    return [(name, "./" + quote(f"{folder}/{name}")) for name in there]


def _curve(found: Curve) -> dict[str, Any]:
    return {
        "x": _numbers(found.x),
        **_estimate(Estimate(found.value, found.low, found.high)),
        "each": [_numbers(own) for own in found.each],
    }


def _cell(found: Cell) -> dict[str, Any]:
    return {**_estimate(found.estimate), "seeds": found.seeds}


def _estimate(found: Estimate) -> dict[str, Any]:
    convert = _numbers if np.ndim(found.value) else _number
    return {name: convert(value) for name, value in found._asdict().items()}


def _numbers(values: np.ndarray) -> list[float | int | None]:
    return [_number(value) for value in values]


def _number(value: Any) -> float | int | None:
    """Five digits: a page of many curves must stay small. None for what is not finite."""
    if not math.isfinite(value):
        return None
    short = float(f"{float(value):.5g}")
    return int(short) if short.is_integer() else short


def _shown(value: Any) -> str:
    """A setting as the command line takes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value).replace(" ", "") if isinstance(value, list) else str(value)


def default_title(folders: Sequence[str]) -> str:
    """A title that says which folders were read."""
    return f"Runs in {shlex.join(folders)}"
