"""The README's table: EMRLD, EMRLD-WS and MAML on every environment, shipped defaults.

`python -m benchmarks.targets` trains what is not finished yet and writes the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.jobs import job, metrics, results, train_all, write_results
from emrld_jax.study.programs import Program

ENVIRONMENTS = ("point2d", "two_wheeled", "two_wheeled_drift", "half_cheetah")
ROWS = (
    ("optimal", "emrld"),
    ("optimal", "emrld_ws"),
    ("suboptimal", "emrld"),
    ("suboptimal", "emrld_ws"),
    ("optimal", "maml"),  # which takes no demonstrations
)
Row = dict[str, Any]


def summarize(jobs: Sequence[Program]) -> Row:
    """One row: figures after adaptation, a value a seed."""
    found = [results(own) for own in jobs]

    def figure(split: str, name: str) -> list[float]:
        return [result[split]["stages"][-1][name] for result in found]

    def solved(split: str) -> list[float]:
        """Share of tasks of which more than half of the episodes succeed."""
        rates = [result[split]["stages"][-1]["success_per_task"] for result in found]
        return [float(np.mean(np.array(rate) > 0.5)) for rate in rates]

    return {
        "environment": jobs[0].env,
        "demonstrations": jobs[0].demos,
        "algorithm": jobs[0].algo,
        "seeds": [own.seeds[0] for own in jobs],
        "demonstrated_return": found[0]["train"]["demonstrations"]["return"],
        "return": figure("train", "return"),
        "success": figure("train", "success"),
        "held_out_return": figure("test", "return"),
        "held_out_success": figure("test", "success"),
        "tasks_solved": solved("train"),
        "held_out_tasks_solved": solved("test"),
        # the last held-out drift is that of the paper's robot experiment, -0.65 rad a step
        "robot_experiment_success": [
            r["test"]["stages"][-1]["success_per_task"][-1]
            for r in found
            if jobs[0].env == "two_wheeled_drift"
        ],
        "iterations": len(metrics(jobs[0])),
        "training_s": float(
            np.mean([sum(r["time/iteration_s"] for r in metrics(own)) for own in jobs])
        ),
    }


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown: means over seeds, with the range of the seeds' returns."""
    lines = [
        "| environment | demonstrations (their return) | algorithm | seeds "
        "| return, training tasks | success | tasks solved "
        "| return, held-out tasks | success | tasks solved "
        "| meta-iterations | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        demos = f"{row['demonstrations']} ({row['demonstrated_return']:.1f})"
        cells = (
            row["environment"],
            "none" if row["algorithm"] == "maml" else demos,
            row["algorithm"],
            str(len(row["seeds"])),
            _spread(row["return"]),
            f"{np.mean(row['success']):.0%}",
            f"{np.mean(row['tasks_solved']):.0%}",
            _spread(row["held_out_return"]),
            f"{np.mean(row['held_out_success']):.0%}",
            f"{np.mean(row['held_out_tasks_solved']):.0%}",
            str(row["iterations"]),
            f"{row['training_s']:.0f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + _robot_experiment(rows)


def _robot_experiment(rows: Sequence[Row]) -> str:
    """A sentence on the held-out drift of the paper's robot experiment; empty without drift."""
    shares = ", ".join(
        f"{row['algorithm']} {np.mean(row['robot_experiment_success']):.0%}"
        + f" ({row['demonstrations']})" * (row["algorithm"] != "maml")
        for row in rows
        if row["robot_experiment_success"]
    )
    return f"\n\nSuccess at the held-out drift of -0.65 rad a step: {shares}." if shares else ""


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.1f} ({min(values):.1f} to {max(values):.1f})"


def main() -> None:
    """Trains what is missing and writes the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.targets", description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/targets"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--envs", nargs="+", default=ENVIRONMENTS, choices=ENVIRONMENTS)
    parser.add_argument("--table", action="store_true", help="only tabulate what is finished")
    options = parser.parse_args()
    rows = [
        [job(options.runs, env, demos, algo, seed) for seed in options.seeds]
        for env in options.envs
        for demos, algo in ROWS
    ]
    if not options.table:
        # seed by seed, so that an interrupted call leaves whole tables of fewer seeds
        train_all([own for jobs in zip(*rows, strict=True) for own in jobs])
    done = [[own for own in jobs if own.finished] for jobs in rows]
    summaries = [summarize(jobs) for jobs in done if jobs]
    write_results("targets", [own for jobs in done for own in jobs], summaries, table(summaries))


if __name__ == "__main__":
    main()
