"""What a study found, as CSV for machines and Markdown for people."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from functools import partial
from itertools import product

from emrld_jax.analysis.comparisons import compare
from emrld_jax.analysis.groups import Group
from emrld_jax.analysis.loading import NONE, SPLITS
from emrld_jax.analysis.scores import (
    LAST,
    MEASURES,
    Adaptation,
    Cell,
    Row,
    adaptation_of,
    headline,
    score,
)
from emrld_jax.runs.report import SPLITS as SPLIT_WORDS
from emrld_jax.study.programs import is_evaluation

WORDS = {split: f"{words} tasks" for split, words in SPLIT_WORDS.items()}
WHEN = ("before", "after")


def results_csv(groups: Sequence[Group]) -> str:
    """A line for each group, split, measure and stage: interquartile mean and interval."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = ("environment", "demonstrations", "algorithm", "seeds", "tasks", "measure", "when")
    writer.writerow([*heads, "iqm", "low", "high", "demonstrated", "seconds", "env_steps"])
    for row in headline(groups):
        group = row.group
        for (split, measure, when), cell in row.cells.items():
            estimate = [f"{float(x):.6g}" for x in cell.estimate]
            shown = row.demonstrated.get(split, float("nan"))
            costs = (f"{shown:.6g}", f"{row.seconds:.1f}", f"{row.env_steps:.0f}")
            what = (cell.seeds, WORDS[split], measure, when)
            writer.writerow([*_names(group), *what, *estimate, *costs])
    return text.getvalue()


def seeds_csv(groups: Sequence[Group]) -> str:
    """A line for each run: return and success on both sets of tasks, before and after adaptation.

    Nothing stands where a run has no such tasks.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    figures = list(product(SPLITS, MEASURES, zip(WHEN, (0, LAST), strict=True)))
    names = [
        f"{SPLIT_WORDS[split].replace('-', '_')}_{measure}_{when}"
        for split, measure, (when, _) in figures
    ]
    writer.writerow(["environment", "demonstrations", "algorithm", "seed", *names])
    for group in groups:
        for run in group.runs:
            values = [score(run, split, measure, stage) for split, measure, (_, stage) in figures]
            numbers = ["" if value is None else f"{value:.6g}" for value in values]
            writer.writerow([*_names(group), run.seed, *numbers])
    return text.getvalue()


def results_markdown(groups: Sequence[Group]) -> str:
    """Return and success after adaptation, with 95 % intervals over seeds."""
    heads = [f"{measure}, {WORDS[split]}" for split in SPLITS for measure in MEASURES]
    columns = ["environment", "demonstrations (their return)", "algorithm", "seeds", *heads]
    lines = [f"| {' | '.join([*columns, 'seconds'])} |", "|---" * (len(columns) + 1) + "|"]
    lines += [_line(row) for row in headline(groups)]
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    group = row.group
    cells = [row.cells.get((split, measure, "after")) for split in SPLITS for measure in MEASURES]
    forms = [".1f", ".0%"] * len(SPLITS)
    demos = group.demonstrations
    if demos != NONE and "train" in row.demonstrated:
        demos += f" ({row.demonstrated['train']:.1f})"
    figures = [_figure(cell, form) for cell, form in zip(cells, forms, strict=True)]
    words = [group.environment, demos, group.label, str(len(group.seeds)), *figures]
    return f"| {' | '.join([*words, f'{row.seconds:.0f}'])} |"


def _figure(cell: Cell | None, form: str) -> str:
    if cell is None:
        return "--"
    value, low, high = (format(float(x), form) for x in cell.estimate)
    return value if cell.seeds < 2 else f"{value} [{low}, {high}]"


def adaptation_csv(groups: Sequence[Group], steps: int, *, fast: bool = False) -> str:
    """A line for each group: return and success on held-out tasks after 0, 1, .. `steps` steps.

    Empty but for its head if no run was evaluated after so many.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    figures = [f"{measure}_{k}" for measure in MEASURES for k in range(steps + 1)]
    columns = [f"{figure}{end}" for figure in figures for end in ("", "_low", "_high")]
    writer.writerow(["environment", "demonstrations", "algorithm", "seeds", *columns])
    for group, found in _adapted(groups, steps, fast):
        cells = [cell for measure in MEASURES for cell in found.cells[measure]]
        numbers = [f"{float(x):.6g}" for cell in cells for x in cell.estimate]
        writer.writerow([*_names(group), cells[0].seeds, *numbers])
    return text.getvalue()


def adaptation_markdown(groups: Sequence[Group], steps: int, *, fast: bool = False) -> str:
    """Return on held-out tasks after 0, 1, .. `steps` steps, with 95 % intervals over seeds."""
    after = [f"after {k} step{'s' * (k != 1)}" for k in range(steps + 1)]
    columns = ["environment", "demonstrations", "algorithm", "seeds", *after]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for group, found in _adapted(groups, steps, fast):
        cells = found.cells["return"]
        words = [*_names(group), str(cells[0].seeds), *(_figure(cell, ".1f") for cell in cells)]
        lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines) + "\n"


def _adapted(groups: Sequence[Group], steps: int, fast: bool) -> list[tuple[Group, Adaptation]]:
    """The groups that a study has evaluated after up to so many steps."""
    own = partial(is_evaluation, steps=steps, fast=fast)
    found = [(group, adaptation_of(group, "test", own)) for group in groups]
    return [(group, each) for group, each in found if each is not None]


def _names(group: Group) -> tuple[str, str, str]:
    return group.environment, group.demonstrations, group.label


def improvements_markdown(groups: Sequence[Group]) -> str:
    """How probably each algorithm returns more than each other one, on each problem."""
    lines = [
        "| on | first | second | P(first > second), training | held-out |",
        "|---|---|---|---|---|",
    ]
    found: dict[tuple[str, str, str], dict[str, str]] = {}
    for split in SPLITS:
        for comparison in compare(groups, split, "return"):
            where = "; ".join(", ".join(problem) for problem in comparison.problems)
            for first, second, probability in comparison.improvements:
                value, low, high = (float(x) for x in probability)
                interval = "" if math.isnan(low) else f" [{low:.2f}, {high:.2f}]"  # of one seed
                words = f"{value:.2f}{interval}"
                found.setdefault((where, first, second), {})[split] = words
    for (where, first, second), by_split in found.items():
        own = " | ".join(by_split.get(split, "--") for split in SPLITS)
        lines.append(f"| {where} | {first} | {second} | {own} |")
    return "\n".join(lines) + "\n"
