"""Run folders: where a run writes, without ever overwriting another."""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from emrld_jax.runs.config import ConfigError, TrainConfig

NAMED = 32  # runs that one command names
DEPTH = 3  # levels below a folder that runs which began together are looked for


class RunFolder:
    """The files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.yaml"
        self.provenance = path / "provenance.json"
        self.metrics = path / "metrics.jsonl"
        self.tensorboard = path / "tensorboard"
        self.checkpoints = path / "checkpoints"
        self.episodes = path / "episodes"
        self.results = path / "results.json"
        self.diverged = path / "diverged.json"  # that it cannot go on, and why
        self.evaluations = path / "evaluations"

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end; its results are written last."""
        return self.results.is_file()

    @property
    def resume_command(self) -> str:
        """What continues the run."""
        return f"python -m emrld_jax.train resume={self.path}"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps other processes from training in this folder; a killed one releases it too.

        Raises:
            ConfigError: another process trains in it, or it cannot be written into.
        """
        try:
            lock = (self.path / ".lock").open("w")
        except OSError as error:
            raise ConfigError(f"{self.path} cannot be trained in: {error}") from error
        with lock as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(f"another process is training in {self.path}") from error
            yield


def run_folders(text: str) -> list[Path]:
    """The run folders that a path names: itself, or those up to DEPTH levels below it, by name.

    Several paths may be joined by the system's path separator (a colon), where no path has it.
    """
    if not Path(text).exists() and len(parts := text.split(os.pathsep)) > 1:
        return [path for part in parts for path in run_folders(part)]
    directory = Path(text)
    if (directory / "config.yaml").is_file():
        return [directory]
    patterns = ("*/" * depth + "config.yaml" for depth in range(1, DEPTH + 1))
    found = [path.parent for pattern in patterns for path in directory.glob(pattern)]
    runs = (path for path in found if (path / "provenance.json").is_file())
    return sorted(runs, key=_by_numbers) or [directory]


def _by_numbers(path: Path) -> list[tuple[float, str]]:
    """A key that sorts seed10 after seed9."""
    parts = re.split(r"(\d+(?:\.\d+)?)", str(path))
    return [(float(x), "") if i % 2 else (0.0, x) for i, x in enumerate(parts)]


def new_run_folder(config: TrainConfig, label: str) -> tuple[RunFolder, str]:
    """Makes runs/<env>/<algo>-<demos>/[<label>/]seed<k>/ and says what to know about it.

    With demonstrations of the outer loss's own it is <algo>-<demos>-outer-<these>. If there is such
    a run already, the new folder's name gets a number.
    """
    demos = Path(config.demos).stem
    if config.outer_demos is not None:
        demos += f"-outer-{Path(config.outer_demos).stem}"
    parent = Path(config.runs) / config.env.name / f"{config.algo}-{demos}" / label
    wanted = RunFolder(parent / f"seed{config.seed}")
    try:
        path = new_folder(wanted.path)
    except OSError as error:
        raise ConfigError(
            f"runs={config.runs}: no run folder can be made there ({error}); it must be a folder, "
            "or a path where one can be made"
        ) from error
    if path == wanted.path:
        return wanted, ""
    note = f"{wanted.path} exists"
    if not wanted.finished:
        note += f" and is unfinished (to continue it: {wanted.resume_command})"
    return RunFolder(path), f"{note}; this run goes to {path}"


def resume_commands(folders: Sequence[RunFolder]) -> list[str]:
    """What continues these runs: one command, of the folder that holds them and no others.

    If it holds other unfinished ones, all are named; many are continued one by one.
    """
    paths = [folder.path for folder in folders]
    if len(paths) == 1:
        return [folders[0].resume_command]
    holder = os.path.commonpath(paths)
    unfinished = {path for path in run_folders(holder) if not RunFolder(path).finished}
    if unfinished == set(paths):
        return [RunFolder(Path(holder)).resume_command]
    if len(paths) <= NAMED and not any(os.pathsep in str(path) for path in paths):
        return [f"python -m emrld_jax.train resume={os.pathsep.join(map(str, paths))}"]
    return [folder.resume_command for folder in folders]


def new_folder(wanted: Path) -> Path:
    """Makes the wanted folder, or the first of wanted_2, wanted_3, .. that does not exist."""
    wanted.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        path = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        try:
            path.mkdir()  # fails if it exists, also between two runs that start at once
        except FileExistsError:
            continue
        return path
    raise AssertionError("count() does not end")
