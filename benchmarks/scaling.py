"""What more processes and more seeds a program bring, on the cores of this machine.

`python -m benchmarks.scaling env=point2d` trains the same few meta-iterations in several ways:
one run or many, in one process, in processes that share the work, and as a process a run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.choice import Choice, origin
from benchmarks.jobs import job, metrics, train_all
from benchmarks.records import write_record
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError, check_config
from emrld_jax.runs.launch import HUGE_PAGES
from emrld_jax.runs.setup import set_up
from emrld_jax.study.programs import Program
from envs_jax.base import REWARDS


@dataclass
class ScalingConfig(Choice):
    """All settings of the measurement."""

    reward: str = setting("sparse", "dense: adaptation weighs every step", choices=REWARDS)
    num_seeds: int = setting(8, "runs, where there are many", at_least=2)
    iterations: int = setting(40, "meta-iterations of each", at_least=10)


class Way(NamedTuple):
    """How runs are carried out."""

    seeds: int
    processes: int  # that share the work; 0: a process a run, one a core
    words: str


class Measured(NamedTuple):
    """What a way took."""

    way: Way
    iteration_s: float  # median of the later half, of all runs that advance together
    seed_s: float  # s an iteration and seed, with all cores at work
    wall_s: float  # from the command to the end of the last run, with start and compilation


def ways(config: ScalingConfig, cores: int) -> list[Way]:
    """Strong scaling of a run and of many, weak scaling with seeds, and a process a run."""
    many = config.num_seeds
    return [
        Way(1, 1, "one run, one process"),
        Way(1, cores, f"one run, its tasks shared by {cores} processes"),
        Way(many // cores, 1, "some runs, one process"),
        Way(many, 1, "many runs, one process"),
        Way(many, cores, f"many runs shared by {cores} processes"),
        Way(many, 0, f"a process a run, {cores} at a time, each on a core of its own"),
    ]


def measure(config: ScalingConfig, way: Way, cores: int) -> Measured:
    """Trains in this way, with programs that are not compiled yet."""
    more = (
        f"env.reward={config.reward}",
        f"meta.iterations={config.iterations}",
        "evaluation_episodes=1",
    )
    with tempfile.TemporaryDirectory() as folder:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = f"{folder}/compiled"
        together = (f"num_seeds={way.seeds}", f"processes={way.processes}") if way.processes else ()
        seeds = range(1 if way.processes else way.seeds)
        place = (Path(folder), config.env, config.demos, config.algo)
        jobs = [job(*place, seed, (*more, *together)) for seed in seeds]
        began = time.perf_counter()
        if way.processes:
            _run(jobs[0])
        else:
            train_all(jobs)
        wall = time.perf_counter() - began
        times = [[record["time/iteration_s"] for record in metrics(own)] for own in jobs]
    iteration = float(np.median([t[len(t) // 2 :] for t in times]))
    at_once = way.seeds if way.processes else min(cores, way.seeds)
    return Measured(way, iteration, iteration / at_once, wall)


def _run(own: Program) -> None:
    """One command on all cores."""
    environment = HUGE_PAGES | os.environ  # as all ways that start several processes have it
    subprocess.run(own.commands()[0], check=True, stdout=subprocess.DEVNULL, env=environment)


def table(found: list[Measured]) -> str:
    """The rows as Markdown."""
    lines = ["| | runs | ms an iteration | ms an iteration and run | s in all |"]
    lines += ["|---|---|---|---|---|"]
    for way, iteration, seed, wall in found:
        cells = f"{1e3 * iteration:.0f} | {1e3 * seed:.0f} | {wall:.0f}"
        lines.append(f"| {way.words} | {way.seeds} | {cells} |")
    return "\n".join(lines)


def main() -> int:
    """Measures and writes."""
    config = cli.updated(ScalingConfig(), cli.parse(sys.argv[1:], ScalingConfig(), {}))
    check_config(config)
    cores = len(os.sched_getaffinity(0))
    tasks = set_up(cli.train_config([f"env={config.env}"])).demos.train.demos.mask.shape[0]
    if tasks % cores or config.num_seeds % cores:
        raise ConfigError(
            f"{cores} cores do not divide {tasks} tasks and num_seeds={config.num_seeds} evenly; "
            "bind the command to fewer cores (taskset)"
        )
    found = []
    for way in ways(config, cores):
        found.append(measure(config, way, cores))
        print(way.words, f"{1e3 * found[-1].seed_s:.0f} ms an iteration and run", flush=True)
    rows: list[dict[str, Any]] = [{**m._asdict(), "way": m.way._asdict()} for m in found]
    record = {
        **origin("scaling"),
        "rows": rows,
    }
    write_record(f"scaling-{config.env}-{config.reward}", record, table(found))
    return 0


if __name__ == "__main__":
    cli.run_command(main)
