"""The README's table: trains every algorithm on every environment with the shipped defaults.

`python -m benchmarks.targets` runs what is not finished yet, several runs side by side (one core
each), and writes the table with commit, machine and total compute into `benchmarks/results/`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import numpy as np

from emrld_jax.runs.metrics import read_metrics

ENVIRONMENTS = ("point2d", "two_wheeled", "two_wheeled_drift")
ROWS = (
    ("optimal", "emrld"),
    ("optimal", "emrld_ws"),
    ("suboptimal", "emrld"),
    ("suboptimal", "emrld_ws"),
    ("optimal", "maml"),  # which takes no demonstrations
)
RESULTS = Path(__file__).parent / "results"


class Job(NamedTuple):
    """One training run."""

    env: str
    demos: str
    algo: str
    seed: int

    def folder(self, runs: Path) -> Path:
        """Where `emrld_jax.train` puts it."""
        return runs / self.env / f"{self.algo}-{self.demos}" / f"seed{self.seed}"

    def finished(self, runs: Path) -> bool:
        return (self.folder(runs) / "results.json").is_file()

    def command(self, runs: Path) -> list[str]:
        """The command line that runs or continues it."""
        train = [sys.executable, "-m", "emrld_jax.train"]
        if self.folder(runs).exists():
            return [*train, f"resume={self.folder(runs)}"]
        settings = (f"env={self.env}", f"demos={self.demos}", f"algo={self.algo}")
        return [*train, *settings, f"seed={self.seed}", f"runs={runs}"]


def run_all(jobs: Sequence[Job], runs: Path) -> None:
    """Runs the jobs that are not finished, one a core at a time."""
    cores: Queue[int] = Queue()
    for core in sorted(os.sched_getaffinity(0)):
        cores.put(core)
    threads = os.environ | {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}

    def run(job: Job) -> None:
        core = cores.get()
        log = runs / "logs" / f"{job.env}-{job.algo}-{job.demos}-{job.seed}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        pin = ["taskset", "-c", str(core)]
        with log.open("a") as stream:
            done = subprocess.run(
                [*pin, *job.command(runs)],
                check=False,
                env=threads,
                stdout=stream,
                stderr=stream,
            )
        cores.put(core)
        print(
            f"{job.folder(runs)}: {'done' if done.returncode == 0 else f'failed, see {log}'}",
            flush=True,
        )

    with ThreadPoolExecutor(cores.qsize()) as pool:
        list(pool.map(run, [job for job in jobs if not job.finished(runs)]))


def summarize(jobs: Sequence[Job], runs: Path) -> dict[str, Any]:
    """Means over the finished seeds of one row, and the range of the training tasks' return."""
    finished = [job.folder(runs) for job in jobs if job.finished(runs)]
    results = [json.loads((folder / "results.json").read_text()) for folder in finished]
    seconds = [
        sum(r["time/iteration_s"] for r in read_metrics(f / "metrics.jsonl")) for f in finished
    ]

    def figure(split: str, name: str) -> list[float]:
        return [result[split]["stages"][-1][name] for result in results]

    return {
        "seeds": len(finished),
        "demonstrations": float(np.mean([r["train"]["demonstrations"]["return"] for r in results])),
        "return": figure("train", "return"),
        "success": figure("train", "success"),
        "held_out_return": figure("test", "return"),
        "held_out_success": figure("test", "success"),
        "iterations": len(read_metrics(finished[0] / "metrics.jsonl")),
        "training_s": float(np.mean(seconds)),
    }


def table(rows: dict[tuple[str, str, str], dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| environment, demonstrations (their return) | algorithm | return, training tasks "
        "| success | return, held-out tasks | success | meta-iterations | training |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (env, demos, algo), row in rows.items():
        source = "no demonstrations" if algo == "maml" else f"{demos} ({row['demonstrations']:.1f})"
        spread = (
            f"{np.mean(row['return']):.1f} ({min(row['return']):.1f} to {max(row['return']):.1f})"
        )
        held = row["held_out_return"]
        lines.append(
            f"| {env}, {source} | {algo} | {spread} | {np.mean(row['success']):.0%} "
            f"| {np.mean(held):.1f} ({min(held):.1f} to {max(held):.1f}) "
            f"| {np.mean(row['held_out_success']):.0%} | {row['iterations']} "
            f"| {row['training_s']:.0f} s |"
        )
    return "\n".join(lines)


def main() -> None:
    """Runs what is missing and writes the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.targets", description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the run folders")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--env", nargs="+", default=ENVIRONMENTS, choices=ENVIRONMENTS)
    parser.add_argument("--table", action="store_true", help="only tabulate what is finished")
    options = parser.parse_args()
    rows = {
        (env, *row): [Job(env, *row, seed) for seed in options.seeds]
        for env in options.env
        for row in ROWS
    }
    if not options.table:
        # seed by seed, so that an interrupted call has whole tables of fewer seeds
        jobs = [jobs[i] for i in range(len(options.seeds)) for jobs in rows.values()]
        run_all(jobs, options.runs)
    done = {
        key: summarize(jobs, options.runs)
        for key, jobs in rows.items()
        if any(job.finished(options.runs) for job in jobs)
    }
    text = table(done)
    print(text)
    first = next(job for jobs in rows.values() for job in jobs if job.finished(options.runs))
    origin = json.loads((first.folder(options.runs) / "provenance.json").read_text())
    RESULTS.mkdir(exist_ok=True)
    out = RESULTS / f"targets-{datetime.now(UTC):%Y-%m-%d}"
    record = {
        "command": ["python -m benchmarks.targets", *sys.argv[1:]],
        "code": origin["code"],
        "packages": origin["packages"],
        "machine": origin["machine"],
        "rows": [
            dict(zip(("env", "demos", "algo"), key, strict=True)) | row for key, row in done.items()
        ],
    }
    out.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
    out.with_suffix(".md").write_text(text + "\n")
    print(f"wrote {out}.json and .md")


if __name__ == "__main__":
    main()
