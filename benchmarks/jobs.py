"""Training runs for tables, carried out side by side."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.records import write_record
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import Record, read_metrics
from emrld_jax.study.programs import Program
from emrld_jax.study.running import run_all


def job(
    runs: Path, env: str, demos: str, algo: str, seed: int, settings: tuple[str, ...] = ()
) -> Program:
    """One training run of `emrld_jax.train`."""
    return Program(runs, env, demos, algo, (seed,), settings)


def results(own: Program) -> dict[str, Any]:
    """What the final evaluation found, of a program of one run."""
    return results_of(own.folders[0])


def results_of(folder: RunFolder) -> dict[str, Any]:
    """What a run's final evaluation found."""
    found: dict[str, Any] = json.loads(folder.results.read_text())
    return found


def metrics(own: Program) -> list[Record]:
    """One record an iteration."""
    return read_metrics(own.folders[0].metrics)


def train_all(jobs: Sequence[Program]) -> None:
    """Trains what is not finished, and tells of each that ends.

    Raises:
        SystemExit: it was stopped.
    """
    seen: list[Program] = []

    def watch(going: Sequence[Program], seconds: float) -> None:
        for own in [own for own in seen if own not in going]:
            seen.remove(own)
            print(f"{own.folders[0].path}: ended after {seconds:.0f} s in all", flush=True)
        seen.extend(own for own in going if own not in seen)

    outcome = run_all(jobs, watch)
    for own, log in outcome.failed:
        print(f"{own.folders[0].path}: failed, see {log}", flush=True)
    if outcome.exit_code:
        raise SystemExit(outcome.exit_code)


def write_results(
    name: str, jobs: Sequence[Program], rows: Sequence[dict[str, Any]], text: str
) -> None:
    """Writes a table and its numbers with where they come from into `benchmarks/results/`."""
    if not jobs:
        raise SystemExit("no run is finished yet")
    module = f"benchmarks.{Path(sys.argv[0]).stem}"
    origins = [json.loads(own.folders[0].provenance.read_text()) for own in jobs]
    record = {
        "command": shlex.join(["python", "-m", module, *sys.argv[1:]]),
        "code": [dict(code) for code in {tuple(sorted(o["code"].items())) for o in origins}],
        "packages": origins[0]["packages"],
        "machine": origins[0]["machine"],
        "training_s": sum(r["time/iteration_s"] for own in jobs for r in metrics(own)),
        "rows": rows,
    }
    write_record(name, record, text)
