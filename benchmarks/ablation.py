"""What the tuned defaults are worth: an environment with one setting changed at a time.

`python -m benchmarks.ablation` trains what is not finished yet and writes the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.jobs import job, metrics, results, train_all, write_results
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.study.programs import Program

# settings, one row each; the first row has none
POINT2D = (
    "adapt.learning_rate=0.01",
    "adapt.learning_rate=0.007",
    "adapt.learning_rate=0.003",
    "policy.activation=relu",
    "policy.activation=silu",
    "policy.std=0.3 adapt.learning_rate=0.0018",
    "policy.std=0.8 adapt.learning_rate=0.0128",
    "policy.start_at_zero=false",
    "policy.output_scale=1",
    "policy.output_scale=3",
    "policy.learn_std=true",
    "meta.max_kl=0.01",
    "meta.fisher_every=1",
    "meta.backtrack_ratio=0.5",
    "env.reward_radius=0.1",  # m; the paper's zone has 0.2
    "env.reward_radius=0.4",
    "experiment=paper",
)
HALF_CHEETAH = (
    "policy.squash=false adapt.learning_rate=0.01",
    "policy.squash=false",
    "policy.std=0.5 adapt.learning_rate=0.125",
    "policy.std=0.5",
    "adapt.learning_rate=0.01",
    "adapt.learning_rate=0.04",
    "policy.activation=relu",
    "policy.output_scale=1",
    "meta.max_kl=0.03",
    "meta.fisher_every=1",
    "experiment=paper",
)
VARIANTS = {"point2d": POINT2D, "half_cheetah": HALF_CHEETAH}
MARKS = (20, 40, 60, 80, 100)  # iterations
WINDOW = 5  # iterations up to a mark that are averaged


def summarize(name: str, jobs: Sequence[Program]) -> dict[str, Any]:
    """One row: the return after adaptation around each mark, and in the end, a value a seed."""
    curves = [[record["adapt/return_1"] for record in metrics(own)] for own in jobs]
    return {
        "setting": name,
        "seeds": [own.seeds[0] for own in jobs],
        "return_at": {m: [float(np.mean(c[m - WINDOW : m])) for c in curves] for m in MARKS},
        "final": [results(own)["train"]["stages"][-1]["return"] for own in jobs],
        "held_out": [results(own)["test"]["stages"][-1]["return"] for own in jobs],
        "s_per_iteration": float(
            np.median([r["time/iteration_s"] for own in jobs for r in metrics(own)])
        ),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as Markdown, means over seeds."""
    marks = " | ".join(f"iteration {m}" for m in MARKS)
    lines = [
        f"| setting | {marks} | final | held-out | s an iteration |",
        "|---|" + "---|" * (len(MARKS) + 3),
    ]
    for row in rows:
        curve = " | ".join(f"{np.mean(row['return_at'][m]):.0f}" for m in MARKS)
        lines.append(
            f"| {row['setting'] or 'defaults'} | {curve} | {np.mean(row['final']):.1f} "
            f"| {np.mean(row['held_out']):.1f} | {row['s_per_iteration']:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Trains what is missing and writes the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablation", description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--table", action="store_true", help="only tabulate what is finished")
    parser.add_argument("--env", default="point2d", choices=tuple(VARIANTS))
    parser.add_argument("--demos", default="optimal", choices=QUALITIES)
    parser.add_argument("--algo", default="emrld", choices=("emrld", "emrld_ws"))
    options = parser.parse_args()
    rows = {
        name: [
            job(
                options.runs / options.env / (name.replace(" ", ",") or "defaults"),
                options.env,
                options.demos,
                options.algo,
                seed,
                (*name.split(), f"meta.iterations={max(MARKS)}"),
            )
            for seed in options.seeds
        ]
        for name in ("", *VARIANTS[options.env])
    }
    if not options.table:
        train_all([own for jobs in rows.values() for own in jobs])
    done = {name: [own for own in jobs if own.finished] for name, jobs in rows.items()}
    summaries = [summarize(name, jobs) for name, jobs in done.items() if jobs]
    finished = [own for jobs in done.values() for own in jobs]
    name = f"ablation-{options.env}-{options.algo}-{options.demos}"
    write_results(name, finished, summaries, table(summaries))


if __name__ == "__main__":
    main()
