"""Runs of one program: numbers and seeds side by side."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

from emrld_jax.meta.learner import MetaState
from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.metrics import read_metrics
from tests.conftest import Command
from tests.runs.curves import NAMES, assert_other_curve, assert_same_curve


def test_numbers_and_seeds_side_by_side(
    command: Command, start: tuple[str, ...], alone: Path, tmp_path: Path
) -> None:
    """With w_rl = 0.2, the default, a run is what it is alone; with another value it is not."""
    varied = ("vmap.w_rl=[0.2,1.0]", "vmap.meta.max_kl=[0.01,0.03]", "num_seeds=2")
    done = command("train", *start, f"runs={tmp_path}", *varied)
    assert done.returncode == 0, done.stderr
    parent = tmp_path / "point2d" / "emrld-lines"
    folders = {
        (w, kl, seed): parent / f"w_rl={w:g},meta.max_kl={kl:g}" / f"seed{seed}"
        for w in (0.2, 1.0)
        for kl in (0.01, 0.03)
        for seed in (0, 1)
    }
    for (w, kl, seed), folder in folders.items():
        config = yaml.safe_load((folder / "config.yaml").read_text())
        assert (config["w_rl"], config["meta"]["max_kl"], config["seed"]) == (w, kl, seed)
        assert (config["vmap"], config["num_seeds"]) == ({}, 1)
        assert (folder / "results.json").is_file()
    assert_same_curve(folders[0.2, 0.03, 0], alone)
    for other in ((1.0, 0.03, 0), (0.2, 0.01, 0), (0.2, 0.03, 1)):
        assert_other_curve(folders[other], alone)
    assert "mean of 8 runs" in done.stdout


def test_runs_that_began_together_go_on_together(
    command: Command, start: tuple[str, ...], tmp_path: Path
) -> None:
    """Also where one of them was killed before its newest checkpoint."""
    arguments = (*start, f"runs={tmp_path}", "num_seeds=2", "vmap.w_bc=[0.2,1.0]")
    assert command("train", *arguments).returncode == 0
    parent = tmp_path / "point2d" / "emrld-lines"
    folders = [parent / f"w_bc={w}" / f"seed{seed}" for w in ("0.2", "1") for seed in (0, 1)]
    expected = [read_metrics(folder / "metrics.jsonl") for folder in folders]
    for folder in folders:
        (folder / "results.json").unlink()
    newest = folders[0] / "checkpoints" / "3"
    newest.rename(tmp_path / "aside")
    done = command("train", f"resume={parent}")
    assert done.returncode == 0, done.stderr
    assert "after iteration 2" in done.stdout
    for folder, records in zip(folders, expected, strict=True):
        again = read_metrics(folder / "metrics.jsonl")
        assert [r[NAMES[1]] for r in again] == [r[NAMES[1]] for r in records]
        assert (folder / "results.json").is_file()
    # what was ahead of the others was done again, and so was its checkpoint
    assert all((folder / "checkpoints" / "3").is_dir() for folder in folders)


def test_runs_to_continue_may_be_named_and_must_fit(
    command: Command, alone: Path, tmp_path: Path
) -> None:
    """Two of three unfinished runs; the third has another activation."""
    first, second, other = (tmp_path / name for name in ("first", "second", "other"))
    for folder in (first, second, other):
        shutil.copytree(alone, folder)
        (folder / "results.json").unlink()
    config = yaml.safe_load((other / "config.yaml").read_text())
    config["policy"]["activation"] = "relu"
    (other / "config.yaml").write_text(yaml.safe_dump(config))
    done = command("train", f"resume={tmp_path}")
    assert done.returncode == 2
    assert "policy.activation is tanh and relu" in done.stderr
    assert str(other) in done.stderr
    done = command("train", f"resume={first}:{second}", "meta.iterations=4")
    assert done.returncode == 0, done.stderr
    assert [len(read_metrics(f / "metrics.jsonl")) for f in (first, second, other)] == [4, 4, 3]


def test_checkpoints_ahead_of_where_runs_go_on_are_dropped(tmp_path: Path) -> None:
    params = {"w": np.zeros(3, np.float32)}
    key = jax.random.key_data(jax.random.key(0))
    runs = [Progressed(MetaState(params, ()), key, step, 0) for step in (10, 15, 20)]
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        checkpoints.save(runs[0])
        checkpoints.save(runs[2])
        with pytest.raises(OSError, match="a later iteration than 15"):
            checkpoints.save(runs[1])
        checkpoints.drop_after(10)
        checkpoints.save(runs[1])
        restored = checkpoints.restore(runs[0], print)
    assert restored is not None
    assert restored.iteration == 15


def test_one_run_that_diverges_leaves_the_others_a_way_on(
    command: Command, start: tuple[str, ...], tmp_path: Path
) -> None:
    varied = "vmap.adapt.learning_rate=[0.005,1e38]"
    done = command("train", *start, f"runs={tmp_path}", varied)
    assert done.returncode == 1, done.stderr
    parent = tmp_path / "point2d" / "emrld-lines"
    healthy, diverged = (parent / f"adapt.learning_rate={x}" / "seed0" for x in ("0.005", "1e+38"))
    assert f"{diverged} diverged" in done.stdout
    assert "infinite or NaN" in json.loads((diverged / "diverged.json").read_text())["error"]
    assert not (healthy / "diverged.json").exists()
    assert f"resume={healthy}\n" in done.stdout
    assert f"resume={diverged}" not in done.stdout
    done = command("train", f"resume={healthy}")
    assert done.returncode == 0, done.stderr
