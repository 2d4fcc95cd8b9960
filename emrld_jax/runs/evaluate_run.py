"""The evaluation of a run, finished or not: figures after each adaptation step, in its folder."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import jax
from rich.console import Console
from rich.table import Table

from emrld_jax.demos import DemoSet
from emrld_jax.runs.config import ConfigError, EvaluateConfig, TrainConfig
from emrld_jax.runs.evaluation import Evaluation, evaluator, summarize
from emrld_jax.runs.files import write_json
from emrld_jax.runs.film import film, prepare_films
from emrld_jax.runs.folder import RunFolder, new_folder
from emrld_jax.runs.pictures import adaptation_curve, draw_episodes, num_drawn
from emrld_jax.runs.progress import tell
from emrld_jax.runs.provenance import other_demonstrations, provenance
from emrld_jax.runs.report import SPLITS, before_and_after, tell_of_breakdowns, with_interval
from emrld_jax.runs.saved import load_config, save_config
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.runs.trained import newest
from emrld_jax.types import Params

STREAM = 0x6576616C  # tells the keys of evaluations from those of training with the same seed


def evaluate_run(config: EvaluateConfig, console: Console) -> int:
    """Adapts the run's policy to each task and measures it after every step.

    Returns:
        The exit code, 0.

    Raises:
        ConfigError, DemoError: the run or its demonstrations are refused.
    """
    folder = RunFolder(Path(str(config.run)))
    trained = load_config(folder.config)
    demos = config.demos or trained.demos
    # only adaptation is to be seen, so the outer loss's own demonstrations need not be there
    setup = set_up(replace(trained, adapt=config.adapt, demos=demos, outer_demos=None))
    shown = _demonstrations(config, setup)
    if note := other_demonstrations(folder.provenance, setup.demos_path):
        tell(console, note)
    if config.video:
        prepare_films(setup.env)
    params, iteration = newest(setup, folder, lambda text: tell(console, text))
    title = _announce(config, trained, folder, iteration, console)
    evaluation = _measured(config, setup, params, shown)
    results = {
        **summarize(evaluation, config.seed),
        "iteration": iteration,
        "configuration": asdict(config),
        "provenance": provenance(setup.demos_path),
    }
    target = new_folder(folder.evaluations / _name(config))
    save_config(config, target / "config.yaml")
    write_json(target / "evaluation.json", results)
    console.print(_table(results["stages"], f"{title}, after {iteration} meta-iterations"))
    tell_of_breakdowns(results["stages"], console)
    adaptation_curve(results["stages"], title, target / "adaptation")
    _draw(config, setup, shown, evaluation, title, target)
    tell(console, f"{target}: figures and pictures")
    return 0


def _announce(
    config: EvaluateConfig,
    trained: TrainConfig,
    folder: RunFolder,
    iteration: int,
    console: Console,
) -> str:
    """Tells what is about to be evaluated; its title in tables and pictures."""
    title = f"{trained.env.name}, {trained.algo}: {SPLITS[config.tasks]} tasks"
    title += ", mean action" * config.deterministic
    of_all = f"{iteration} of {trained.meta.iterations} meta-iterations"
    tell(console, f"{title}: evaluating {folder.path} after {of_all}")
    if config.adapt.num_steps > (steps := trained.adapt.num_steps):
        tell(console, f"note: trained for adapt.num_steps={steps}; more steps may harm")
    return title


def _measured(config: EvaluateConfig, setup: Setup, params: Params, demos: DemoSet) -> Evaluation:
    """Episodes of the tasks after each adaptation step."""
    evaluate = evaluator(
        setup.env,
        setup.learner,
        config.adapt,
        config.episodes,
        kept=num_drawn(setup.env, config.episodes),
        deterministic=config.deterministic,
    )
    return evaluate(params, evaluation_key(config.seed), demos.tasks, demos.demos)


def _demonstrations(config: EvaluateConfig, setup: Setup) -> DemoSet:
    """Those of the tasks that are evaluated."""
    demos: DemoSet = getattr(setup.demos, config.tasks)
    if not demos.demos.mask.shape[0]:
        raise ConfigError(
            f"tasks={config.tasks}: {setup.demos_path} has no demonstrations of "
            f"{SPLITS[config.tasks]} tasks; tasks={_other(config.tasks)} takes the others"
        )
    return demos


def _draw(
    config: EvaluateConfig,
    setup: Setup,
    demos: DemoSet,
    evaluation: Evaluation,
    title: str,
    target: Path,
) -> None:
    """Pictures of the episodes, the film last: it takes longest."""
    panels = before_and_after(SPLITS[config.tasks], demos, evaluation)
    draw_episodes(setup.env, panels, title, target)
    if config.video:
        film(setup.env, panels, target)


def evaluation_key(seed: int) -> jax.Array:
    """The key of an evaluation; training folds only small numbers into its seed's key."""
    return jax.random.fold_in(jax.random.key(seed), STREAM)


def _other(tasks: str) -> str:
    return next(split for split in SPLITS if split != tasks)


def _name(config: EvaluateConfig) -> str:
    mean = "-deterministic" * config.deterministic
    steps = config.adapt.num_steps
    return f"{config.tasks}-steps{steps}-episodes{config.episodes}-seed{config.seed}{mean}"


def _table(stages: list[dict], title: str) -> Table:
    table = Table(title=f"{title} (95 % intervals)")
    for heading in ("adaptation steps", "return", "success"):
        table.add_column(heading, justify="right")
    for stage in stages:
        table.add_row(
            str(stage["adaptation_steps"]),
            with_interval(stage, "return", ".1f"),
            with_interval(stage, "success", ".0%"),
        )
    return table
