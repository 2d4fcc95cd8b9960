"""What a study leaves behind: figures, tables, where all of it comes from, and the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from emrld_jax.analysis.groups import Grouped, group_runs
from emrld_jax.analysis.loading import Loaded, Run, load_runs
from emrld_jax.analysis.page import write_report
from emrld_jax.runs.files import write_json, write_text
from emrld_jax.runs.progress import tell
from emrld_jax.runs.provenance import machine, typed_command
from emrld_jax.study import figures, tables
from emrld_jax.study.plan import MAIN, ReproduceConfig, Study
from emrld_jax.study.programs import Program


def draw(planned: Sequence[Study], config: ReproduceConfig, console: Console) -> None:
    """Draws what is finished of the planned runs, and no others; tells what is missing.

    Raises:
        OSError: a file cannot be written.
    """
    out = Path(config.out)
    grouped = _finished([program for study in planned for program in study.programs])
    for path, reason in grouped.skipped:
        tell(console, f"left out: {path}: {reason}")
    for note in grouped.notes:
        tell(console, f"note: {note}")
    if not grouped.groups:
        tell(console, "nothing is finished yet: no figure is drawn")
        return
    for study in planned:
        _draw(study, out / study.figure)
    compared = _finished(_main(planned)).groups
    write_text(out / "results.csv", tables.results_csv(grouped.groups))
    write_text(out / "results.md", tables.results_markdown(grouped.groups))
    write_text(out / "improvements.md", tables.improvements_markdown(compared))
    write_json(out / "study.json", _origin(grouped, config))
    write_report(grouped, out / "report.html", "Reproduction of the paper's figures")
    tell(console, f"{out}: figures, tables (results.md, results.csv), report.html")


def _draw(study: Study, path: Path) -> None:
    """One figure of the paper, from those of its runs that are finished."""
    groups = _finished(study.programs).groups
    if not groups:
        return
    if study.figure == "curves":
        for against in figures.AXES:
            figures.draw_curves(groups, against, path.with_name(f"{path.name}_{against}"))
    elif study.figure == "trajectories":
        figures.draw_trajectories(figures.by_algorithm(groups), path)
    elif study.figure == "sensitivity":
        figures.draw_lines(figures.sensitivity_panels(groups), path)
    else:
        figures.draw_lines(figures.ablation_panels(groups), path)


def _main(planned: Sequence[Study]) -> list[Program]:
    """Programs of the comparison of algorithms, which have no settings of their own."""
    return [p for study in planned for p in study.programs if p.runs.name == MAIN]


def _finished(programs: Sequence[Program]) -> Grouped:
    """The programs' own runs, of those that have begun."""
    folders = [folder for program in dict.fromkeys(programs) for folder in program.folders]
    begun = [folder.path for folder in folders if folder.config.is_file()]
    return group_runs(load_runs(begun) if begun else Loaded([], []))


def _origin(grouped: Grouped, config: ReproduceConfig) -> dict[str, object]:
    """Where the figures come from, and what they took."""
    runs = [run for group in grouped.groups for run in group.runs]
    return {
        "command": typed_command(),
        "machine": machine(),
        "commits": sorted({commit for run in runs for commit in run.commits}),
        "seeds": config.seeds,
        "runs": len(runs),
        "lines": len(grouped.groups),
        "env_steps": sum(float(run.metrics["sampling/env_steps"][-1]) for run in runs),
        "core_hours_of_training": sum(_seconds(runs)) / 3600,
    }


def _seconds(runs: Sequence[Run]) -> list[float]:
    """Of each program: runs that trained side by side have one clock."""
    clocks = {run.metrics["time/iteration_s"].tobytes(): run.seconds for run in runs}
    return list(clocks.values())
