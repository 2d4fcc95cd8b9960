"""Episodes that runs keep to be looked at."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax.demos import DemoSet
from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.episodes import (
    drop_after,
    kept_episodes,
    read_episodes,
    some_tasks,
    write_episodes,
)
from emrld_jax.runs.evaluation import Evaluation
from emrld_jax.runs.folder import RunFolder
from emrld_jax.settings import with_values
from emrld_jax.types import Demos
from envs_jax import make
from envs_jax.goals import GoalTask

GOAL = jnp.array([[0.0, 2.0]])


def evaluation(obs: np.ndarray, mask: np.ndarray) -> Evaluation:
    """Of one task, its three stages and one episode of 4 steps, each rewarded by 0.5."""
    none = np.zeros((1, 3, 1))
    return Evaluation(none, none, none, obs, mask, np.full(mask.shape, 0.5))


def planar() -> tuple[DemoSet, Evaluation]:
    """A point that goes up by 1, 2, or 3 m a step, after 0, 1, and 2 adaptation steps."""
    speed = np.array([1.0, 2.0, 3.0])[None, :, None, None]
    obs = np.zeros((1, 3, 1, 4, 2))
    obs[..., 1] = speed * np.arange(4.0)
    mask = np.ones((1, 3, 1, 4))
    mask[:, 2, :, 2:] = 0.0  # the last stage's episode ends with its second step
    demo = jnp.array([[[0.0, 0.0], [0.0, 1.5], [0.0, 0.0]]])  # the third step is padding
    demos = Demos(demo, jnp.zeros((1, 3, 2)), jnp.array([[1.0, 1.0, 0.0]]))
    return DemoSet(demos, GoalTask(GOAL), np.zeros(1), np.zeros(1)), evaluation(obs, mask)


def test_what_is_kept_in_the_plane() -> None:
    demos, found = planar()
    kept = kept_episodes(make("point2d"), demos, found, [5])
    assert (kept.task.tolist(), kept.aim.tolist()) == ([5], [[0.0, 2.0]])
    before, after = kept.path[0, :, 0, :, 1]
    np.testing.assert_array_equal(before, [0, 1, 2, 3, np.nan])  # to the horizon: no more is known
    np.testing.assert_array_equal(after, [0, 3, 6, np.nan, np.nan])  # with where it ended
    np.testing.assert_array_equal(kept.reward[0, 1, 0], [0.5, 0.5, np.nan, np.nan])
    np.testing.assert_array_equal(kept.demo[0], [[0, 0], [0, 1.5], [np.nan, np.nan]])


def test_what_is_kept_of_a_runner() -> None:
    pytest.importorskip("mujoco")
    env = make("half_cheetah")
    place = env.observation_names.index("torso_x")
    obs = np.zeros((1, 3, 1, 4, len(env.observation_names)))
    obs[..., place] = 0.25 + np.arange(4.0)
    demos = Demos(jnp.asarray(obs[0, 0]), jnp.zeros((1, 4, 6)), jnp.ones((1, 4)))
    direction = type(env.train_tasks())(np.array([-1.0]))
    demo_set = DemoSet(demos, direction, np.zeros(1), np.zeros(1))
    kept = kept_episodes(env, demo_set, evaluation(obs, np.ones((1, 3, 1, 4))), [0])
    assert kept.aim.tolist() == [[-1.0]]
    np.testing.assert_array_equal(kept.path[0, 1, 0, :, 1], [0, 1, 2, 3, np.nan])
    times = env.dt * np.arange(4)
    np.testing.assert_allclose(kept.path[0, 1, 0, :4, 0], times, rtol=1e-3)
    np.testing.assert_array_equal(kept.demo[0, :, 1], [0, 1, 2, 3])


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    demos, found = planar()
    kept = kept_episodes(make("point2d"), demos, found, [0])
    path = tmp_path / "episodes" / "10.npz"
    write_episodes(path, make("point2d"), {"train": kept}, 10)
    about, splits = read_episodes(path)
    assert (about["iteration"], about["kind"], about["zone"]) == (10, "plane", 0.2)
    assert list(splits) == ["train"]
    for ours, theirs in zip(splits["train"], kept, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [file.name for file in path.parent.iterdir()] == ["10.npz"]


@pytest.mark.parametrize("content", [b"", b"PK", b"nothing"])
def test_a_damaged_file_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "10.npz"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"10\.npz cannot be read"):
        read_episodes(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "10.npz"
    np.savez(path, about=np.array('{"format": "other", "version": 1}'))
    with pytest.raises(ConfigError, match="not of the format emrld-episodes 1"):
        read_episodes(path)
    np.savez(path, about=np.array([object()]))
    with pytest.raises(ConfigError, match="cannot be read"):  # a pickle is not opened
        read_episodes(path)


def test_later_episodes_are_dropped_where_a_run_goes_on(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.episodes.mkdir()
    for name in ("0", "9", "10", "11", "100", "final"):
        (folder.episodes / f"{name}.npz").touch()
    drop_after(folder, 10)
    left = sorted(int(path.stem) for path in folder.episodes.iterdir())
    assert left == [0, 9, 10]


def test_keeping_takes_two_percent_of_the_episodes_at_most() -> None:
    # 10 iterations of 12 tasks with 2 x 20 episodes are 4800; a task takes 20 + 2: 96 / 22
    settings = {"checkpoint_every": 10, "adapt.num_episodes": 20, "adapt.num_steps": 1}
    config = with_values(TrainConfig(), settings)
    assert some_tasks(config, 12).tolist() == [0, 4, 7, 11]
    assert some_tasks(with_values(config, {"checkpoint_every": 1}), 12).tolist() == [0]
    assert some_tasks(with_values(config, {"checkpoint_every": 100}), 3).tolist() == [0, 1, 2]
