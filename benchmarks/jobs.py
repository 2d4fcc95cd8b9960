"""Training runs side by side, one a core: started, continued, or skipped if they are done."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

from benchmarks.records import write_record
from emrld_jax.runs.launch import HUGE_PAGES
from emrld_jax.runs.metrics import Record, read_metrics


class Job(NamedTuple):
    """One training run of `emrld_jax.train`."""

    runs: Path  # folder that the run's folder is made in
    env: str
    demos: str
    algo: str
    seed: int
    settings: tuple[str, ...] = ()  # more of its command line

    @property
    def folder(self) -> Path:
        """Where the run is."""
        return self.runs / self.env / f"{self.algo}-{self.demos}" / f"seed{self.seed}"

    @property
    def finished(self) -> bool:
        return (self.folder / "results.json").is_file()

    def results(self) -> dict[str, Any]:
        """What the run's final evaluation found."""
        results: dict[str, Any] = json.loads((self.folder / "results.json").read_text())
        return results

    def metrics(self) -> list[Record]:
        """One record an iteration."""
        return read_metrics(self.folder / "metrics.jsonl")

    def command(self) -> list[str]:
        """The command line that starts the run, or continues it."""
        train = [sys.executable, "-m", "emrld_jax.train"]
        if (self.folder / "config.yaml").is_file():
            return [*train, f"resume={self.folder}"]
        chosen = (f"env={self.env}", f"demos={self.demos}", f"algo={self.algo}")
        return [*train, *chosen, f"seed={self.seed}", f"runs={self.runs}", *self.settings]


def run_all(jobs: Sequence[Job]) -> None:
    """Runs the jobs that are not finished, as many at a time as there are cores."""
    cores: Queue[int] = Queue()
    for core in sorted(os.sched_getaffinity(0)):
        cores.put(core)
    # a program that shares its one core with nobody is faster than two that share two
    environment = HUGE_PAGES | os.environ | {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}

    def run(job: Job) -> None:
        core = cores.get()
        log = job.runs / "logs" / f"{job.env}-{job.algo}-{job.demos}-{job.seed}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        command = ["taskset", "-c", str(core), *job.command()]
        try:
            with log.open("a") as out:
                code = subprocess.run(
                    command, check=False, env=environment, stdout=out, stderr=out
                ).returncode
        finally:
            cores.put(core)
        print(f"{job.folder}: {'done' if code == 0 else f'failed, see {log}'}", flush=True)

    with ThreadPoolExecutor(cores.qsize()) as pool:
        list(pool.map(run, [job for job in jobs if not job.finished]))


def write_results(
    name: str, jobs: Sequence[Job], rows: Sequence[dict[str, Any]], text: str
) -> None:
    """Writes a table and its numbers with where they come from into `benchmarks/results/`."""
    if not jobs:
        raise SystemExit("no run is finished yet")
    module = f"benchmarks.{Path(sys.argv[0]).stem}"
    origins = [json.loads((job.folder / "provenance.json").read_text()) for job in jobs]
    record = {
        "command": shlex.join(["python", "-m", module, *sys.argv[1:]]),
        "code": [dict(code) for code in {tuple(sorted(o["code"].items())) for o in origins}],
        "packages": origins[0]["packages"],
        "machine": origins[0]["machine"],
        "training_s": sum(r["time/iteration_s"] for job in jobs for r in job.metrics()),
        "rows": rows,
    }
    write_record(name, record, text)
