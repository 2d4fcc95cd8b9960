"""What a study leaves behind: figures, tables, where all of it comes from, and the report."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from emrld_jax.analysis.groups import Group, Grouped, group_runs
from emrld_jax.analysis.loading import Loaded, Skipped, load_runs
from emrld_jax.analysis.page import write_report
from emrld_jax.runs.files import write_json, write_text
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.progress import tell
from emrld_jax.study import figures, tables
from emrld_jax.study.origin import origin
from emrld_jax.study.plan import MAIN, ReproduceConfig, Study, programs
from emrld_jax.study.programs import Program, is_evaluation

RESULTS, WEIGHTS = "results", "weights"  # names of the comparisons of algorithms, of weights
REPORTS = {RESULTS: "report.html", WEIGHTS: "weights.html"}
SEEDS = {RESULTS: "seeds.csv", WEIGHTS: "weights_seeds.csv"}


def draw(
    shown: Sequence[Study], left_out: Collection[Path], config: ReproduceConfig, console: Console
) -> bool:
    """Draws what is finished: the configuration's figures, and the tables of all; tells the rest.

    Args:
        shown: everything that figures and tables may show, whatever command has trained it.
        left_out: runs that are not to be shown.
        config: which figures to draw, and where.
        console: where it is told.

    Returns:
        Whether there was something to draw, and nothing of it is damaged.

    Raises:
        OSError: a file cannot be written.
    """
    out, every = Path(config.out), programs(shown)
    loaded = _begun(every, left_out)
    damaged = [skipped for skipped in loaded.skipped if RunFolder(skipped.path).finished]
    for skipped in loaded.skipped:
        remedy = _remedy(skipped) if skipped in damaged else ""
        tell(console, f"left out: {skipped.path}: {skipped.reason}{remedy}")
    if not loaded.runs:
        tell(console, f"{out}: nothing is finished yet: no figure is drawn")
        return False
    for study in shown:
        if config.figure in (study.figure, "all"):
            groups = _grouped(loaded, study.programs).groups
            for note in _draw(study.figure, groups, out):
                tell(console, note)
    for name, own in _reports(shown, loaded).items():
        _write_report(name, _grouped(loaded, own), out, console)
    compared = _grouped(loaded, [p for p in every if p.runs.name == MAIN]).groups
    if compared:
        figures.draw_profiles(compared, out / "profiles")
        write_text(out / "improvements.md", tables.improvements_markdown(compared))
        _write_adaptation(compared, config, console)
    time = datetime.now(UTC).isoformat(timespec="seconds")
    file = out / "study.json"
    write_json(file, origin(file, loaded.runs, every, config.figure, time))
    pages = [name for name in REPORTS.values() if (out / name).is_file()]
    tell(console, f"{out}: figures, tables (.md, .csv), {', '.join(pages)}")
    return not damaged


def _remedy(damaged: Skipped) -> str:
    """What to do about a run that is finished and cannot be read."""
    file = RunFolder(damaged.path).results
    if damaged.reason.startswith(file.name):
        return f". Remove {file}: the command that trains the run then evaluates it again"
    return f". Move {damaged.path} away: the command that trains it then does so again"


def _draw(figure: str, groups: Sequence[Group], out: Path) -> list[str]:
    """One figure of the paper, if there is something to show; what to know of it."""
    path = out / figure
    if not groups:
        return [f"{figure}: nothing of it is finished"]
    if figure == "curves":
        for against in figures.AXES:
            figures.draw_curves(groups, against, path.with_name(f"{path.name}_{against}"))
    elif figure == "trajectories":
        return figures.draw_trajectories(figures.by_algorithm(groups), path)
    elif figure == "sensitivity":
        figures.draw_lines(figures.sensitivity_panels(groups), path)
    else:
        figures.draw_lines(figures.ablation_panels(groups), path)
    return []


def _reports(shown: Sequence[Study], loaded: Loaded) -> dict[str, list[Program]]:
    """The programs of each report: the comparison of algorithms, and that of weights.

    Apart, since settings that differ become a part of a line's name. The weights' has lines of the
    comparison, too, so there is none without a line of its own.
    """
    main = [p for p in programs(shown) if p.runs.name == MAIN]
    weights = programs([s for s in shown if s.figure in ("sensitivity", "ablation")])
    own = [p for p in weights if p.runs.name != MAIN]
    return {RESULTS: main, **({WEIGHTS: weights} if _grouped(loaded, own).groups else {})}


def _write_report(name: str, grouped: Grouped, out: Path, console: Console) -> None:
    """The tables and the page of one comparison, if it has a line."""
    if not grouped.groups:
        return
    write_text(out / f"{name}.csv", tables.results_csv(grouped.groups))
    write_text(out / f"{name}.md", tables.results_markdown(grouped.groups))
    write_text(out / SEEDS[name], tables.seeds_csv(grouped.groups))
    for note in write_report(grouped, out / REPORTS[name], f"Reproduction: {name}"):
        tell(console, f"note: {note}")


def _write_adaptation(groups: Sequence[Group], config: ReproduceConfig, console: Console) -> None:
    """Tables after each number of steps, if a run was evaluated so; how many were not."""
    steps, fast, name = config.steps, config.fast, "adaptation_steps"
    runs = [run for group in groups for run in group.runs]
    found = [any(is_evaluation(own, steps, fast=fast) for own in run.evaluations) for run in runs]
    if not steps or not any(found):
        return
    if not all(found):
        words = f"{found.count(False)} of {len(runs)} runs have no whole evaluation"
        tell(console, f"note: {name}: {words} after {steps} steps, and are left out")
    write_text(Path(config.out) / f"{name}.csv", tables.adaptation_csv(groups, steps, fast=fast))
    text = tables.adaptation_markdown(groups, steps, fast=fast)
    write_text(Path(config.out) / f"{name}.md", text)


def _begun(own: Sequence[Program], left_out: Collection[Path]) -> Loaded:
    """The programs' own runs, of those that have begun."""
    folders = [folder for program in own for folder in program.folders]
    begun = [folder.path for folder in folders if folder.config.is_file()]
    paths = [path for path in begun if path not in left_out]
    return load_runs(paths) if paths else Loaded([], [])


def _grouped(loaded: Loaded, own: Sequence[Program]) -> Grouped:
    """Those of the runs that belong to some programs."""
    paths = {folder.path for program in own for folder in program.folders}
    return group_runs(Loaded([run for run in loaded.runs if run.path in paths], []))
