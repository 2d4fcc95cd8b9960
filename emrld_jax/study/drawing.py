"""What a study leaves behind: figures, tables, where all of it comes from, and the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from emrld_jax.analysis.groups import Group, Grouped, group_runs
from emrld_jax.analysis.loading import Loaded, Run, load_runs
from emrld_jax.analysis.page import write_report
from emrld_jax.runs.files import write_json, write_text
from emrld_jax.runs.progress import tell
from emrld_jax.runs.provenance import machine, typed_command
from emrld_jax.study import figures, tables
from emrld_jax.study.plan import MAIN, ReproduceConfig, Study, programs
from emrld_jax.study.programs import Program
from emrld_jax.study.running import took

RESULTS, WEIGHTS = "results", "weights"  # names of the comparisons of algorithms, of weights
REPORTS = {RESULTS: "report.html", WEIGHTS: "weights.html"}


def draw(planned: Sequence[Study], config: ReproduceConfig, console: Console) -> None:
    """Draws what is finished of the planned runs, and no others; tells what is missing.

    Raises:
        OSError: a file cannot be written.
    """
    out = Path(config.out)
    loaded = _begun(programs(planned))
    for path, reason in loaded.skipped:
        tell(console, f"left out: {path}: {reason}")
    if not loaded.runs:
        tell(console, "nothing is finished yet: no figure is drawn")
        return
    for study in planned:
        if groups := _grouped(loaded, study.programs).groups:
            for note in _draw(study.figure, groups, out / study.figure):
                tell(console, note)
    for name, own in _reports(planned).items():
        if (grouped := _grouped(loaded, own)).groups:
            for note in grouped.notes:
                tell(console, f"note: {note}")
            write_text(out / f"{name}.csv", tables.results_csv(grouped.groups))
            write_text(out / f"{name}.md", tables.results_markdown(grouped.groups))
            write_report(grouped, out / REPORTS[name], f"Reproduction: {name}")
    if compared := _grouped(loaded, _reports(planned)[RESULTS]).groups:
        write_text(out / "improvements.md", tables.improvements_markdown(compared))
        if config.steps:
            name = "adaptation_steps"
            write_text(
                out / f"{name}.csv", tables.adaptation_csv(compared, config.steps, fast=config.fast)
            )
            write_text(
                out / f"{name}.md",
                tables.adaptation_markdown(compared, config.steps, fast=config.fast),
            )
    write_json(out / "study.json", _origin(loaded.runs, planned, config))
    tell(console, f"{out}: figures, tables ({RESULTS}.md, .csv), {REPORTS[RESULTS]}")


def _draw(figure: str, groups: Sequence[Group], path: Path) -> list[str]:
    """One figure of the paper; what to know of it."""
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


def _reports(planned: Sequence[Study]) -> dict[str, list[Program]]:
    """The programs of each report: the comparison of algorithms, and that of weights.

    Apart, since settings that differ become a part of a line's name.
    """
    main = [p for p in programs(planned) if p.runs.name == MAIN]
    weights = [s for s in planned if s.figure in ("sensitivity", "ablation")]
    return {RESULTS: main, WEIGHTS: programs(weights)}


def _begun(own: Sequence[Program]) -> Loaded:
    """The programs' own runs, of those that have begun."""
    folders = [folder for program in own for folder in program.folders]
    paths = [folder.path for folder in folders if folder.config.is_file()]
    return load_runs(paths) if paths else Loaded([], [])


def _grouped(loaded: Loaded, own: Sequence[Program]) -> Grouped:
    """Those of the runs that belong to some programs."""
    paths = {folder.path for program in own for folder in program.folders}
    return group_runs(Loaded([run for run in loaded.runs if run.path in paths], []))


def _origin(
    runs: Sequence[Run], planned: Sequence[Study], config: ReproduceConfig
) -> dict[str, object]:
    """Where the figures come from, and what they took."""
    return {
        "command": typed_command(),
        "machine": machine(),
        "commits": sorted({commit for run in runs for commit in run.commits}),
        "seeds": config.seeds,
        "runs": len(runs),
        "env_steps": sum(float(run.metrics["sampling/env_steps"][-1]) for run in runs),
        **took(Path(config.out) / "runs", programs(planned)),
    }
