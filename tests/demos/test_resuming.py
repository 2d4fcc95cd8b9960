"""Experts whose training is stopped: it goes on, and ends as if it had not been."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console

import envs_jax
from emrld_jax import demos
from emrld_jax.demos import expert as expert_module
from emrld_jax.demos import making
from emrld_jax.demos.expert import Expert, expert
from emrld_jax.demos.making import Standing, Training
from emrld_jax.runs import experts
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.experts import kept_training
from envs_jax import Env

SETTINGS = {"env": "point2d", "seed": 3}
TASKS = jax.tree.map(lambda x: x[::6], envs_jax.make("point2d").train_tasks())
CONSOLE = Console(quiet=True)
ENOUGH = 4  # iterations that the expert needs that stops as soon as it is good enough


class KilledError(Exception):
    """Ends a training as a kill does: nothing is saved any more."""


@cache
def tiny(env: Env) -> Expert:
    """Kept, so that it compiles once for all trainings."""
    return expert(env, num_episodes=2, value_steps=2)


def content(params: Any) -> bytes:
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params))


class Trainings:
    """Trainings of a tiny expert that is taken as it is, not what it plays."""

    def __init__(self, quality: str, patch: pytest.MonkeyPatch) -> None:
        self.quality, self.told = quality, list[tuple[str, int]]()
        self._after: dict[bytes, int] = {}  # iterations that parameters have had
        patch.setattr(expert_module, "HIDDEN_SIZES", (4, 4))
        patch.setattr(experts, "EVERY", 2)
        patch.setattr(making, "first_that_fits", lambda name, quality, policy, params, *_: params)
        patch.setattr(making, "has_quality", lambda env, quality, params: self._fits(params))

    def _fits(self, params: Any) -> Any:
        return np.array([self._after[content(params)] >= ENOUGH])

    def train(self, path: Path, killed_at: int | None = None) -> Any:
        """The parameters at the end of a training that is kept."""
        short, way = Training(3, 4, tiny), making.after_training
        if self.quality == "suboptimal":
            short, way = Training(9, 0, tiny, try_every=2), making.once_it_fits
        train_key, play_key = jax.random.split(jax.random.key(3))
        with kept_training(path, SETTINGS, CONSOLE) as kept:

            def report(reward: str, standing: Standing, metrics: Any) -> None:
                kept.keep(standing)
                self.told.append((reward, standing.iteration))
                self._after[content(standing.state.policy)] = standing.iteration
                if standing.iteration == killed_at:
                    raise KilledError

            given = (TASKS, train_key, play_key, short)
            return way("point2d", self.quality, *given, report, kept.restore)


@pytest.mark.parametrize("quality", ["optimal", "suboptimal"])
def test_a_killed_training_ends_as_the_whole_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quality: str
) -> None:
    """Killed before its first checkpoint, between two and right after one."""
    trainings = Trainings(quality, monkeypatch)
    whole, expected = trainings.train(tmp_path / "whole.npz"), trainings.told
    last = {"optimal": 3 + 4, "suboptimal": ENOUGH}[quality]
    assert [number for _, number in expected] == list(range(1, last + 1))
    assert ("sparse", 4) in expected or quality == "suboptimal"
    assert not list(tmp_path.iterdir())  # what was kept is gone

    trainings.told = []
    for number in (1, 3, 4):
        with pytest.raises(KilledError):
            trainings.train(tmp_path / "killed.npz", killed_at=number)
    found = trainings.train(tmp_path / "killed.npz")
    jax.tree.map(np.testing.assert_array_equal, found, whole)
    numbers = [number for _, number in trainings.told]
    assert numbers == [1, 1, 2, 3, 3, 4, *range(5, last + 1)]
    assert set(trainings.told) == set(expected)
    assert not list(tmp_path.iterdir())


def test_another_training_is_not_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    with pytest.raises(KilledError), kept_training(path, SETTINGS, CONSOLE):
        raise KilledError
    about = tmp_path / "x.npz.training" / "training.json"
    assert json.loads(about.read_text())["settings"] == SETTINGS
    with (
        pytest.raises(ConfigError, match=r"stopped training with seed=3, not 4: .*out=PATH"),
        kept_training(path, {**SETTINGS, "seed": 4}, CONSOLE),
    ):
        pass
    about.write_text("{")
    with (
        pytest.raises(ConfigError, match=r"training\.json cannot be read"),
        kept_training(path, SETTINGS, CONSOLE),
    ):
        pass
    about.unlink()
    with (
        kept_training(path, SETTINGS, CONSOLE),
        pytest.raises(ConfigError, match="another process"),
        kept_training(path, SETTINGS, CONSOLE),
    ):
        pass
    assert not about.parent.exists()


def test_a_refused_expert_leaves_nothing_behind(tmp_path: Path) -> None:
    with (
        pytest.raises(demos.DemoError),
        kept_training(tmp_path / "x.npz", SETTINGS, CONSOLE),
    ):
        raise demos.DemoError("bad")
    assert not list(tmp_path.iterdir())
