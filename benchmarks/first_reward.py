"""Whether the first parameters, once adapted, find a reward: without one nothing is learned.

`python -m benchmarks.first_reward` adapts the first parameters of many seeds once, for several
starts of the policy, and counts the seeds that then see no reward on any training task.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import jax
import numpy as np

from benchmarks.records import write_record
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.evaluation import evaluator
from emrld_jax.runs.iteration import streams
from emrld_jax.runs.provenance import machine, software
from emrld_jax.runs.setup import set_up
from envs_jax import names

STARTS = tuple(
    f"policy.start_at_zero={zero} policy.output_scale={scale}"
    for zero in ("false", "true")
    for scale in (0.01, 0.3, 1, 2, 3)
)
ALGORITHMS = ("emrld", "emrld_ws")


def rewarded_tasks(arguments: list[str], seeds: int) -> list[float]:
    """For each seed, the share of training tasks rewarded in the first iteration's episodes."""
    setup = set_up(train_config(arguments))
    adapt, part = setup.config.adapt, setup.demos.train
    evaluate = evaluator(setup.env, setup.learner, adapt, adapt.num_episodes)
    shares = []
    for seed in range(seeds):
        init_key, loop_key, _ = streams(jax.random.key_data(jax.random.key(seed)))
        key = jax.random.fold_in(loop_key, 0)
        returns = evaluate(setup.learner.init(init_key).params, key, part.tasks, part.demos).returns
        shares.append(float(np.mean(np.any(np.asarray(returns)[:, -1] > 0, axis=-1))))
    return shares


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown: seeds without any reward, and in brackets the mean share of tasks."""
    columns = list(dict.fromkeys((row["demonstrations"], row["algorithm"]) for row in rows))
    seeds = len(rows[0]["tasks_rewarded"])
    lines = [
        f"Of {seeds} seeds, how many see no reward after the first adaptation (in brackets: the "
        "share of training tasks with a reward, mean over seeds).\n",
        "| start | " + " | ".join(f"{d}, {a}" for d, a in columns) + " |",
        "|---|" + "---|" * len(columns),
    ]
    for start in STARTS:
        shares = [row["tasks_rewarded"] for row in rows if row["start"] == start]
        cells = " | ".join(f"{sum(not x for x in s)} ({np.mean(s):.0%})" for s in shares)
        lines.append(f"| `{start}` | {cells} |")
    return "\n".join(lines)


def main() -> None:
    """Measures and writes the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.first_reward", description=__doc__)
    parser.add_argument("--env", default="point2d", choices=names())
    parser.add_argument("--seeds", type=int, default=20, help="how many, from 0")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = [
        {"start": start, "demonstrations": demos, "algorithm": algo}
        for start in STARTS
        for demos in QUALITIES
        for algo in ALGORITHMS
    ]
    for row in rows:
        chosen = [f"demos={row['demonstrations']}", f"algo={row['algorithm']}"]
        arguments = [f"env={options.env}", *row["start"].split(), *chosen]
        row["tasks_rewarded"] = rewarded_tasks(arguments, options.seeds)
        print(arguments, f"{np.mean(row['tasks_rewarded']):.0%} of tasks rewarded", flush=True)
    record = {
        "command": "python -m benchmarks.first_reward " + " ".join(sys.argv[1:]),
        **software(),
        "machine": machine(),
        "rows": rows,
    }
    write_record(f"first_reward-{options.env}", record, table(rows))


if __name__ == "__main__":
    main()
