"""Theorem 3.2 on random tabular problems, where all is exact, and beside a short training.

`python -m benchmarks.theory` draws docs/images/theory.png and .svg.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.choice import Choice, chosen, origin
from benchmarks.records import write_record
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.bound_picture import column, draw_bound, draw_improvement
from emrld_jax.runs.config import check_config
from emrld_jax.runs.iteration import Together, initial
from emrld_jax.runs.metrics import Record
from emrld_jax.runs.panels import save
from emrld_jax.runs.setup import set_up
from emrld_jax.theory.cases import KINDS, random_case

IMAGE = Path(__file__).parents[1] / "docs" / "images" / "theory"
COLORS = ("#8c8c8c", "#1f5fa8", "#2e8b57", "#c0561f")
DROPPED = (("tv_old",), ("tv_demonstrator",), ("tv_old", "tv_demonstrator"))


@dataclass
class TheoryConfig(Choice):
    """All settings of the study."""

    problems: int = setting(250, "random problems of each kind", at_least=1)
    iterations: int = setting(60, "meta-iterations of the training", at_least=2)
    seed: int = setting(0, "seed of the training", at_least=0, at_most=10**9)


def study(kind: str, number: int) -> dict[str, Any]:
    """Problems of a kind: bound and improvement of each, in largest advantages times steps."""
    bounds, improvements, guaranteed, simpler = [], [], [], []
    violated = dict.fromkeys(DROPPED, 0)
    for seed in range(number):
        case = random_case(seed, kind)
        terms, unit = case.terms, case.terms.c1 * case.terms.steps_old
        bounds.append(float(terms.bound / unit))
        improvements.append(case.improvement / unit)
        guaranteed.append(bool(terms.bound > 0))
        simpler.append(bool(terms.demonstrator_part > 0))
        for names in DROPPED:
            without = terms._replace(**dict.fromkeys(names, 0.0))
            violated[names] += bool(case.improvement / unit < without.bound / unit - 1e-9)
    return {
        "kind": kind,
        "bounds": bounds,
        "improvements": improvements,
        "least_slack": min(np.subtract(improvements, bounds)),
        "median_slack": float(np.median(np.subtract(improvements, bounds))),
        "improved": float(np.mean(np.array(improvements) > 0)),
        "guaranteed": float(np.mean(guaranteed)),
        "guaranteed_without_surrogate": float(np.mean(simpler)),
        "violated_without": {" and ".join(k): n / number for k, n in violated.items()},
    }


def training(config: TheoryConfig) -> list[Record]:
    """The metrics of a training with `diagnostics=true`."""
    arguments = [*chosen(config), "diagnostics=true", f"seed={config.seed}"]
    setup = set_up(cli.train_config(arguments))
    together = Together([setup], jax.devices()[:1])
    standing = together.begin([initial(setup)])
    records: list[Record] = []
    for i in range(config.iterations):
        standing, (metrics,) = together.iterate(standing)
        records.append({"iteration": i, **metrics})
    return records


def table(studies: list[dict[str, Any]], records: list[Record]) -> str:
    """Both parts as Markdown."""
    lines = [
        "In units of C_1 x discounted steps; violated: the same problems without that distance.",
        "",
        "| policies | problems | slack, least | slack, median | improved | bound above 0 "
        "| above 0 without the surrogate's part | violated without D_TV(new, old) "
        "| without D_TV(new, demonstrator) | without both |",
        "|" + "---|" * 10,
    ]
    for found in studies:
        shares = [found["improved"], found["guaranteed"], found["guaranteed_without_surrogate"]]
        cells = [f"{share:.0%}" for share in (*shares, *found["violated_without"].values())]
        slack = (f"{found[f'{which}_slack']:.3g}" for which in ("least", "median"))
        row = (found["kind"], str(len(found["bounds"])), *slack, *cells)
        lines.append(f"| {' | '.join(row)} |")
    lines += ["", "Training: means over meta-iterations.", ""]
    names = [name for name in records[0] if name.startswith("theory/")]
    lines += ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    values = (np.nanmean(column(records, name.removeprefix("theory/"))) for name in names)
    lines.append("| " + " | ".join(f"{value:.4g}" for value in values) + " |")
    return "\n".join(lines)


def draw_studies(axes: Axes, studies: list[dict[str, Any]]) -> None:
    """A point a problem, above the diagonal if the bound holds."""
    for found, color in zip(studies, COLORS, strict=True):
        x, y = found["bounds"], found["improvements"]
        axes.scatter(x, y, s=8, color=color, alpha=0.6, linewidths=0, label=found["kind"])
    low = min(min(found["bounds"]) for found in studies)
    high = max(max(found["improvements"]) for found in studies)
    axes.plot([low, high], [low, high], color="red", linewidth=1.2, label="improvement = bound")
    axes.set(xlabel="bound / (C$_1$ steps)", ylabel="improvement / (C$_1$ steps)")
    axes.set_title("tabular problems, exact", fontsize="medium")
    axes.set(xlim=(1.3 * low, None), ylim=(-1.5, 1.1))  # the diagonal's lower end shows nothing
    axes.legend(frameon=False, fontsize="small", loc="lower left")


def main() -> int:
    """Computes, trains, draws and writes."""
    config = cli.updated(TheoryConfig(), cli.parse(sys.argv[1:], TheoryConfig(), {}))
    check_config(config)
    studies = [study(kind, config.problems) for kind in KINDS]
    records = training(config)
    record = {**origin("theory"), "studies": studies, "seed": config.seed, "training": records}
    write_record(f"theory-{config.env}", record, table(studies, records))
    figure = Figure(figsize=(15, 4.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    draw_studies(left, studies)
    draw_improvement(middle, records)
    draw_bound(right, records)
    for axes in (middle, right):
        axes.set_title(f"{config.env}, {config.algo}, estimated", fontsize="medium")
    save(figure, IMAGE)
    return 0


if __name__ == "__main__":
    cli.run_command(main)
