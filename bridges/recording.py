"""A recording: a folder with a bag for each episode and an index of them, written as they end.

An episode is there as a whole or not at all: killing the bridge loses the one that is being driven.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from bridges import bags
from bridges.bundle import Bundle
from bridges.episodes import SUCCESS, Episode
from bridges.files import write_bytes
from bridges.recording_checks import FORMAT, INDEX, VERSION, RecordingError, problem_of, read_index

WRITING = ".writing"  # a folder beside the bags, for the one that is being written


@dataclass(frozen=True)
class Header:
    """What all episodes of a recording share.

    Attributes:
        bundle: content hash of the bundle whose policy drove.
        environment: its name.
        task: the task's numbers.
        control_period: s.
        horizon: control steps of an episode at most.
        noise: the policy's noise was on; without it the episodes cannot be learned from.
        dry_run: nothing was sent to the robot.
        command_type: what the robot takes as commands.
        driving: settings that the driving depends on, as JSON values.
    """

    bundle: str
    environment: str
    task: dict[str, Any]
    control_period: float
    horizon: int
    noise: bool
    dry_run: bool
    command_type: str
    driving: dict[str, Any]


class Recording(NamedTuple):
    """A whole recording."""

    header: Header
    episodes: tuple[Episode, ...]  # their times count from their beginnings


def header_of(
    bundle: Bundle, *, noise: bool, dry_run: bool, command_type: str, driving: Mapping[str, Any]
) -> Header:
    """The header of a recording of this bundle's policy."""
    return Header(
        bundle=bundle.content_sha256,
        environment=bundle.environment.name,
        task=bundle.task,
        control_period=bundle.control_period,
        horizon=0 if bundle.zone is None else bundle.zone.horizon,
        noise=noise,
        dry_run=dry_run,
        command_type=command_type,
        driving=dict(driving),
    )


class Recorder:
    """Adds episodes to a recording, a new one or one that was begun before.

    Args:
        folder: of the recording.
        header: of what will be driven; a recording that was begun must have the same.

    Raises:
        RecordingError: the folder holds something else, or what is there is damaged.
    """

    def __init__(self, folder: Path, header: Header) -> None:
        bags.rosbags()  # whoever lacks it learns so before the robot drives
        self._folder, self._header = folder, header
        self._entries: list[dict[str, Any]] = []
        self.episodes: list[Episode] = []
        shutil.rmtree(folder / WRITING, ignore_errors=True)
        if not (folder / INDEX).exists():
            if folder.exists() and any(folder.iterdir()):
                raise RecordingError(f"{folder} is not empty, and no recording: it has no {INDEX}")
            return
        begun, episodes = read(folder)
        check_same(folder, begun, header)
        self._entries = read_index(folder)["episodes"]
        self.episodes = list(episodes)

    @property
    def whole(self) -> int:
        """How many whole episodes there are."""
        return sum(episode.whole for episode in self.episodes)

    def add(self, episode: Episode) -> None:
        """Writes an episode."""
        name = f"episode_{len(self._entries):03d}"
        partial, final = self._folder / WRITING / name, self._folder / name
        about = {"recording": asdict(self._header)}
        bags.write(partial, episode, self._header.command_type, about)
        file = partial / f"{name}.mcap"
        with file.open("rb+") as stream:
            os.fsync(stream.fileno())  # robots lose power
        shutil.rmtree(final, ignore_errors=True)  # of a bridge that was killed right here
        os.rename(partial, final)
        self._entries.append(_entry(name, final / file.name, episode))
        self.episodes.append(episode)
        index = {
            "format": FORMAT,
            "version": VERSION,
            **asdict(self._header),
            "episodes": self._entries,
        }
        write_bytes(self._folder / INDEX, (json.dumps(index, indent=2) + "\n").encode())
        shutil.rmtree(self._folder / WRITING, ignore_errors=True)


def read(folder: str | Path) -> Recording:
    """Reads a recording and checks all of it.

    Raises:
        RecordingError: it is none, or not whole; says what is wrong.
    """
    folder = Path(folder)
    index = read_index(folder)
    header = Header(**{name: index[name] for name in Header.__dataclass_fields__})
    return Recording(header, tuple(_read_episode(folder, header, e) for e in index["episodes"]))


def whole_episodes(recording: Recording) -> Sequence[Episode]:
    """The episodes that ended as the environment's do."""
    return [episode for episode in recording.episodes if episode.whole]


def total_return(episode: Episode) -> float:
    """Undiscounted."""
    return float(sum(step.reward for step in episode.steps))


def _entry(name: str, file: Path, episode: Episode) -> dict[str, Any]:
    return {
        "bag": name,
        "sha256": _sha256(file),
        "ending": episode.ending,
        "detail": episode.detail,
        "whole": episode.whole,
        "steps": len(episode.steps),
        "return": total_return(episode),
        "success": episode.ending == SUCCESS,
        "missed_deadlines": episode.missed,
    }


def _read_episode(folder: Path, header: Header, entry: Mapping[str, Any]) -> Episode:
    bag = folder / entry["bag"]
    file = bag / f"{entry['bag']}.mcap"
    if not file.is_file():
        raise RecordingError(f"{file} is missing")
    if _sha256(file) != entry["sha256"]:
        raise RecordingError(f"{file} was damaged or changed: it is not what {INDEX} says")
    episode, about = bags.read(bag)
    if about.get("recording") != asdict(header):
        raise RecordingError(f"{bag} is of another recording than {folder / INDEX} says")
    if (problem := problem_of(episode, header.horizon)) is not None:
        raise RecordingError(f"{bag}: {problem}")
    return episode


def check_same(folder: Path, begun: Header, header: Header) -> None:
    """Refuses to add to a recording what was driven otherwise.

    Raises:
        RecordingError: names the settings that differ.
    """
    if begun.bundle != header.bundle:
        raise RecordingError(f"{folder} is a recording of another bundle; choose another out=")
    before, now = _flat(begun), _flat(header)
    # robots have no settings of a simulation: that it is another robot says it all
    names = [name for name in now if name in before or not name.startswith("sim.")]
    differing = [
        f"{name}={before.get(name, 'unknown')}, not {now[name]}"
        for name in names
        if name not in before or before[name] != now[name]
    ]
    if differing:
        raise RecordingError(
            f"{folder} was recorded with {'; '.join(differing)}: give the same settings, or choose "
            "another out="
        )


def _flat(header: Header) -> dict[str, Any]:
    values = asdict(header)
    driving: dict[str, Any] = values.pop("driving")
    return {**values, **driving}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
