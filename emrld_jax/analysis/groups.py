"""Groups of runs that differ in nothing but their seed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from emrld_jax.analysis.loading import NONE, Loaded, Run, Skipped

# no part of what is trained: which run it is, where it computes and writes, how it is looked at
FREE = (
    *("seed", "runs", "resume", "num_seeds", "devices", "processes", "checkpoint_every", "demos"),
    "diagnostics",
)
FREE_SECTIONS = ("vmap", "distributed.")
DEMOS_FILE = "demonstrations' SHA-256"
OUTER_DEMOS, AS_DEMOS = "outer_demos", "as demos"  # a setting, and that it is not given
COMMIT = "commit"
NOT_THERE = "(not a setting then)"  # of a version that did not have it


class Group(NamedTuple):
    """Runs with the same settings, one a seed, sorted by seed."""

    environment: str
    demonstrations: str
    algorithm: str
    differing: dict[str, Any]  # settings in which it differs from others of these three names
    runs: tuple[Run, ...]
    commits: tuple[str, ...]

    @property
    def label(self) -> str:
        """The algorithm and what tells the group from others, such as emrld, w_rl=0.4."""
        settings = [f"{_last(name)}={_short(value)}" for name, value in self.differing.items()]
        return ", ".join([self.algorithm, *settings])

    @property
    def seeds(self) -> tuple[int, ...]:
        """The runs' seeds."""
        return tuple(run.seed for run in self.runs)

    @property
    def problem(self) -> tuple[str, str]:
        """What is learned: the environment and the demonstrations."""
        return self.environment, self.demonstrations


class Grouped(NamedTuple):
    """Groups, what was left out and what is to be known of them."""

    groups: list[Group]
    skipped: list[Skipped]
    notes: list[str]


def group_runs(loaded: Loaded) -> Grouped:
    """Groups runs by environment, demonstrations, algorithm and settings.

    A group may have runs of several commits, which a note tells; but if two of them share a seed,
    each commit makes a group of its own. Of two runs that differ in nothing the newer one stays:
    the other is no further sample, and is skipped.
    """
    skipped = list(loaded.skipped)
    alike: dict[str, list[Run]] = {}
    for run in loaded.runs:
        alike.setdefault(json.dumps([*_names(run), compared(run)], sort_keys=True), []).append(run)
    parts: list[tuple[list[Run], bool]] = []
    for runs in alike.values():
        kept = _without_repeats(runs, skipped)
        if len({run.seed for run in kept}) == len(kept):
            parts.append((kept, False))
            continue
        commits = dict.fromkeys(run.commits for run in kept)
        parts += [([run for run in kept if run.commits == own], True) for own in commits]
    groups = [
        _group(runs, [other for other, _ in parts if _names(other[0]) == _names(runs[0])], apart)
        for runs, apart in parts
    ]
    groups.sort(key=_order)
    return Grouped(groups, skipped, list(_notes(groups)))


def on_each_problem(groups: Sequence[Group]) -> list[Group]:
    """Groups without demonstrations once for each set of their environment's, if there is any.

    So an algorithm that takes none can stand beside those that take some.
    """
    sets: dict[str, dict[str, None]] = {}
    for group in groups:
        if group.demonstrations != NONE:
            sets.setdefault(group.environment, {})[group.demonstrations] = None
    every = [
        group._replace(demonstrations=own)
        for group in groups
        for own in (
            sets.get(group.environment, {NONE: None})
            if group.demonstrations == NONE
            else [group.demonstrations]
        )
    ]
    return sorted(every, key=_order)


def _order(group: Group) -> tuple:
    """By problem and label; those without demonstrations last."""
    return group.environment, group.demonstrations == NONE, group.demonstrations, group.label


def compared(run: Run) -> dict[str, Any]:
    """The settings that decide what is trained, with the content of the demonstrations."""
    settings = {
        name: value
        for name, value in run.settings.items()
        if name not in FREE and not name.startswith(FREE_SECTIONS)
    }
    outer = run.provenance.get(OUTER_DEMOS)
    name = Path(str(settings.get(OUTER_DEMOS))).stem
    settings[OUTER_DEMOS] = f"{name} {str(outer['sha256'])[:10]}" if outer else AS_DEMOS
    if run.demonstrations == NONE:
        return settings
    return {**settings, DEMOS_FILE: str(run.provenance["demos"]["sha256"])[:10]}


def differing_settings(runs: Sequence[Run]) -> list[str]:
    """Names of the compared settings that are not the same in all of these runs."""
    all_settings = [compared(run) for run in runs]
    names = dict.fromkeys(name for settings in all_settings for name in settings)
    return [name for name in names if len(_values(name, all_settings)) > 1]


def _values(name: str, all_settings: Sequence[dict[str, Any]]) -> set[str]:
    """All values of a setting. (Runs without demonstrations do not differ from others in them.)"""
    if name == DEMOS_FILE:
        all_settings = [settings for settings in all_settings if name in settings]
    return {json.dumps(own.get(name, NOT_THERE), sort_keys=True) for own in all_settings}


def _names(run: Run) -> tuple[str, str, str]:
    return run.environment, run.demonstrations, run.algorithm


def _without_repeats(runs: Iterable[Run], skipped: list[Skipped]) -> list[Run]:
    """The newest run of each seed and commit, by seed."""
    newest: dict[tuple, Run] = {}
    for run in sorted(runs, key=lambda run: str(run.provenance.get("time", ""))):
        key = (run.seed, run.commits)
        if (older := newest.get(key)) is not None:
            reason = f"a repeat of seed {run.seed}: {run.path} has the same settings and is newer"
            skipped.append(Skipped(older.path, reason))
        newest[key] = run
    return sorted(newest.values(), key=lambda run: run.seed)


def _group(runs: list[Run], siblings: list[list[Run]], apart: bool) -> Group:
    names = differing_settings([own[0] for own in siblings])
    settings = compared(runs[0])
    differing = {name: settings.get(name, NOT_THERE) for name in names}
    commits = tuple(dict.fromkeys(commit for run in runs for commit in run.commits))
    if apart:
        differing[COMMIT] = ", ".join(commits)
    return Group(*_names(runs[0]), differing, tuple(runs), commits)


def _notes(groups: Sequence[Group]) -> Iterable[str]:
    for group in groups:
        name = f"{group.environment}, {group.demonstrations}, {group.label}"
        if len(group.commits) > 1:
            yield f"{name}: runs of different commits together ({', '.join(group.commits)})"
    if any(commit.endswith("+") for group in groups for commit in group.commits):
        yield "A plus after a commit: the code had changes that were not committed"
    for problem in dict.fromkeys(group.problem for group in groups):
        commits = dict.fromkeys(c for g in groups if g.problem == problem for c in g.commits)
        mixed = any(len(g.commits) > 1 for g in groups if g.problem == problem)
        if len(commits) > 1 and not mixed:
            yield f"{', '.join(problem)}: lines are of different commits ({', '.join(commits)})"
    few = [group for group in groups if len(group.runs) < 4]
    if few:
        yield (
            f"{len(few)} of {len(groups)} lines have fewer than 4 seeds: their interquartile mean "
            "is the mean, and bootstrap intervals of so few are too narrow"
        )


def _last(name: str) -> str:
    return "demos" if name == DEMOS_FILE else name.rpartition(".")[2]


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
