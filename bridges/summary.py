"""What episodes on a robot were like: a table for people, and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bridges.episodes import SUCCESS, Episode
from bridges.recording import Header, Recording, total_return

HEADINGS = (
    *("episode", "ending", "return", "path (m)", "goal after (s)", "steps"),
    *("missed deadlines", "odometry age (ms): median", "p99"),
)


def figures(episode: Episode, period: float) -> dict[str, Any]:
    """An episode's figures, as JSON values.

    Args:
        episode: what happened.
        period: s, of the policy's control.
    """
    ages = [step.age for step in episode.steps]
    late = [step.latency for step in episode.steps]
    success = episode.ending == SUCCESS
    return {
        "ending": episode.ending,
        "detail": episode.detail,
        "whole": episode.whole,
        "return": total_return(episode),
        "success": success,
        "steps": len(episode.steps),
        "path_length_m": path_length(episode),
        "time_to_goal_s": duration(episode, period) if success else None,
        "missed_deadlines": episode.missed,
        "odometry_age_s": _quantiles(ages),
        "command_latency_s": _quantiles(late),
    }


def path_length(episode: Episode) -> float:
    """m along the poses of the control steps."""
    points = np.array([*(step.obs for step in episode.steps), episode.last_pose])[:, :2]
    return float(np.sum(np.hypot(*np.diff(points.astype(float), axis=0).T)))


def duration(episode: Episode, period: float) -> float:
    """s from the first command to the end of the last step."""
    if not episode.steps:
        return 0.0
    return episode.steps[-1].time - episode.steps[0].time + period


def summarized(recording: Recording) -> dict[str, Any]:
    """A recording's figures, as JSON values; means are of its whole episodes."""
    each = [figures(episode, recording.header.control_period) for episode in recording.episodes]
    whole = [row for row in each if row["whole"]]
    steps = [step for episode in recording.episodes for step in episode.steps]
    times = [row["time_to_goal_s"] for row in whole if row["success"]]
    return {
        **_told(recording.header),
        "whole_episodes": len(whole),
        "success": _mean([float(row["success"]) for row in whole]),
        "return": _mean([row["return"] for row in whole]),
        "path_length_m": _mean([row["path_length_m"] for row in whole]),
        "time_to_goal_s": _mean(times),
        "missed_deadlines": sum(row["missed_deadlines"] for row in each),
        "odometry_age_s": _quantiles([step.age for step in steps]),
        "command_latency_s": _quantiles([step.latency for step in steps]),
        "episodes": each,
    }


def table(summary: dict[str, Any]) -> str:
    """A recording's figures in aligned columns."""
    rows = [_row(str(k), row) for k, row in enumerate(summary["episodes"])]
    mean = {**summary, "ending": f"{_percent(summary['success'])} success", "steps": None}
    rows.append(_row("all", mean))
    widths = [max(len(r[i]) for r in (HEADINGS, *rows)) for i in range(len(HEADINGS))]
    return "\n".join(
        "  ".join(text.rjust(width) for text, width in zip(r, widths, strict=True)).rstrip()
        for r in (HEADINGS, *rows)
    )


def line(number: int, of: int, episode: Episode, period: float) -> str:
    """An episode in a line."""
    row = figures(episode, period)
    age = row["odometry_age_s"]
    words = [f"episode {number} of {of}: {row['ending']} after {duration(episode, period):.1f} s"]
    words += [f"return {row['return']:.1f}", f"{row['path_length_m']:.2f} m"]
    words += [f"missed deadlines {row['missed_deadlines']}"]
    if age["median"] is not None:
        words += [f"odometry age {1e3 * age['median']:.0f} ms (p99 {1e3 * age['p99']:.0f})"]
    if row["detail"]:
        words += [row["detail"]]
    return ", ".join(words)


def _told(header: Header) -> dict[str, Any]:
    return {"bundle": header.bundle, "noise": header.noise, "dry_run": header.dry_run}


def _row(name: str, row: dict[str, Any]) -> tuple[str, ...]:
    age = row["odometry_age_s"]
    return (
        name,
        row["ending"],
        _number(row["return"], 1),
        _number(row["path_length_m"], 2),
        _number(row["time_to_goal_s"], 1),
        _number(row["steps"], 0),
        str(row["missed_deadlines"]),
        _number(None if age["median"] is None else 1e3 * age["median"], 1),
        _number(None if age["p99"] is None else 1e3 * age["p99"], 1),
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _quantiles(values: Sequence[float]) -> dict[str, float | None]:
    if not values:
        return {"median": None, "p99": None}
    return {"median": float(np.median(values)), "p99": float(np.quantile(values, 0.99))}
