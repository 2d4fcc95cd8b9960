"""One environment through Gymnasium's interface, beside oracles of their own."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import warnings
from ctypes.util import find_library
from itertools import pairwise
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import envs_jax
from bridges.gymnasium import ENVIRONMENTS
from emrld_jax.runs.camera import SOFTWARE
from tests.envs.oracles import ORACLES

TITLES = {name: title for title, name in ENVIRONMENTS.items()}
ADVICE = "we recommend using a symmetric and normalized space"  # check_env's, on spaces beyond 1


def made(name: str, **arguments: Any) -> Any:
    return gymnasium.make(f"bridges.gymnasium:emrld/{TITLES[name]}-v0", **arguments)


def test_every_environment_is_registered() -> None:
    assert tuple(ENVIRONMENTS.values()) == envs_jax.names()


@pytest.mark.parametrize("name", envs_jax.names())
def test_gymnasiums_own_checks_pass(name: str) -> None:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_env(made(name).unwrapped, skip_render_check=name == "half_cheetah")

    # physical units: a robot that turns by 1.5 rad/s is not within [-1, 1]
    expected = [ADVICE] if name.startswith("two_wheeled") else []
    assert len(told) == len(expected)
    assert all(words in str(warning.message) for words, warning in zip(expected, told, strict=True))


@pytest.mark.parametrize("name", ["point2d", "two_wheeled", "two_wheeled_drift"])
def test_physical_actions_do_what_the_equations_say(name: str) -> None:
    env = made(name, task=3)
    obs, info = env.reset(seed=0)
    low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)
    goal = np.array(info["task"].get("goal", (2.0, 1.0)))
    drift = info["task"].get("residual_angular_velocity", 0.0)
    generator = np.random.default_rng(0)
    for t in range(40):
        action = generator.uniform(1.3 * low - 0.3 * high, 1.3 * high - 0.3 * low)  # beyond, too
        policy = (action - low) / (high - low) * 2 - 1
        expected = ORACLES[name].step(obs.astype(float), policy, goal, drift)
        obs, reward, terminated, truncated, info = env.step(action.astype(np.float32))
        np.testing.assert_allclose(obs, expected.obs, atol=2e-6)
        assert reward == pytest.approx(expected.reward(t, "sparse"), abs=1e-5)
        assert (terminated, truncated) == (bool(expected.done), False)
        assert info["distance"] == pytest.approx(expected.distance, abs=1e-5)


def test_half_cheetah_is_that_of_envs_jax() -> None:
    env = made("half_cheetah", reward="dense", task={"direction": -1})
    obs, _ = env.reset(seed=4)
    pure = envs_jax.make("half_cheetah", reward="dense")
    state = pure.reset_to(jnp.asarray(obs), type(pure.train_tasks())(jnp.float32(-1)))
    step = jax.jit(pure.step)
    env.action_space.seed(0)
    for _ in range(10):
        action = env.action_space.sample()
        obs, reward, terminated, _, info = env.step(action)
        state = step(state, jnp.asarray(action))
        np.testing.assert_allclose(obs, state.obs, rtol=1e-3, atol=1e-3)
        assert reward == pytest.approx(float(state.reward), rel=1e-3, abs=1e-3)
        assert not terminated
        assert info["task"] == {"direction": -1.0}


def test_spaces_are_physical() -> None:
    env = made("two_wheeled")

    np.testing.assert_allclose(env.action_space.low, [0, -2.84])
    np.testing.assert_allclose(env.action_space.high, [0.22, 2.84])
    # the step that leaves the arena ends at most 2.5 + 0.22 * 0.5 m away
    assert 2.61 <= env.observation_space.high[0] < 2.8
    assert made("half_cheetah").observation_space.shape == (20,)


@pytest.mark.parametrize("turn", [-2.84, 2.84])
def test_a_robot_that_always_turns_stays_in_the_space(turn: float) -> None:
    env = made("two_wheeled")
    env.reset(seed=0)
    ended = False
    while not ended:
        obs, _, terminated, ended, _ = env.step(np.array([0.22, turn], np.float32))
        assert obs in env.observation_space
        assert not terminated

    assert obs[2] == pytest.approx(100 * 0.5 * turn, rel=1e-5)


def test_success_terminates() -> None:
    env = made("point2d", task={"goal": [0.2, 0.0]})
    _, info = env.reset()
    assert info["success"] is False
    right = np.array([0.1, 0.0], np.float32)

    assert env.step(right)[1:4] == (pytest.approx(0.9), False, False)  # 1 - distance, still going
    _, reward, terminated, truncated, info = env.step(right)

    assert (reward, terminated, truncated) == (100 - 1 - 1, True, False)
    assert info["success"] is True
    with pytest.raises(ResetNeeded, match=r"reset\(\) begins one"):
        env.step(right)


def test_leaving_the_arena_terminates() -> None:
    env = made("two_wheeled", task={"goal": [-2.0, 0.0]})
    env.reset()
    for _ in range(22):  # 0.11 m each: 2.42 m
        assert env.step(np.array([0.22, 0.0], np.float32))[2:4] == (False, False)
    obs, reward, terminated, truncated, info = env.step(np.array([0.22, 0.0], np.float32))

    assert obs[0] == pytest.approx(2.53, abs=1e-5)
    assert (reward, terminated, truncated, info["success"]) == (0.0, True, False, False)


def test_the_horizon_truncates() -> None:
    env = made("point2d", horizon=3)
    for _ in range(2):
        env.reset()
        ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(3)]
        assert ends == [(False, False), (False, False), (False, True)]


def test_success_at_the_last_step_is_no_truncation() -> None:
    env = made("point2d", horizon=2, task={"goal": [0.0, 0.2]})
    env.reset()
    env.step(np.array([0.0, 0.1], np.float32))

    _, reward, terminated, truncated, _ = env.step(np.array([0.0, 0.1], np.float32))

    assert (reward, terminated, truncated) == (2 - 1 - 1, True, False)


def test_point2d_bounds_the_length_of_a_move() -> None:
    env = made("point2d")
    env.reset()

    obs = env.step(env.action_space.high)[0]

    np.testing.assert_allclose(obs, [0.1 / math.sqrt(2)] * 2, rtol=1e-5)


@pytest.mark.parametrize("action", [[0.1], [[0.1, 0.0]], [math.nan, 0.0]])
def test_impossible_actions_are_refused(action: list) -> None:
    env = made("point2d").unwrapped
    env.reset()

    with pytest.raises(ValueError, match="action"):
        env.step(action)


def test_an_episode_begins_with_reset() -> None:
    with pytest.raises(ResetNeeded):
        made("point2d").unwrapped.step(np.zeros(2, np.float32))


def test_equal_seeds_give_equal_episodes() -> None:
    def starts(seed: int) -> list[tuple[bytes, float]]:
        env = made("half_cheetah")
        told = [env.reset(seed=seed), *(env.reset() for _ in range(5))]
        return [(obs.tobytes(), info["task"]["direction"]) for obs, info in told]

    assert starts(3) == starts(3)
    assert starts(3) != starts(4)
    assert all(a != b for (a, _), (b, _) in pairwise(starts(3)))  # each its own


def test_a_seed_begins_the_same_with_any_task() -> None:
    first, _ = made("half_cheetah").reset(seed=5)
    second, _ = made("half_cheetah", task=1).reset(seed=5)

    np.testing.assert_array_equal(first, second)


def test_tasks_are_random_ones_of_the_split() -> None:
    for split, odd in (("train", 0), ("test", 1)):
        env = made("point2d", split=split)
        told = [env.reset(seed=0)[1], *(env.reset()[1] for _ in range(60))]
        goals = np.array([info["task"]["goal"] for info in told])
        degrees = np.rad2deg(np.arctan2(goals[:, 1], goals[:, 0]))
        numbers = np.round(degrees / 7.5).astype(int)
        np.testing.assert_allclose(degrees, 7.5 * numbers, atol=1e-3)
        assert set(numbers) == set(range(odd, 24, 2))  # 12 goals: all were drawn


@pytest.mark.parametrize(
    "task",
    [
        2,
        np.int64(2),
        {"goal": [math.sqrt(3), 1.0]},
        jax.tree.map(lambda x: x[2], envs_jax.make("point2d").train_tasks()),
    ],
)
def test_a_task_is_a_number_or_what_it_is(task: Any) -> None:
    fixed, free = made("point2d", task=task), made("point2d")

    for info in (fixed.reset()[1], fixed.reset()[1], free.reset(options={"task": task})[1]):
        np.testing.assert_allclose(info["task"]["goal"], [math.sqrt(3), 1], atol=1e-6)


def test_options_are_for_one_episode() -> None:
    env = made("two_wheeled_drift", task=0)

    drifts = [
        env.reset(options=options)[1]["task"]["residual_angular_velocity"]
        for options in (None, {"task": 24, "split": "test"}, {})
    ]

    assert drifts == pytest.approx([-0.7, -0.65, -0.7])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"task": 12}, "point2d has train tasks 0 to 11"),
        ({"task": -1}, "point2d has train tasks 0 to 11"),
        ({"task": "2"}, "neither the number of a task nor a mapping with goal"),
        ({"task": {"goal": [1.0]}}, "2 finite numbers"),
        ({"task": {"goal": [1.0, math.inf]}}, "2 finite numbers"),
        ({"task": {"gaol": [1.0, 0.0]}}, "a task of point2d has goal; given were gaol"),
        ({"split": "valid"}, "choose one of: train, test"),
        ({"reward": "dens"}, "choose one of: sparse, dense"),
        ({"horizn": 5}, "did you mean 'horizon'"),
        ({"render_mode": "ansi"}, "there is rgb_array"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode:UserWarning")
def test_what_is_wrong_is_told(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        made("point2d", **arguments)


def test_unknown_options_are_refused() -> None:
    env = made("point2d")

    with pytest.raises(ValueError, match="option 'goal' of reset is unknown"):
        env.reset(options={"goal": [1, 0]})
    with pytest.raises(ValueError, match="half a turn"):
        made("two_wheeled_drift", task={"residual_angular_velocity": 4.0})


def color_at(picture: np.ndarray, x: float, y: float, reach: float = 2.5 + 0.12) -> tuple:
    """The color at a position in m; the picture shows `reach` m to each side."""
    size = len(picture)
    row, column = int((reach - y) / (2 * reach) * size), int((reach + x) / (2 * reach) * size)
    return tuple(picture[row, column])


def test_a_picture_shows_where_things_are() -> None:
    env = made("two_wheeled", task={"goal": [1.0, 1.5]}, render_mode="rgb_array")
    env.reset()
    before = env.render()
    for _ in range(8):
        env.step(np.array([0.22, 0.0], np.float32))
    after = env.render()

    assert before.shape == after.shape == (400, 400, 3)
    assert before.dtype == np.uint8
    white = color_at(before, -2.2, -1.8)
    success, pays = color_at(before, 1.1, 1.6), color_at(before, 1.0, 1.2)
    assert white == (255, 255, 255)
    assert len({white, success, pays}) == 3
    assert color_at(before, 1.1, -1.6) == white  # y points up
    moved = np.any(before != after, axis=2)
    columns = np.flatnonzero(moved.any(axis=0))
    # it came from 0 to 0.88 m, and its radius is 0.1 m
    scale = 400 / (2 * 2.62)
    assert columns[-1] == pytest.approx((2.62 + 0.98) * scale, abs=2)
    assert color_at(after, 0.85, 0.06) not in (white, color_at(before, 0.85, 0.06))


def test_nothing_is_rendered_without_a_mode() -> None:
    env = made("point2d").unwrapped
    env.reset()

    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None


RENDERS = """
import gymnasium, numpy as np, sys
first = gymnasium.make("bridges.gymnasium:emrld/HalfCheetah-v0")  # one that does not render
first.reset(seed=0)
first.step(first.action_space.sample())
env = gymnasium.make("bridges.gymnasium:emrld/HalfCheetah-v0", render_mode="rgb_array")
env.reset(seed=0)
before = env.render()
for _ in range(5):
    env.step(np.ones(6, np.float32))
after = env.render()
assert before.shape == (320, 480, 3) and before.dtype == np.uint8, before.shape
assert len(np.unique(before)) > 50, "blank"
assert (before != after).any()
print(env.metadata["render_fps"])
"""


def test_half_cheetah_is_rendered_without_a_display(environment: dict[str, str]) -> None:
    if "MUJOCO_GL" not in os.environ and not any(find_library(lib) for lib, _ in SOFTWARE.values()):
        pytest.skip("nothing here renders without a display; see docs/half_cheetah.md")
    done = run(RENDERS, environment)

    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == "20"


LIGHT = """
import sys
import bridges.gymnasium, gymnasium
assert "bridges" not in gymnasium.__file__, gymnasium.__file__
assert gymnasium.spec("emrld/Point2D-v0").vector_entry_point
sys.exit("jax" in sys.modules)
"""
MISSING = """
import sys
sys.modules["gymnasium"] = None  # as if it were not installed
import bridges.gymnasium
"""


def test_registering_needs_no_jax_and_hides_no_package(environment: dict[str, str]) -> None:
    assert run(LIGHT, environment).returncode == 0


def test_a_missing_package_is_named_with_its_extra(environment: dict[str, str]) -> None:
    done = run(MISSING, environment)

    assert done.returncode == 1
    assert "gymnasium is not installed: pip install -e '.[gymnasium]'" in done.stderr


def run(code: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
