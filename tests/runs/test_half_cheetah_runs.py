"""Runs whose physics is a call out of the compiled program: seeds, devices, resuming, pictures."""

from __future__ import annotations

import os
import shutil
from ctypes.util import find_library
from pathlib import Path

import numpy as np
import pytest

from emrld_jax.runs.camera import SOFTWARE
from tests.conftest import Command
from tests.runs.conftest import SHORT, TINY
from tests.runs.curves import assert_same_curve
from tests.runs.test_run import assert_same_run

START = ("env=half_cheetah", *TINY, SHORT)


@pytest.fixture(scope="session")
def alone(command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of seed 0 on one device."""
    runs = tmp_path_factory.mktemp("cheetah")
    done = command("train", *START, f"runs={runs}")
    assert done.returncode == 0, done.stderr
    assert "warning" not in (done.stderr + done.stdout).lower()
    return runs / "half_cheetah" / "emrld-optimal" / "seed0"


def test_devices_share_tasks_and_seeds(command: Command, alone: Path, tmp_path: Path) -> None:
    done = command("train", *START, f"runs={tmp_path}", "num_seeds=2", "devices=4")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "half_cheetah" / "emrld-optimal" / "seed0"
    assert_same_curve(folder, alone, later=1e-2)  # contacts magnify rounding


def test_a_resumed_run_is_the_uninterrupted_one(
    command: Command, alone: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "again"
    shutil.copytree(alone, folder)
    shutil.rmtree(folder / "checkpoints" / "3")
    (folder / "results.json").unlink()
    done = command("train", f"resume={folder}")
    assert done.returncode == 0, done.stderr
    assert_same_run(folder, alone)


def test_what_the_environment_does_not_have_is_refused(command: Command, tmp_path: Path) -> None:
    for setting, words in (
        ("env.reward_radius=1.0", "half_cheetah has no parameter 'reward_radius'"),
        ("env.backend=warp", "env.backend=warp is unknown (there are: auto, mujoco, mjx)"),
    ):
        done = command("train", *START, f"runs={tmp_path}", setting)
        assert done.returncode == 2, done.stdout
        assert words in done.stderr
    done = command("train", "env=point2d", f"runs={tmp_path}", "env.backend=mjx")
    assert done.returncode == 2
    assert "point2d has no parameter 'backend'" in done.stderr
    assert not any(tmp_path.iterdir())


def test_a_film(command: Command, alone: Path) -> None:
    if "MUJOCO_GL" not in os.environ and not any(find_library(lib) for lib, _ in SOFTWARE.values()):
        pytest.skip("nothing here renders without a display; see docs/half_cheetah.md")
    done = command("evaluate", f"run={alone}", "episodes=2", "video=true")
    assert done.returncode == 0, done.stderr
    from PIL import Image

    (folder,) = (alone / "evaluations").iterdir()
    with Image.open(folder / "film.gif") as film:
        assert getattr(film, "n_frames") == 20  # noqa: B009 - its type does not tell
        assert film.info["duration"] == 50  # ms, the time of a step
        assert len(np.unique(np.asarray(film.convert("L")))) > 50  # something is to be seen
    for name in ("film_strip.png", "strides.png", "strides.svg", "adaptation.png"):
        assert (folder / name).stat().st_size > 1000


def test_there_is_nothing_to_film_in_the_plane(
    command: Command, whole_run: tuple[Path, str]
) -> None:
    done = command("evaluate", f"run={whole_run[0]}", "episodes=2", "video=true")
    assert done.returncode == 2
    assert "video=true is for half_cheetah" in done.stderr
