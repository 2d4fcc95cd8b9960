"""Compares runs on one page: `python -m emrld_jax.report runs out=report.html` (`--help`)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.help_texts import asks_for_help
from emrld_jax.runs.usage import usage


@dataclass
class ReportConfig:
    """All settings of a report."""

    out: str = setting("report.html", "file to write; one that is there is replaced")
    title: str | None = setting(None, "heading of the page; null: the folders' names")


def main() -> int:
    """Writes a report as the command line says."""
    arguments = sys.argv[1:]
    if asks_for_help(arguments):
        print(
            usage(
                "emrld_jax.report",
                "Compare the finished runs in some folders, on one page for a browser.",
                ("runs", "runs/point2d other/runs out=point2d.html"),
                ReportConfig(),
                {},
                operands="RUNS...",
            )
        )
        return 0
    folders, settings = split(arguments)
    config = cli.updated(ReportConfig(), cli.parse(settings, ReportConfig(), {}))
    if not folders:
        raise ConfigError("no folder is given: name those that hold runs, such as runs")
    return write(folders, config)


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Folders, and settings; an argument with = in it that is a folder is one."""
    folders = [text for text in arguments if "=" not in text or Path(text).is_dir()]
    return folders, [text for text in arguments if text not in folders]


def write(folders: Sequence[str], config: ReportConfig) -> int:
    """Reads the runs, writes the page, and tells what is left out of it, and its notes."""
    # only now, since it imports much: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.analysis.groups import group_runs  # noqa: PLC0415
    from emrld_jax.analysis.loading import load_runs  # noqa: PLC0415
    from emrld_jax.analysis.page import default_title, write_report  # noqa: PLC0415
    from emrld_jax.runs.progress import tell  # noqa: PLC0415

    console, out = Console(), Path(config.out)
    if out.is_dir():
        raise ConfigError(f"out={out} is a folder; it must be the file to write")
    grouped = group_runs(load_runs(folders))
    for path, reason in grouped.skipped:
        tell(console, f"left out: {path}: {reason}")
    if not grouped.groups:
        raise ConfigError(f"no finished run in {', '.join(folders)}")
    for note in write_report(grouped, out, config.title or default_title(folders)):
        tell(console, f"note: {note}")
    runs, lines = sum(len(group.runs) for group in grouped.groups), len(grouped.groups)
    tell(console, f"{out}: {runs} run{'s' * (runs > 1)} in {lines} line{'s' * (lines > 1)}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
