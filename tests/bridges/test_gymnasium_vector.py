"""Many environments at once do what Gymnasium's own vector environment makes of single ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bridges.gymnasium.programs import programs
from bridges.gymnasium.single import JaxEnv
from bridges.gymnasium.vector import JaxVectorEnv
from tests.conftest import compiled

MODES = tuple(AutoresetMode)
# near enough to be reached by chance, at different times, and one that is not
NEAR: list[Any] = [{"goal": goal} for goal in ([0.1, 0.0], [0.0, 0.2], [-0.2, 0.1], [5.0, 5.0])]
SHORT: dict[str, Any] = {"horizon": 7, "goal_radius": 0.1}


def vector(mode: AutoresetMode, name: str, size: int, **arguments: Any) -> Any:
    return JaxVectorEnv(name, size, autoreset_mode=mode, **arguments)


def singles(mode: AutoresetMode, name: str, tasks: Sequence[Any], **arguments: Any) -> Any:
    def maker(task: Any) -> Any:
        return lambda: JaxEnv(name, task=task, **arguments)

    return SyncVectorEnv([maker(task) for task in tasks], autoreset_mode=mode)


def assert_equal(told: Any, expected: Any) -> None:
    """Gymnasium's own measure; types, masks and kinds of numbers count too."""
    assert data_equivalence(told, expected), f"{told}\nshould be\n{expected}"


@pytest.mark.parametrize("mode", MODES)
def test_episodes_are_those_of_single_environments(mode: AutoresetMode) -> None:
    ours = vector(mode, "point2d", 4, task=NEAR, **SHORT)
    theirs = singles(mode, "point2d", NEAR, **SHORT)
    assert ours.action_space == theirs.action_space
    assert ours.observation_space == theirs.observation_space
    generator = np.random.default_rng(0)
    assert_equal(ours.reset(seed=3), theirs.reset(seed=3))
    assert ours.np_random_seed == theirs.np_random_seed == (3, 4, 5, 6)
    terminations = truncations = 0
    for _ in range(40):
        actions = generator.uniform(-0.1, 0.1, (4, 2)).astype(np.float32)
        told = ours.step(actions)
        assert_equal(told, theirs.step(actions))
        ended = told[2] | told[3]
        terminations += told[2].sum()
        truncations += told[3].sum()
        if mode is AutoresetMode.DISABLED and ended.any():
            mask = {"reset_mask": ended}
            assert_equal(ours.reset(options=dict(mask)), theirs.reset(options=dict(mask)))

    assert terminations >= 5
    assert truncations >= 5


@pytest.mark.parametrize("name", ["two_wheeled_drift", "half_cheetah"])
def test_random_tasks_and_starts_are_those_of_single_environments(name: str) -> None:
    mode = AutoresetMode.NEXT_STEP
    ours = vector(mode, name, 3, horizon=4)
    theirs = singles(mode, name, [None] * 3, horizon=4)
    low, high = ours.single_action_space.low, ours.single_action_space.high
    for seed in (0, [7, None, 8]):
        assert_equal(ours.reset(seed=0), theirs.reset(seed=0))
        assert_equal(ours.reset(seed=seed), theirs.reset(seed=seed))
        generator = np.random.default_rng(1)
        for _ in range(12):
            actions = generator.uniform(low, high, (3, len(low))).astype(np.float32)
            assert_equal(ours.step(actions), theirs.step(actions))


def test_the_step_after_an_end_is_a_reset() -> None:
    """Worked: the goal is one step away, so every second step is a reset."""
    env = vector(AutoresetMode.NEXT_STEP, "point2d", 2, task=[{"goal": [0.1, 0]}, {"goal": [9, 0]}])
    env.reset(seed=0)
    right = np.tile(np.array([0.1, 0.0], np.float32), (2, 1))

    told = [env.step(right) for _ in range(4)]

    assert [list(terminated) for _, _, terminated, _, _ in told] == [[True, False], [False] * 2] * 2
    assert [reward[0] for _, reward, _, _, _ in told] == [99, 0, 99, 0]
    steps = [obs[:, 0] / 0.1 for obs, *_ in told]
    np.testing.assert_allclose(steps, [[1, 1], [0, 2], [1, 3], [0, 4]], rtol=1e-6)
    assert [list(info["success"]) for *_, info in told] == [[True, False], [False] * 2] * 2


def test_an_end_is_told_where_the_same_step_resets() -> None:
    env = vector(AutoresetMode.SAME_STEP, "point2d", 2, task=[{"goal": [0.1, 0]}, {"goal": [9, 0]}])
    env.reset(seed=0)

    obs, reward, terminated, _, info = env.step(np.array([[0.1, 0], [0.1, 0]], np.float32))

    np.testing.assert_allclose(obs, np.array([[0.0, 0.0], [0.1, 0.0]]), rtol=1e-6)
    np.testing.assert_allclose(info["final_obs"][0], np.array([0.1, 0.0]), rtol=1e-6)
    assert info["final_obs"][1] is None
    assert list(info["_final_obs"]) == [True, False]
    assert list(info["final_info"]["success"]) == [True, False]
    assert list(info["success"]) == [False, False]
    assert (list(reward), list(terminated)) == ([99, 0], [True, False])


def test_who_steps_resets_where_nothing_else_does() -> None:
    env = vector(AutoresetMode.DISABLED, "point2d", 2, horizon=1)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((2, 2), np.float32))
    with pytest.raises(ResetNeeded, match="at first all"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset()
    env.step(np.zeros((2, 2), np.float32))

    with pytest.raises(ResetNeeded):
        env.step(np.zeros((2, 2), np.float32))


def test_gymnasium_makes_the_vector_environment() -> None:
    env = gymnasium.make_vec("bridges.gymnasium:emrld/TwoWheeled-v0", num_envs=5, reward="dense")
    _, info = env.reset(seed=0, options={"task": np.arange(5)})

    assert isinstance(env, JaxVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.family.reward == "dense"
    degrees = np.rad2deg(np.arctan2(*info["task"]["goal"].T[::-1]))
    np.testing.assert_allclose(degrees, 7.5 * np.arange(5), atol=1e-3)
    assert (env.step(env.action_space.sample())[1] < -1).all()


def test_the_step_is_compiled_once() -> None:
    env = vector(AutoresetMode.NEXT_STEP, "point2d", 6, horizon=3, goal_radius=0.021)
    before = compiled(programs(env.family, batched=True).step)
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample())

    assert (before, compiled(programs(env.family, batched=True).step)) == (0, 1)


def test_equal_seeds_give_equal_episodes() -> None:
    def told() -> Any:
        env = vector(AutoresetMode.NEXT_STEP, "half_cheetah", 3, horizon=2)
        first = env.reset(seed=11)
        return first, [env.step(np.zeros((3, 6), np.float32)) for _ in range(5)]

    assert data_equivalence(told(), told(), exact=True)


def test_every_environment_is_rendered() -> None:
    env = vector(
        AutoresetMode.NEXT_STEP, "two_wheeled", 2, task=[0, 12], render_mode="rgb_array", horizon=3
    )
    env.reset()
    for _ in range(3):
        env.step(np.tile(np.array([0.22, 0.0], np.float32), (2, 1)))
    ahead, left = env.render()
    env.step(env.action_space.sample())  # a reset: the paths begin again

    assert ahead.shape == left.shape == (400, 400, 3)
    assert (ahead != left).any(axis=2).sum() > 1000  # their goals are not at the same place
    assert (env.render()[0] != ahead).any()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"task": [0, 1]}, "2 are given for 3 environments"),
        ({"task": [0, 1, 99]}, "train tasks 0 to 11"),
        ({"autoreset_mode": "never"}, "never"),
        ({"num_envs": 0}, "num_envs=0"),
    ],
)
def test_what_is_wrong_is_told(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        JaxVectorEnv(**{"name": "point2d", "num_envs": 3, **arguments})


def test_impossible_resets_are_refused() -> None:
    env = vector(AutoresetMode.NEXT_STEP, "point2d", 3)

    with pytest.raises(ValueError, match="2 are given for 3"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([1, 0, 1])})
