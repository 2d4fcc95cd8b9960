"""The examples run as they stand, with fewer iterations, and do what they say."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax import demos
from examples.own_environment import Crossing, River, write_demonstrations

ROOT = Path(__file__).parents[1]


@pytest.fixture
def example(environment: dict[str, str], tmp_path: Path):
    """Runs an example in an empty folder and returns what it prints, or its error if refused."""

    def run(name: str, *arguments: str, refused: bool = False) -> list[str]:
        command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), *arguments]
        done = subprocess.run(
            command,
            check=False,
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=240,
        )
        assert done.returncode == (2 if refused else 0), done.stderr
        return (done.stderr if refused else done.stdout).splitlines()

    return run


def numbers(line: str) -> list[float]:
    return [float(text) for text in re.findall(r"-?\d+\.\d+", line)]


def test_training_from_python_raises_the_return_of_held_out_tasks(example) -> None:
    *iterations, last = example("train_from_python", "--iterations", "6")

    assert [line.split(":")[0] for line in iterations] == [f"iteration {i}" for i in range(1, 7)]
    returns = [numbers(line)[1] for line in iterations]
    assert returns[-1] > 2 * returns[0]
    before, after = numbers(last)
    assert last.startswith("held-out tasks:")
    assert after > before + 1


def test_an_environment_and_demonstrations_of_ones_own(example, tmp_path: Path) -> None:
    first, *iterations, last = example("own_environment", "--iterations", "6")

    assert first == "demos/river_optimal.npz: 12 of 12 demonstrations land"
    assert (tmp_path / "demos" / "river_optimal.npz").is_file()
    assert len(iterations) == 6
    assert numbers(iterations[-1])[1] > numbers(iterations[0])[1] + 3
    before, after = numbers(last)
    assert after > before + 3


def test_adapting_to_a_new_task(example) -> None:
    before, after, move = example("adapt_trained_policy", "--iterations", "10", "--direction", "90")

    assert numbers(before)[0] < 1
    assert numbers(after)[0] > 3
    x, y = numbers(move)  # m; a goal in the direction of 90 degrees
    assert abs(x) < y <= 0.1


def test_a_folder_that_is_no_run_is_told_in_one_line(example) -> None:
    lines = example("adapt_trained_policy", "--run", "nothere", refused=True)
    assert lines == ["error: nothere: there is no such run folder"]


def test_the_rivers_rewards() -> None:
    """By hand: the dock is 2 m across; 0.25 m short of it is in the zone, 0.0625 m lands."""
    env = River()
    task = Crossing(dock=jnp.array(0.5), current=jnp.array(0.25))
    still = env.to_policy(jnp.zeros(2))

    def after_a_step(across: float) -> tuple[float, float]:
        state = env.step(env.reset_to(jnp.array([0.25, across]), task), still)
        np.testing.assert_allclose(state.obs, [0.5, across])  # the current carries it 0.25 m
        return float(state.reward), float(state.done)

    assert after_a_step(1.5) == (0.0, 0.0)
    assert after_a_step(1.75) == (0.75, 0.0)
    assert after_a_step(1.9375) == (49.0, 1.0)


def test_the_ferryman_lands_and_his_file_loads(tmp_path: Path) -> None:
    env = River()
    write_demonstrations(env, tmp_path / "river.npz")
    file = demos.load(tmp_path / "river.npz", env)

    assert np.all(file.train.success)
    assert np.all(file.test.success)
    lengths = np.asarray(file.train.demos.mask.sum(axis=1))
    # 2 m and 2.5 m, the nearest and the farthest docks, less 0.1 m, at 0.09 m a step
    assert lengths.min() >= np.floor(1.9 / 0.09)
    assert lengths.max() <= np.ceil(2.5 / 0.09)
    assert jax.tree.leaves(file.test.tasks)[0].shape == (6,)
