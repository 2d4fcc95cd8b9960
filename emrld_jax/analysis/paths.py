"""Kept episodes of runs, packed for the report page: points as 16-bit whole numbers in base 64."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from emrld_jax.analysis.groups import Group
from emrld_jax.analysis.loading import Run
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.episodes import FINAL, KeptEpisodes, read_episodes
from emrld_jax.runs.folder import RunFolder

RUNS_DRAWN = 3  # of a group, those of the first seeds: the page must stay small
FRAMES = 40  # moments of a run that a slider goes through, at the most
LARGEST = 32000  # of a packed number; what is further below it stands for the end of an episode
ENDED = -32768


def drawn_runs(groups: Sequence[Group]) -> tuple[list[dict[str, Any]], list[str]]:
    """The episodes of some runs of each group as JSON values, and notes on what is missing."""
    drawn, notes = [], []
    for number, group in enumerate(groups):
        for run in group.runs[:RUNS_DRAWN]:
            try:
                episodes = _episodes(run)
            except ConfigError as error:
                notes.append(str(error))
                continue
            if episodes:
                drawn.append({"group": number, "seed": run.seed, **episodes})
    return drawn, notes


def _episodes(run: Run) -> dict[str, Any]:
    """All that is kept of a run; empty if nothing is.

    Raises:
        ConfigError: a file is damaged.
    """
    folder = RunFolder(run.path).episodes
    numbers = sorted(int(path.stem) for path in folder.glob("*.npz") if path.stem.isdecimal())
    chosen = np.linspace(0, len(numbers) - 1, min(FRAMES, len(numbers))).round().astype(int)
    files = [read_episodes(folder / f"{numbers[k]}.npz") for k in chosen]
    final = read_episodes(folder / f"{FINAL}.npz") if (folder / f"{FINAL}.npz").is_file() else None
    every = [*files, *([final] if final else [])]
    if files and final and final[0]["iteration"] > files[-1][0]["iteration"]:
        files.append((final[0], {"train": _like(final[1]["train"], files[-1][1]["train"])}))
    if not every:
        return {}
    about = every[0][0]
    return {
        "kind": str(about["kind"]),
        "zone": float(about["zone"]),
        "frames": [
            {"iteration": int(own["iteration"]), **packed(kept["train"])}
            for own, kept in files
            if "train" in kept
        ],
        "final": {split: packed(kept) for split, kept in (final[1] if final else {}).items()},
    }


def _like(final: KeptEpisodes, kept: KeptEpisodes) -> KeptEpisodes:
    """Of the final evaluation, the tasks and as many episodes as were kept before."""
    rows, episodes = np.isin(final.task, kept.task), kept.path.shape[2]
    aim, path, reward, demo = (leaf[rows] for leaf in final[1:])
    return KeptEpisodes(final.task[rows], aim, path[:, :, :episodes], reward[:, :, :episodes], demo)


def packed(kept: KeptEpisodes) -> dict[str, Any]:
    """The episodes of one split as JSON values."""
    scale = _scale(kept.path, kept.demo)
    reward = kept.reward.astype(float)
    returns = np.where(np.isfinite(reward), reward, 0.0).sum(axis=-1)  # [M, 2, P]
    return {
        "scale": scale,
        "tasks": [int(number) for number in kept.task],
        "aims": np.round(kept.aim.astype(float), 4).tolist(),
        "shape": list(kept.path.shape[2:4]),  # episodes, points
        "path": _pack(kept.path, scale),
        "rewarded": _text((kept.reward > 0).astype(np.uint8)),
        "returns": np.round(returns, 1).tolist(),
        "demoPoints": int(kept.demo.shape[1]),
        "demo": _pack(kept.demo, scale),
    }


def _scale(*arrays: np.ndarray) -> float:
    """How much one step of a packed number is."""
    finite = [np.abs(array[np.isfinite(array)].astype(float)) for array in arrays]
    return max(1e-6, *(float(own.max(initial=0.0)) for own in finite)) / LARGEST


def _pack(points: np.ndarray, scale: float) -> str:
    numbers = points.astype(float) / scale
    there = np.isfinite(numbers)
    whole = np.clip(np.where(there, numbers, 0.0).round(), -LARGEST, LARGEST)
    return _text(np.where(there, whole, ENDED).astype("<i2"))


def _text(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode()
