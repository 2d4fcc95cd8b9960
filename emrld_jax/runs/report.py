"""The end of a training run: the final table, its numbers as JSON, and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from emrld_jax.demos import DemoSet
from emrld_jax.runs.bound_picture import theory
from emrld_jax.runs.checkpoints import Progressed
from emrld_jax.runs.config import TrainConfig
from emrld_jax.runs.demonstrated import demonstrated
from emrld_jax.runs.episodes import FINAL, can_keep, kept_episodes, write_episodes
from emrld_jax.runs.evaluation import Evaluation, evaluator, summarize
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.iteration import Standing, streams
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.panels import Panel
from emrld_jax.runs.pictures import draw_episodes, learning_curve, num_drawn
from emrld_jax.runs.progress import tell
from emrld_jax.runs.setup import Setup, learner_with
from emrld_jax.runs.variants import differences
from emrld_jax.settings import with_values
from emrld_jax.types import Demos, Params, Task

SPLITS = {"train": "training", "test": "held-out"}


def report_all(
    setups: Sequence[Setup], folders: Sequence[RunFolder], standing: Standing, console: Console
) -> None:
    """Evaluates each run before and after adaptation on both splits; writes and shows results."""
    shared, values = setups[0], differences([setup.config for setup in setups])

    @jax.jit  # once for all runs: values are traced
    def evaluate(own: Any, params: Params, key: jax.Array, tasks: Task, demos: Demos) -> Evaluation:
        learner, settings = learner_with(shared, own), with_values(shared.config, own)
        episodes = shared.config.evaluation_episodes
        kept = num_drawn(shared.env, episodes)
        evaluate = evaluator(shared.env, learner, settings.adapt, episodes, kept=kept)
        return evaluate(params, key, tasks, demos)

    found = []
    for k, (setup, folder) in enumerate(zip(setups, folders, strict=True)):
        own = {name: column[k] for name, column in values.items()}
        found.append(_report(setup, folder, partial(evaluate, own), standing.run(k)))
        if len(folders) > 1:
            tell(console, f"{folder.path}: {_in_words(found[-1])}")
    if len(folders) == 1:
        console.print(_table(found[0]))
        stages = [stage for split in found[0].values() if split for stage in split["stages"]]
        tell_of_breakdowns(stages, console)
        tell(console, f"{folders[0].path}: results, pictures, checkpoints")
    else:
        console.print(_overview([setup.config for setup in setups], found, values))


def _report(
    setup: Setup, folder: RunFolder, evaluate: Callable[..., Evaluation], run: Progressed
) -> dict[str, Any]:
    """Evaluates one run, draws, and writes results.json last."""
    config = setup.config
    results: dict[str, Any] = {}
    panels, kept = [], {}
    keys = jax.random.split(streams(run.key)[2], len(SPLITS))
    for split_key, (split, words) in zip(keys, SPLITS.items(), strict=True):
        demos: DemoSet = getattr(setup.demos, split)
        results[split] = None
        if demos.demos.mask.shape[0]:
            evaluation = evaluate(run.state.params, split_key, demos.tasks, demos.demos)
            results[split] = {
                **summarize(evaluation, config.seed),
                "demonstrations": demonstrated(setup.env, demos),
            }
            panels += before_and_after(words, demos, evaluation)
            if can_keep(setup.env):
                numbers = range(demos.demos.mask.shape[0])
                kept[split] = kept_episodes(setup.env, demos, evaluation, numbers)
    title = f"{config.env.name}, {config.algo}, {setup.demos.quality} demonstrations"
    records = read_metrics(folder.metrics)
    learning_curve(records, config.algo, title, folder.path / "learning_curve")
    if config.diagnostics:
        theory(records, title, folder.path / "theory")
    draw_episodes(setup.env, panels, title, folder.path)
    if kept:
        write_episodes(folder.episodes / f"{FINAL}.npz", setup.env, kept, run.iteration)
    write_json(folder.results, results)
    return results


def before_and_after(words: str, demos: DemoSet, evaluation: Evaluation) -> list[Panel]:
    """Panels of the paths before and after adaptation to these tasks."""
    steps = evaluation.obs.shape[1] - 1
    stages = {"before adaptation": 0, f"after {steps} adaptation step{'s' * (steps > 1)}": steps}
    return [
        Panel(f"{words} tasks, {when}", demos, evaluation.obs[:, k], evaluation.mask[:, k])
        for when, k in stages.items()
    ]


def tell_of_breakdowns(stages: Sequence[dict[str, Any]], console: Console) -> None:
    """A note if simulations broke down."""
    if broken := max(stage["diverged"] for stage in stages):
        tell(console, f"note: {broken:.2%} of simulations broke down, and their episodes ended")


def with_interval(entry: dict[str, Any], name: str, form: str) -> str:
    """A mean with its interval, such as 78.1 [75.0, 80.2]."""
    low, high = entry[f"{name}_interval"]
    return f"{entry[name]:{form}} [{low:{form}}, {high:{form}}]"


def _in_words(results: dict[str, Any]) -> str:
    """The returns after adaptation."""
    there = {words: results[split] for split, words in SPLITS.items() if results[split]}
    return ", ".join(
        f"{words} {result['stages'][-1]['return']:.1f} ({result['stages'][-1]['success']:.0%})"
        for words, result in there.items()
    )


def _overview(
    configs: Sequence[TrainConfig], found: Sequence[dict[str, Any]], values: dict[str, np.ndarray]
) -> Table:
    """A row for each combination of numbers: means over its seeds, with their range."""
    groups: dict[tuple, list[int]] = {}
    for k in range(len(configs)):
        groups.setdefault(tuple(float(column[k]) for column in values.values()), []).append(k)
    table = Table(title="After adaptation: mean over seeds (their range)")
    for name in (*values, "seeds"):
        table.add_column(name, justify="right")
    measured = ("return", "success")
    shown = [s for s in SPLITS if all(results[s] is not None for results in found)]
    for split in shown:
        for what in measured:
            table.add_column(f"{what}, {SPLITS[split]}", justify="right")
    for numbers, members in groups.items():
        cells = []
        for split in shown:
            for what, form in zip(measured, (".1f", ".0%"), strict=True):
                column = [found[k][split]["stages"][-1][what] for k in members]
                spread = f" ({min(column):{form}}-{max(column):{form}})" * (len(column) > 1)
                cells.append(f"{np.mean(column):{form}}{spread}")
        table.add_row(*(f"{x:g}" for x in numbers), str(len(members)), *cells)
    return table


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
