"""Where a study's figures come from and what they took: `study.json`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from emrld_jax.analysis.loading import Run
from emrld_jax.runs.provenance import code_version, machine, typed_command
from emrld_jax.study.programs import Program
from emrld_jax.study.running import took


def origin(
    before: Path, runs: Sequence[Run], shown: Sequence[Program], what: str, time: str
) -> dict[str, Any]:
    """What `study.json` holds.

    Args:
        before: the file as an earlier command has left it, whose commands are kept.
        runs: what is drawn.
        shown: the programs that runs may be of.
        what: the figures that this command draws.
        time: of now.
    """
    paths = {run.path for run in runs}
    own = [p for p in shown if paths & {folder.path for folder in p.folders}]
    hours, counted = took(own[0].runs.parent, own)
    command = {"command": typed_command(), "time": time, "figure": what}
    others = [each for each in _commands(before) if each["command"] != command["command"]]
    return {
        "commands": [*others, command],
        "machines": _distinct(each["machine"] for each in _records(runs) if "machine" in each),
        "commits": sorted({commit for run in runs for commit in run.commits}),
        "seeds": len({run.seed for run in runs}),
        "runs": len(runs),
        "env_steps": sum(float(run.metrics["sampling/env_steps"][-1]) for run in runs),
        **hours,
        "hours_of": f"{counted} of {len(own)} programs",
        "drawn": {"time": time, "machine": machine(), "code": code_version()},
    }


def _commands(before: Path) -> list[dict[str, Any]]:
    """What earlier commands were; a file of before there was a list of them tells of one."""
    try:
        found = json.loads(before.read_text())
        listed = found["commands"] if "commands" in found else [{"command": found["command"]}]
        return [each for each in listed if isinstance(each["command"], str)]
    except (OSError, ValueError, TypeError, KeyError):
        return []  # none is there, or it is damaged


def _records(runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Of how each run began, and went on."""
    return [each for run in runs for each in (run.provenance, *run.provenance["resumed"])]


def _distinct(values: Iterable[Any]) -> list[Any]:
    return list({json.dumps(value, sort_keys=True): value for value in values}.values())
