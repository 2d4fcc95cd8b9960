"""Small made-up run folders, with all files that a finished run has."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emrld_jax.runs.config import TrainConfig, make_env
from emrld_jax.runs.episodes import KeptEpisodes, write_episodes
from emrld_jax.runs.saved import save_config
from emrld_jax.settings import with_values

MakeRun = Callable[..., Path]
ITERATIONS = 4


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Writes a run folder below `tmp_path` and returns it."""

    def make(name: str, **given: Any) -> Path:
        return write_run(tmp_path / name, **given)

    return make


def write_run(
    path: Path,
    *,
    seed: int = 0,
    value: float = 50.0,  # return after adaptation, on all tasks
    commit: str = "a" * 40,
    time: str = "2026-01-01T00:00:00+00:00",
    environment: str = "point2d",
    seconds: float = 2.0,  # of an iteration
    episodes: bool = False,
    **settings: Any,
) -> Path:
    """Writes a run folder; other settings by full name, with __ in place of a dot."""
    named = {key.replace("__", "."): new for key, new in settings.items()}
    chosen = {"env.name": environment, "seed": seed, "meta.iterations": ITERATIONS, **named}
    config = with_values(TrainConfig(), chosen)
    path.mkdir(parents=True)
    save_config(config, path / "config.yaml")
    lines = [metrics(i, value, seconds) for i in range(ITERATIONS)]
    (path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    write(path / "provenance.json", provenance(commit, time, seed))
    results = {"train": table(value, 100.0), "test": table(value - 10.0, 80.0)}
    write(path / "results.json", results)
    if episodes:
        write_kept(path / "episodes", config)
    return path


def write(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value))


def metrics(iteration: int, value: float, seconds: float) -> dict[str, float]:
    """Returns that rise to `value` by equal steps."""
    share = (iteration + 1) / ITERATIONS
    return {
        "iteration": iteration,
        "adapt/return_0": 0.0,
        "adapt/return_1": share * value,
        "adapt/success_0": 0.0,
        "adapt/success_1": share,
        "sampling/env_steps": 1000 * (iteration + 1),
        "time/iteration_s": seconds,
    }


def provenance(commit: str, time: str, seed: int) -> dict[str, Any]:
    return {
        "time": time,
        "command": f"python -m emrld_jax.train seed={seed}",
        "code": {"commit": commit, "dirty": False},
        "python": "3.12.0",
        "packages": {"jax": "0.10.2"},
        "machine": {"cpu": "a processor", "device": "cpu"},
        "demos": {"path": "x.npz", "sha256": "f" * 64},
        "resumed": [],
    }


def table(value: float, demonstrated: float) -> dict[str, Any]:
    """A part of results.json, of two stages."""
    stages = [
        {"adaptation_steps": 0, "return": 0.0, "success": 0.0},
        {"adaptation_steps": 1, "return": value, "success": 0.5},
    ]
    shown = {"return": demonstrated, "success": 1.0}
    return {"tasks": 2, "episodes": 3, "stages": stages, "demonstrations": shown}


def write_kept(folder: Path, config: TrainConfig) -> None:
    """Paths of two tasks that come the closer to their goals the more iterations are done."""
    env = make_env(config.env)
    for iteration in (0, 2, ITERATIONS):
        kept = kept_episodes(iteration / ITERATIONS)
        splits = {"train": kept, "test": kept} if iteration == ITERATIONS else {"train": kept}
        name = "final" if iteration == ITERATIONS else str(iteration)
        folder.mkdir(exist_ok=True)
        write_episodes(folder / f"{name}.npz", env, splits, iteration)


def kept_episodes(share: float) -> KeptEpisodes:
    """One episode of 3 steps of each of two tasks, straight to a share of the way to the goal."""
    aim = np.array([[2.0, 0.0], [0.0, 2.0]], np.float32)
    along = np.linspace(0, 1, 4)[None, None, None, :, None]
    path = np.broadcast_to(aim[:, None, None, None] * along * share, (2, 2, 1, 4, 2)).copy()
    path[:, 0] = 0.0  # nobody moves before adaptation
    reward = np.zeros((2, 2, 1, 3))
    reward[:, 1, :, 2] = share
    demo = aim[:, None] * np.linspace(0, 1, 5)[None, :, None]
    demo[1, 3:] = np.nan  # the second is shorter
    return KeptEpisodes(
        np.array([0, 7]), aim, path.astype(np.float16), reward.astype(np.float16), demo
    )
