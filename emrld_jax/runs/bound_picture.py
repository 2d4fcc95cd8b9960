"""A run with `diagnostics=true`: what it improved, and the terms of the bound, over iterations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emrld_jax.runs.metrics import Record
from emrld_jax.runs.panels import AFTER, BEFORE, save
from emrld_jax.theory.bound import Terms

COLORS = ("#2e8b57", "#c0561f", "#7a4fa3", "#b59a00")


def theory(records: Sequence[Record], title: str, path: Path) -> None:
    """Draws the improvement beside the surrogate, and the bound beside what it is made of."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_improvement(left, records)
    draw_bound(right, records)
    figure.suptitle(title)
    save(figure, path)


def draw_improvement(axes: Axes, records: Sequence[Record]) -> None:
    """Measured, with two standard errors, and as the surrogate predicts it."""
    x, measured = _iterations(records), column(records, "improvement")
    error = 2 * column(records, "improvement_se")
    band = np.nan_to_num(error)
    axes.fill_between(x, measured - band, measured + band, color=BEFORE, alpha=0.3, linewidth=0)
    axes.plot(x, measured, color="black", linewidth=1.2, label="measured improvement (± 2 SE)")
    axes.plot(x, column(records, "surrogate"), color=AFTER, linewidth=1.2, label="surrogate")
    axes.axhline(0, color=BEFORE, linewidth=0.7)
    axes.set(xlabel="meta-iteration", ylabel="discounted return")
    axes.legend(frameon=False)


def draw_bound(axes: Axes, records: Sequence[Record]) -> None:
    """The bound's four terms and their sum, on an axis that is linear near 0."""
    x = _iterations(records)
    terms = Terms(*(column(records, name) for name in Terms._fields))
    penalty_old = terms.surrogate_part - terms.surrogate
    gained = terms.steps_new * terms.delta
    lines = (
        ("surrogate", terms.surrogate, AFTER),
        ("- distance to the old policies", penalty_old, COLORS[0]),
        ("+ demonstrator's advantage", gained, COLORS[1]),
        ("- distance to the demonstrator", terms.demonstrator_part - gained, COLORS[2]),
    )
    for label, values, color in lines:
        axes.plot(x, values, color=color, linewidth=1.2, label=label)
    axes.plot(x, column(records, "bound"), color="red", linewidth=1.8, label="= bound")
    measured = column(records, "improvement")
    axes.plot(x, measured, color="black", linewidth=1.2, label="measured improvement")
    axes.set_yscale("symlog", linthresh=1.0)
    axes.axhline(0, color=BEFORE, linewidth=0.7)
    axes.set(xlabel="meta-iteration", ylabel="discounted return (symmetric log)")
    axes.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))


def column(records: Sequence[Record], name: str) -> np.ndarray:
    """A metric of the theory in all records; NaN where it was not finite."""
    return np.array([record.get(f"theory/{name}", np.nan) for record in records])


def _iterations(records: Sequence[Record]) -> np.ndarray:
    return np.array([record["iteration"] + 1 for record in records])
