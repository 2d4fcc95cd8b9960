"""Making demonstrations: their claims are checked, and the command writes what it says."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from emrld_jax import demos
from emrld_jax.demos.claims import Played, end_distance
from emrld_jax.demos.quality import check_quality, has_quality
from emrld_jax.types import Demos
from envs_jax.goals import GoalTask
from envs_jax.half_cheetah import CheetahTask
from tests.conftest import Command


def played(distance: list[list[float]], length: list[int], success: list[int]) -> Played:
    """Episodes that are no more than their distances from the goal, [M, T]."""
    d = jnp.asarray(distance)
    tasks = GoalTask(jnp.zeros((d.shape[0], 2)))
    mask = (jnp.arange(d.shape[1])[None] < jnp.asarray(length)[:, None]).astype(jnp.float32)
    blank = jnp.zeros((*d.shape, 2))
    return Played(Demos(blank, blank, mask), -d, jnp.asarray(success, jnp.float32), tasks)


def test_the_end_is_the_last_step_that_exists():
    episodes = played([[1.0, 0.5, 9.0], [1.0, 0.7, 0.3]], [2, 3], [0, 0])
    np.testing.assert_allclose(jax.vmap(end_distance)(episodes), [0.5, 0.3])


@pytest.mark.parametrize(
    ("name", "distance", "success", "good"),
    [
        ("point2d", 0.25, 0, True),
        ("point2d", 0.05, 0, False),  # too near: it all but reached the goal
        ("point2d", 0.50, 0, False),
        ("point2d", 0.25, 1, False),
        ("two_wheeled", 0.40, 0, True),
        ("two_wheeled", 0.10, 1, True),
        ("two_wheeled", 0.60, 0, False),
    ],
)
def test_what_may_pass_as_suboptimal(name: str, distance: float, success: int, good: bool):
    episodes = played([[2.0, distance]], [2], [success])
    assert bool(has_quality(envs_jax.make(name), "suboptimal", episodes)[0]) is good


def test_a_long_way_is_not_a_demonstration():
    way = [[1.0] * 31 + [0.3] * 2]
    assert not has_quality(envs_jax.make("two_wheeled"), "suboptimal", played(way, [32], [0]))[0]


def test_the_error_names_the_task_at_fault():
    episodes = played([[2.0, 0.01], [2.0, 0.9]], [2, 2], [1, 0])
    env = envs_jax.make("point2d")
    with pytest.raises(demos.DemoError, match=r"1 of 2 .* number 1 .* ends after 2 steps"):
        check_quality(env, "optimal", episodes)


CHOSEN = ("env=point2d", "quality=suboptimal", "seed=5")


@pytest.fixture(scope="module")
def suboptimal(command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file that the command has made."""
    out = tmp_path_factory.mktemp("made") / "demos.npz"
    done = command("make_demos", f"out={out}", *CHOSEN)
    assert done.returncode == 0, done.stderr
    assert list(out.parent.iterdir()) == [out]
    return out


def test_the_command_makes_suboptimal_demonstrations(command: Command, suboptimal: Path):
    env = envs_jax.make("point2d")
    file = demos.load(suboptimal, env)
    demos.check_tasks(file, env)
    assert file.provenance["seed"] == 5
    assert "make_demos" in file.provenance["command"]
    assert file.provenance["began"] == file.provenance["code"]
    for part in (file.train, file.test):
        length = np.asarray(part.demos.mask.sum(axis=1)).astype(int)
        rows = np.arange(len(length))
        last = np.asarray(part.demos.obs)[rows, length - 1]
        end = last + 0.1 * np.asarray(part.demos.action)[rows, length - 1]
        away = np.linalg.norm(end - np.asarray(part.tasks.goal), axis=1)
        assert (away >= 0.1 - 1e-5).all()
        assert (away <= 0.4).all()
        assert not np.asarray(part.success).any()
    again = command("make_demos", f"out={suboptimal}", "env=point2d", "quality=suboptimal")
    assert again.returncode == 2
    assert f"{suboptimal} exists" in again.stderr


def test_the_command_goes_on_after_a_signal_and_a_kill(
    command: Command, environment: dict[str, str], suboptimal: Path, tmp_path: Path
):
    out = tmp_path / "demos.npz"
    checkpoint = tmp_path / "demos.npz.training" / "checkpoints" / "5"
    command_line = [sys.executable, "-m", "emrld_jax.make_demos", f"out={out}", *CHOSEN]

    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            command_line,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    stopped = start()
    assert stopped.stdout is not None
    while "iteration 1/" not in stopped.stdout.readline():
        assert stopped.poll() is None
    stopped.send_signal(signal.SIGTERM)
    printed, _ = stopped.communicate(timeout=60)
    assert stopped.returncode == 128 + signal.SIGTERM
    assert "stopped; the same command goes on where it was" in printed
    killed = start()
    while not checkpoint.is_dir():
        assert killed.poll() is None
        time.sleep(0.001)
    killed.kill()
    printed, _ = killed.communicate(timeout=60)
    assert "continuing a training after iteration " in printed
    assert not out.exists()
    done = command("make_demos", f"out={out}", *CHOSEN)
    assert done.returncode == 0, done.stderr
    assert "continuing a training after iteration 5" in done.stdout
    assert "iteration 6/" in done.stdout
    env = envs_jax.make("point2d")
    for split in ("train", "test"):
        ours, theirs = (getattr(demos.load(path, env), split) for path in (out, suboptimal))
        jax.tree.map(np.testing.assert_array_equal, ours, theirs)
    assert list(tmp_path.iterdir()) == [out]


def test_an_expert_that_trained_too_little_is_refused(command: Command, tmp_path: Path):
    out = tmp_path / "demos.npz"
    done = command(
        "make_demos", f"out={out}", "env=point2d", "dense_iterations=1", "sparse_iterations=0"
    )
    assert done.returncode == 2
    assert "are not optimal" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def runs(direction: float, velocity: float, steps: int, torque: float = 0.0) -> Played:
    """A cheetah's episodes of equal velocity (m/s), of which `steps` exist, as [1, 100]."""
    mask = (jnp.arange(100)[None] < steps).astype(jnp.float32)
    action = jnp.full((1, 100, 6), torque)
    reward = jnp.full((1, 100), velocity - 0.05 * 6 * torque**2)
    tasks = CheetahTask(jnp.array([direction]))
    return Played(Demos(jnp.zeros((1, 100, 20)), action, mask), reward, jnp.zeros(1), tasks)


@pytest.mark.parametrize(
    ("velocity", "steps", "good"),
    [
        (1.5, 20, True),  # 1.5 m in a second
        (0.9, 20, False),
        (2.0, 20, False),  # out of the dark
        (-1.5, 20, False),
        (1.5, 19, False),
    ],
)
def test_what_may_pass_as_a_piece_of_a_run(velocity: float, steps: int, good: bool):
    env = envs_jax.make("half_cheetah")
    for torque in (0.0, 0.8):  # whose cost is no part of the way
        played_back = runs(1.0, velocity, steps, torque)
        assert bool(has_quality(env, "suboptimal", played_back)[0]) is good


def test_a_fast_run_is_as_fast_as_the_papers():
    """100 steps of 2.79 m/s forward or 4.75 m/s backward."""
    env = envs_jax.make("half_cheetah")
    for direction, least in ((1.0, 2.79), (-1.0, 4.75)):
        for velocity, good in ((least - 0.01, False), (least + 0.01, True)):
            played_back = runs(direction, velocity, 100)
            assert bool(has_quality(env, "optimal", played_back)[0]) is good
    with pytest.raises(
        demos.DemoError, match=r"279 forward, 475 backward, but number 0 .* has 100"
    ):
        check_quality(env, "optimal", runs(1.0, 1.0, 100))
