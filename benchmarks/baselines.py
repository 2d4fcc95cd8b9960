"""How the algorithms that EMRLD is compared with were tuned: 24 settings tried for each.

`python -m benchmarks.baselines --env point2d` trains grids of numbers, a program a grid, on a seed
that no figure uses, and writes the table. Each starts where EMRLD's own tuning has ended.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.jobs import results_of, train_all, write_results
from emrld_jax.algorithms import takes_demonstrations
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.runs.cli import train_config
from emrld_jax.study.plan import COMPARED
from emrld_jax.study.programs import Grid, Point, Program
from envs_jax import names

BASELINES = ("maml", "meta_bc", "gmps")
FACTORS = (0.3, 1.0, 3.0, 10.0)  # times the inner rate that EMRLD has in the environment
ADAM = (0.001, 0.003, 0.01)  # of Meta-BC and GMPS; the paper has 0.01
KL_FACTORS = (0.3, 1.0, 3.0)  # times the bound that EMRLD has in the environment
# the environment's own start of the policy, which was tuned for EMRLD, and an ordinary one
STARTS = ((), ("policy.start_at_zero=false", "policy.output_scale=1"))
SEED = 7


def grid(env: str, algo: str) -> Grid:
    """12 pairs of an algorithm's inner rate and its outer one."""
    own = train_config([f"env={env}", "algo=emrld"])
    inner = ("adapt.learning_rate", tuple(f * own.adapt.learning_rate for f in FACTORS))
    if algo in ("meta_bc", "gmps"):
        return (inner, ("meta.learning_rate", ADAM))
    return (inner, ("meta.max_kl", tuple(f * own.meta.max_kl for f in KL_FACTORS)))


def summarize(program: Program) -> list[dict[str, Any]]:
    """A row for each point: the return after adaptation."""
    return [
        {
            "algorithm": program.algo,
            "demonstrations": program.demos,
            "start": " ".join(program.settings),
            "point": dict(zip([number for number, _ in program.grid], point, strict=True)),
            "return": _after(program, point, "train"),
            "held_out_return": _after(program, point, "test"),
        }
        for point in program.points
    ]


def _after(program: Program, point: Point, split: str) -> float:
    found = [results_of(program.folder(seed, point)) for seed in program.seeds]
    return float(np.mean([result[split]["stages"][-1]["return"] for result in found]))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns on the training tasks, a line a setting, the best of each column in bold."""
    lines = []
    for algo in dict.fromkeys(row["algorithm"] for row in rows):
        own = [row for row in rows if row["algorithm"] == algo]
        demos = list(dict.fromkeys(row["demonstrations"] for row in own))
        columns = [{_words(r): r["return"] for r in own if r["demonstrations"] == d} for d in demos]
        lines += [f"| {algo} | {' | '.join(demos)} |", "|---" * (len(demos) + 1) + "|"]
        for words in dict.fromkeys(map(_words, own)):
            cells = [_cell(column.get(words), max(column.values())) for column in columns]
            lines.append(f"| `{words}` | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def _words(row: dict[str, Any]) -> str:
    """A row's setting, as the command line takes it."""
    return " ".join([*(f"{name}={value:g}" for name, value in row["point"].items()), row["start"]])


def _cell(value: float | None, best: float) -> str:
    if value is None:
        return "--"
    return f"**{value:.1f}**" if value == best else f"{value:.1f}"


def main() -> None:
    """Trains what is missing and writes the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.baselines", description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/baselines"))
    parser.add_argument("--env", default="point2d", choices=names())
    parser.add_argument("--algos", nargs="+", default=BASELINES, choices=COMPARED)
    parser.add_argument("--iterations", type=int, help="of each training (else the environment's)")
    parser.add_argument("--table", action="store_true", help="only tabulate what is finished")
    options = parser.parse_args()
    shortened = (f"meta.iterations={options.iterations}",) if options.iterations else ()
    programs = [
        Program(options.runs / str(k), options.env, demos, algo, (SEED,), (*start, *shortened), own)
        for algo in options.algos
        for k, start in enumerate(STARTS)
        for own in [grid(options.env, algo)]
        for demos in (QUALITIES if takes_demonstrations(algo) else QUALITIES[:1])
    ]
    if not options.table:
        train_all(programs)
    done = [program for program in programs if program.finished]
    rows = [row for program in done for row in summarize(program)]
    write_results(f"baselines-{options.env}", done, rows, table(rows))


if __name__ == "__main__":
    main()
