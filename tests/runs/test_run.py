"""A training run's files, and that a resumed run is the uninterrupted one bit for bit."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
import yaml

from emrld_jax.runs.episodes import read_episodes
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.saved import load_config
from tests.conftest import Command
from tests.runs.conftest import TINY
from tests.runs.straight import write_demos

WRITING = "checkpoints/2.*"  # the name of a checkpoint while it is being written

WholeRun = tuple[Path, str]


def without_times(folder: Path) -> list[dict[str, Any]]:
    """The metrics of a run, apart from how long things took."""
    records = read_metrics(folder / "metrics.jsonl")
    return [{k: v for k, v in r.items() if not k.startswith("time/")} for r in records]


def last_state(folder: Path) -> list[np.ndarray]:
    """All arrays of the last checkpoint."""
    manager = ocp.CheckpointManager(
        (folder / "checkpoints").absolute(), options=ocp.CheckpointManagerOptions(read_only=True)
    )
    tree = manager.restore(3, args=ocp.args.StandardRestore())
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def assert_same_run(folder: Path, whole: Path) -> None:
    """Metrics, state, results and kept episodes are equal, bit for bit."""
    assert without_times(folder) == without_times(whole)
    for ours, theirs in zip(last_state(folder), last_state(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (folder / "results.json").read_text() == (whole / "results.json").read_text()
    names = {path.name for path in (whole / "episodes").iterdir()}
    assert {path.name for path in (folder / "episodes").glob("*.npz")} == names
    for name in names:
        kept, expected = (read_episodes(run / "episodes" / name)[1] for run in (folder, whole))
        jax.tree.map(np.testing.assert_array_equal, kept, expected)


@pytest.fixture
def start(environment: dict[str, str], demos: Path, tmp_path: Path) -> Any:
    """Starts the tiny run in the background: the process, and its folder once that is there."""

    def begin() -> tuple[subprocess.Popen[str], Path]:
        process = subprocess.Popen(
            [sys.executable, "-m", "emrld_jax.train", f"demos={demos}", f"runs={tmp_path}", *TINY],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        return process, tmp_path / "point2d" / "emrld-lines" / "seed0"

    return begin


def wait_for(folder: Path, pattern: str, process: subprocess.Popen[str]) -> None:
    """Returns at once when a file of this pattern appears."""
    while not any(folder.glob(pattern)):
        assert process.poll() is None, "the run ended before it could be stopped"
        time.sleep(0.0005)


def test_a_run_writes_all_its_files(whole_run: WholeRun) -> None:
    folder, output = whole_run
    for name in (
        "config.yaml",
        "provenance.json",
        "metrics.jsonl",
        "results.json",
        "checkpoints/3",
        *(f"episodes/{name}.npz" for name in (0, 1, 2, 3, "final")),
        "learning_curve.png",
        "learning_curve.svg",
        "trajectories.png",
        "trajectories.svg",
    ):
        assert (folder / name).exists(), name
    assert any((folder / "tensorboard").iterdir())
    assert "held-out (2)" in output
    assert str(folder) in output


def test_metrics_have_a_line_an_iteration(whole_run: WholeRun) -> None:
    records = read_metrics(whole_run[0] / "metrics.jsonl")
    assert [record["iteration"] for record in records] == [0, 1, 2]
    # 3 tasks, 2 episodes, 20 steps, before and after adaptation
    assert [record["sampling/env_steps"] for record in records] == [240, 480, 720]
    expected = {"adapt/return_0", "adapt/return_1", "adapt/success_1", "outer/kl"}
    assert expected | {"time/iteration_s"} <= records[0].keys()


def test_the_configuration_is_resolved(whole_run: WholeRun, demos: Path) -> None:
    config = load_config(whole_run[0] / "config.yaml")
    assert config.w_rl == 0.2
    assert config.demos == str(demos)
    assert config.adapt.num_episodes == 2
    assert yaml.safe_load((whole_run[0] / "config.yaml").read_text())["env"]["name"] == "point2d"


def test_provenance(whole_run: WholeRun, demos: Path) -> None:
    record = json.loads((whole_run[0] / "provenance.json").read_text())
    assert record["demos"]["path"] == str(demos)
    assert len(record["demos"]["sha256"]) == 64
    assert record["packages"]["jax"] == jax.__version__
    assert {"commit", "dirty"} == record["code"].keys()
    assert record["machine"]["cores"] >= 1
    assert "meta.iterations=3" in record["command"]


def test_sigterm_saves_and_the_run_goes_on_bit_for_bit(
    start: Any, command: Command, whole_run: WholeRun
) -> None:
    process, folder = start()
    wait_for(folder, "provenance.json", process)
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 143, errors
    assert "finishing this iteration, then saving" in errors
    assert f"python -m emrld_jax.train resume={folder}" in output
    assert not (folder / "results.json").exists()
    assert len(read_metrics(folder / "metrics.jsonl")) < 3

    done = command("train", f"resume={folder}")
    assert done.returncode == 0, done.stderr
    assert_same_run(folder, whole_run[0])
    assert len(json.loads((folder / "provenance.json").read_text())["resumed"]) == 1


def test_kill_in_the_middle_of_a_checkpoint(
    start: Any, command: Command, whole_run: WholeRun
) -> None:
    for _ in range(5):  # until a kill comes before the checkpoint is whole
        process, folder = start()
        wait_for(folder, WRITING, process)
        process.kill()
        process.communicate(timeout=60)
        assert process.returncode == -signal.SIGKILL
        if any(folder.glob(WRITING)):
            break
        shutil.rmtree(folder)
    assert any(folder.glob(WRITING)), "no kill came in the middle of a checkpoint"
    assert not (folder / "checkpoints" / "2").exists()

    done = command("train", f"resume={folder}")
    assert done.returncode == 0, done.stderr
    assert_same_run(folder, whole_run[0])


def cut_in_half(checkpoint: Path) -> None:
    """Breaks all files of a checkpoint."""
    for file in checkpoint.rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def files_of(folder: Path) -> dict[str, bytes]:
    """The contents of all files, apart from the lock."""
    files = (file for file in folder.rglob("*") if file.is_file() and file.name != ".lock")
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def damage_checkpoints(folder: Path) -> None:
    for step in ("2", "3"):
        cut_in_half(folder / "checkpoints" / step)


def damage_metrics(folder: Path) -> None:
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    (folder / "metrics.jsonl").write_text("\n".join([lines[0], "{", lines[2], ""]))


DAMAGES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("checkpoints broken", damage_checkpoints, "none of the checkpoints can be read"),
    ("checkpoints gone", lambda f: shutil.rmtree(f / "checkpoints"), "has no checkpoint, though"),
    ("metrics", damage_metrics, "metrics.jsonl, line 2"),
    ("metrics gone", lambda f: (f / "metrics.jsonl").unlink(), "does not tell of the 3 iterations"),
    ("provenance", lambda f: (f / "provenance.json").write_text("{}"), "provenance.json must have"),
    (
        "configuration",
        lambda f: (f / "config.yaml").write_text(""),
        "config.yaml lacks algo, demos",
    ),
]


@pytest.mark.parametrize(
    ("damage", "said"), [each[1:] for each in DAMAGES], ids=[each[0] for each in DAMAGES]
)
def test_a_damaged_run_is_refused_and_left_as_it_is(
    command: Command,
    whole_run: WholeRun,
    tmp_path: Path,
    damage: Callable[[Path], Any],
    said: str,
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(whole_run[0], folder)
    (folder / "results.json").unlink()
    damage(folder)
    before = files_of(folder)
    done = command("train", f"resume={folder}")
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert files_of(folder) == before


def test_a_broken_newest_checkpoint_falls_back_to_the_one_before(
    command: Command, whole_run: WholeRun, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(whole_run[0], folder)
    (folder / "results.json").unlink()
    cut_in_half(folder / "checkpoints" / "3")

    done = command("train", f"resume={folder}")
    assert done.returncode == 0, done.stderr
    assert "checkpoint 3 cannot be read" in done.stdout
    assert "after iteration 2" in done.stdout
    assert_same_run(folder, whole_run[0])


def test_a_finished_run_says_so(command: Command, whole_run: WholeRun) -> None:
    before = (whole_run[0] / "provenance.json").read_text()
    done = command("train", f"resume={whole_run[0]}")
    assert done.returncode == 0, done.stderr
    assert "is finished: 3 meta-iterations" in done.stdout
    assert "meta.iterations=MORE" in done.stdout
    assert (whole_run[0] / "provenance.json").read_text() == before


def test_fewer_iterations_than_done_are_refused(command: Command, whole_run: WholeRun) -> None:
    done = command("train", f"resume={whole_run[0]}", "meta.iterations=2")
    assert done.returncode == 2
    assert "has done 3 already" in done.stderr


def test_resume_changes_nothing_else(command: Command, whole_run: WholeRun) -> None:
    done = command("train", f"resume={whole_run[0]}", "meta.max_kl=0.02")
    assert done.returncode == 2
    assert "meta.max_kl cannot be changed" in done.stderr
    assert "meta.iterations" in done.stderr


def test_changed_demonstrations_are_refused(
    command: Command, whole_run: WholeRun, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(whole_run[0], folder)
    other = write_demos(tmp_path / "lines.npz", num_train=2)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump({**config, "demos": str(other)}))
    done = command("train", f"resume={folder}")
    assert done.returncode == 2
    assert "has changed since" in done.stderr


def test_divergence_ends_with_a_message(command: Command, demos: Path, tmp_path: Path) -> None:
    done = command("train", f"demos={demos}", f"runs={tmp_path}", *TINY, "adapt.learning_rate=1e38")
    assert done.returncode == 1, done.stderr
    assert "error: iteration 1 made" in done.stderr
    assert "Traceback" not in done.stderr
    folder = tmp_path / "point2d" / "emrld-lines" / "seed0"
    assert (folder / "checkpoints" / "0").is_dir()
    assert read_metrics(folder / "metrics.jsonl") == []


def test_a_run_that_sees_no_reward_says_so_once(
    command: Command, demos: Path, tmp_path: Path
) -> None:
    """In five steps no episode can come near a goal 2 m away."""
    arguments = (*TINY, "env.reward=sparse", "env.horizon=5", "meta.iterations=7")
    known = {a.split("=")[0]: a for a in arguments}.values()  # the last of each
    done = command("train", "env=point2d", f"demos={demos}", f"runs={tmp_path}", *known)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("no reward after adaptation in 5 iterations") == 1
    records = read_metrics(tmp_path / "point2d" / "emrld-lines" / "seed0" / "metrics.jsonl")
    assert [record["outer/gradient_norm"] for record in records] == [0.0] * 7


def test_seeds_side_by_side_are_runs_of_their_own(
    command: Command, demos: Path, tmp_path: Path, whole_run: WholeRun
) -> None:
    """Seed 0 is what it is alone, up to rounding; seed 1 is another, and can go on alone."""
    arguments = ("env=point2d", f"demos={demos}", f"runs={tmp_path}", *TINY)
    done = command("train", *arguments, "num_seeds=2")
    assert done.returncode == 0, done.stderr
    folders = [tmp_path / "point2d" / "emrld-lines" / f"seed{seed}" for seed in range(2)]
    for seed, folder in enumerate(folders):
        config = yaml.safe_load((folder / "config.yaml").read_text())
        assert (config["seed"], config["num_seeds"]) == (seed, 1)
    together, other, alone = (
        read_metrics(folder / "metrics.jsonl") for folder in (*folders, whole_run[0])
    )
    for ours, expected in zip(together, alone, strict=True):
        # conjugate gradient magnifies rounding, by the second iteration to some thousandths
        rtol = 1e-5 if ours["iteration"] == 0 else 1e-2
        for name in ("adapt/return_0", "adapt/return_1"):
            np.testing.assert_allclose(ours[name], expected[name], rtol=rtol)
    assert [record["adapt/return_0"] for record in other] != [r["adapt/return_0"] for r in together]
    done = command("train", f"resume={folders[1]}", "meta.iterations=4")
    assert done.returncode == 0, done.stderr
    assert len(read_metrics(folders[1] / "metrics.jsonl")) == 4
