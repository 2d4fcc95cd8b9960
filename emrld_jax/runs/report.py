"""The end of a training run: the final table, its numbers as JSON, and pictures."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from emrld_jax.demos import DemoSet
from emrld_jax.runs.evaluation import Evaluation, evaluator, summarize
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.pictures import Panel, is_planar, learning_curve, trajectories
from emrld_jax.runs.setup import Setup
from emrld_jax.types import Params

SPLITS = {"train": "training", "test": "held-out"}


def report(
    setup: Setup, folder: RunFolder, params: Params, key: jax.Array, console: Console
) -> None:
    """Evaluates before and after adaptation on both splits; writes and shows the results."""
    config = setup.config
    evaluate = evaluator(setup.env, setup.learner, config.adapt, config.evaluation_episodes)
    results: dict[str, Any] = {}
    panels = []
    keys = jax.random.split(key, len(SPLITS))
    for split_key, (split, words) in zip(keys, SPLITS.items(), strict=True):
        demos: DemoSet = getattr(setup.demos, split)
        results[split] = None
        if demos.demos.mask.shape[0]:
            evaluation = evaluate(params, split_key, demos.tasks, demos.demos)
            results[split] = {
                **summarize(evaluation, config.seed),
                "demonstrations": _demonstrated(demos),
            }
            panels += before_and_after(words, demos, evaluation)
    title = f"{config.env.name}, {config.algo}, {setup.demos.quality} demonstrations"
    learning_curve(read_metrics(folder.metrics), title, folder.path / "learning_curve")
    if is_planar(setup.env):
        trajectories(setup.env, panels, title, folder.path / "trajectories")
    write_json(folder.results, results)
    console.print(_table(results))
    console.print(f"{folder.path}: results, pictures, checkpoints", soft_wrap=True, highlight=False)


def before_and_after(words: str, demos: DemoSet, evaluation: Evaluation) -> list[Panel]:
    """Panels of the paths before and after adaptation to these tasks."""
    steps = evaluation.obs.shape[1] - 1
    stages = {"before adaptation": 0, f"after {steps} adaptation step{'s' * (steps > 1)}": steps}
    return [
        Panel(f"{words} tasks, {when}", demos, evaluation.obs[:, k], evaluation.mask[:, k])
        for when, k in stages.items()
    ]


def with_interval(entry: dict[str, Any], name: str, form: str) -> str:
    """A mean with its interval, such as 78.1 [75.0, 80.2]."""
    low, high = entry[f"{name}_interval"]
    return f"{entry[name]:{form}} [{low:{form}}, {high:{form}}]"


def _demonstrated(demos: DemoSet) -> dict[str, float]:
    returns, success = np.asarray(demos.returns), np.asarray(demos.success)
    return {"return": float(returns.mean()), "success": float(success.mean())}


def _table(results: dict[str, Any]) -> Table:
    table = Table(title="Mean over tasks and episodes, with 95 % intervals")
    for heading in ("tasks", "adaptation", "return", "success"):
        table.add_column(heading, justify="left" if heading in ("tasks", "adaptation") else "right")
    for split, words in SPLITS.items():
        result = results[split]
        if result is None:
            table.add_row(f"{words} (no demonstrations)", "--", "--", "--", end_section=True)
            continue
        stages = result["stages"]
        for when, entry in (("before", stages[0]), ("after", stages[-1])):
            table.add_row(
                f"{words} ({result['tasks']})",
                when,
                with_interval(entry, "return", ".1f"),
                with_interval(entry, "success", ".0%"),
            )
        shown = result["demonstrations"]
        figures = (f"{shown['return']:.1f}", f"{shown['success']:.0%}")
        table.add_row("", "demonstrations", *figures, end_section=True)
    return table
