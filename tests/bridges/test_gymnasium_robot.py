"""A robot through Gymnasium's interface: simulated in memory, faked, and over a wire."""

from __future__ import annotations

import gc
import math
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import envs_jax
from bridges import bundle
from bridges.environments import zone
from bridges.gymnasium.ground import ground
from bridges.messages import STOP, BridgeError
from bridges.world import World
from tests.bridges import robot_bundles
from tests.bridges.conftest import LIMIT, ROOT
from tests.bridges.fake_robot import FakeRobot
from tests.bridges.real_time import beside

AHEAD = np.array([0.15, 0.0], np.float32)
SHARP = {"linear_acceleration": None, "angular_acceleration": None, "quantization": None}
PERIOD = 0.5  # s
STALE = 0.04  # s that odometry of 30 Hz may be old


def made(robot: str = "memory", **arguments: Any) -> Any:
    return gymnasium.make(
        "bridges.gymnasium:emrld/TurtleBot3-v0", disable_env_checker=True, robot=robot, **arguments
    )


def test_gymnasiums_own_checks_pass() -> None:
    env = made().unwrapped
    env.spec.nondeterministic = False  # a robot in memory is not, if its noise is seeded
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_env(env)

    # physical units: what turns by 1.5 rad/s is not within [-1, 1]
    assert ["symmetric and normalized" in str(warning.message) for warning in told] == [True]


def test_the_rules_are_those_of_the_papers_robot() -> None:
    env = envs_jax.make("two_wheeled_drift")
    task = type(env.train_tasks())(np.float32(0.3))  # any: the goal is the same
    here = ground(None, None, None, None)

    assert here.zone == zone(env, task)
    assert (here.action.low, here.action.high) == ([*env.action_low], [*env.action_high])
    assert here.control_period == env.dt


def test_a_step_is_a_control_period() -> None:
    env = made(sim=SHARP, linear_acceleration=1e9, angular_acceleration=1e9)
    obs, info = env.reset(seed=0)
    np.testing.assert_array_equal(obs, np.zeros(3))
    assert info["task"]["goal"].tolist() == [2, 1]
    for number in range(1, 6):
        obs, reward, terminated, truncated, info = env.step(AHEAD)
        # observed as it was when the newest odometry was made
        assert obs[0] == pytest.approx(0.15 * PERIOD * number, abs=0.15 * STALE)
        assert (reward, terminated, truncated, info["fault"]) == (0, False, False, "")
        assert info["distance"] == pytest.approx(math.hypot(2 - obs[0], 1))
        assert 0 <= info["age"] < STALE
        np.testing.assert_array_equal(info["sent"], AHEAD)
    obs = env.step(np.array([0.0, 1.0], np.float32))[0]
    assert obs[2] == pytest.approx(1.0 * PERIOD, abs=1.0 * STALE)


def test_a_goal_that_is_reached_terminates() -> None:
    env = made(goal=(0.25, 0.0), sim=SHARP, linear_acceleration=1e9)
    env.reset(seed=0)
    rewards = []
    terminated = False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(AHEAD)
        rewards.append(reward)

    # 0.075 m a step: within 0.1 m of the goal after two or, as odometry is late, three
    assert len(rewards) in (2, 3)
    assert rewards[-1] == 100 - len(rewards)
    assert rewards[0] == pytest.approx(1 - 0.175, abs=0.15 * STALE)
    assert (truncated, info["success"]) == (False, True)
    with pytest.raises(ResetNeeded):
        env.step(AHEAD)
    assert commands(env)[-1] == STOP


def test_the_horizon_truncates() -> None:
    env = made(horizon=2)
    for _ in range(2):
        env.reset()
        assert [env.step(AHEAD)[2:4] for _ in range(2)] == [(False, False), (False, True)]
        assert commands(env)[-1] == STOP


def test_leaving_the_arena_terminates() -> None:
    env = made(goal=(-2.0, 0.0), horizon=60, sim={"start": [1.0, 1.0, 0.5]})
    env.reset()
    told = [env.step(AHEAD) for _ in range(33)]

    assert not any(terminated or truncated for _, _, terminated, truncated, _ in told)
    while not told[-1][2]:
        told.append(env.step(AHEAD))
    obs, reward, _, truncated, info = told[-1]
    assert obs in env.observation_space
    assert 2.5 < obs[0] < 2.52  # since the episode began, wherever the robot was
    assert (reward, truncated, info["success"]) == (0.0, False, False)


def test_leaving_the_arena_between_two_steps_terminates() -> None:
    env = made(goal=(-2.0, 0.0), horizon=60)
    obs, _ = env.reset()
    while obs[0] < 2.44:
        obs, *_, info = env.step(AHEAD)
    clock = env.unwrapped._clock
    clock.sleep_until(clock.now() + 0.45)  # it drives on meanwhile
    obs, _, terminated, truncated, info = env.step(AHEAD)

    assert 2.5 < obs[0] < 2.6
    assert (terminated, truncated, info["fault"]) == (True, False, "")
    np.testing.assert_array_equal(info["sent"], [0, 0])
    assert commands(env)[-1] == STOP


@pytest.mark.parametrize(
    ("fault", "words"), [("nan", "not finite"), ("silent", "stale"), ("jump", "jump")]
)
def test_a_fault_truncates_and_the_robot_stands_still(fault: str, words: str) -> None:
    env = made(sim={"fault": fault, "fault_after": 1.2})
    env.reset()
    told = [env.step(AHEAD) for _ in range(2)]
    while not (told[-1][2] or told[-1][3]):
        told.append(env.step(AHEAD))
    obs, reward, terminated, truncated, info = told[-1]

    assert len(told) in (3, 4)  # it begins in the third
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["fault"].startswith(words)
    np.testing.assert_array_equal(obs, told[-2][0])  # the last that is known
    assert commands(env)[-1] == STOP


def test_equal_seeds_give_equal_noise() -> None:
    def told(seed: int) -> list[tuple]:
        env.reset(seed=seed)
        return [tuple(env.step(AHEAD)[0]) for _ in range(3)]

    env = made(sim={"position_noise": 0.01})
    first, other = told(1), told(2)

    assert first == told(1)
    assert first != other


def test_a_bundle_says_what_a_robot_is_driven_for(tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    bundle.write(path, robot_bundles.constant((1.0, 0.0)))  # two_wheeled, task 0
    env = made(bundle=str(path))
    _, info = env.reset()

    np.testing.assert_allclose(env.action_space.high, [0.22, 2.84])
    assert info["task"]["goal"].tolist() == [2, 0]
    with pytest.raises(ValueError, match="the bundle says what goal, horizon is"):
        made(bundle=str(path), goal=(1, 1), horizon=5)


def test_drift_is_injected_and_limits_hold() -> None:
    """The paper's: -0.65 rad a step of 0.5 s are -1.3 rad/s, beside what the policy asks for."""
    env = made(residual_angular_velocity=-0.65, max_linear=0.1)
    env.reset()
    *_, info = env.step(np.array([0.15, 1.0], np.float32))

    np.testing.assert_allclose(commands(env)[-1], [0.1, 1.0 - 1.3], rtol=1e-6)
    assert abs(info["sent"][0]) <= 0.1


def test_an_interruption_stops_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    env = made()
    env.reset()
    robot = env.unwrapped._robot
    monkeypatch.setattr(robot, "hold", interrupted)

    with pytest.raises(KeyboardInterrupt):
        env.step(AHEAD)

    assert [command for _, command in robot.commands][-3:] == [STOP] * 3
    assert robot.commands[0][1] != STOP
    with pytest.raises(ResetNeeded):
        env.step(AHEAD)


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_robot_that_is_forgotten_stands_still() -> None:
    env = made()
    env.reset()
    env.step(AHEAD)
    robot = env.unwrapped._robot
    assert robot.commands[-1][1] != STOP
    del env
    gc.collect()

    assert robot.commands[-1][1] == STOP


def test_closing_twice_and_going_on_after_it() -> None:
    env = made()
    env.reset()
    env.step(AHEAD)
    env.close()
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(AHEAD)

    obs, _ = env.reset()

    np.testing.assert_array_equal(obs, np.zeros(3))


@contextmanager
def faked(patch: pytest.MonkeyPatch, answers: list[str]) -> Iterator[tuple[FakeRobot, list[str]]]:
    """A robot that is not in memory, as far as the environment knows, and what people are asked."""
    robot, asked = FakeRobot(), list[str]()

    def ask(*_: str) -> str:
        asked.append("ENTER")
        if not answers:
            raise EOFError
        return answers.pop()

    patch.setattr("builtins.input", ask)
    patch.setattr("bridges.gymnasium.turtlebot.world", lambda config: World(robot, robot.clock))
    yield robot, asked


def test_nothing_moves_before_somebody_confirms(monkeypatch: pytest.MonkeyPatch) -> None:
    with faked(monkeypatch, []) as (robot, _):
        with pytest.raises(BridgeError, match="nobody to ask"):
            made("dds").reset()

        assert all(command == STOP for _, command in robot.received)


def test_somebody_puts_the_robot_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with faked(monkeypatch, ["", ""]) as (robot, asked):
        env = made("dds")
        env.reset()
        env.reset()  # it has not moved
        assert len(asked) == 1
        env.step(AHEAD)
        env.reset()

    assert len(asked) == 2
    told = capsys.readouterr().out
    assert "Is the floor free?" in told
    assert "Put the robot back to its start" in told
    assert robot.resets == 0


def test_a_simulator_is_asked_by_its_service(monkeypatch: pytest.MonkeyPatch) -> None:
    with faked(monkeypatch, []) as (robot, asked):
        env = made("dds", reset="service", yes=True)
        env.reset()
        env.step(AHEAD)
        env.reset()

    assert (robot.resets >= 2, asked) == (True, [])


def test_a_dry_run_publishes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with faked(monkeypatch, []) as (robot, _):
        env = made("dds", dry_run=True, reset="service")
        env.reset()
        obs = env.step(AHEAD)[0]
        env.close()

    assert (robot.received, robot.resets) == ([], 0)
    np.testing.assert_array_equal(obs, np.zeros(3))


def test_a_robot_that_is_left_alone_between_two_steps_is_stopped_and_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with beside() as here:
        there = World(here.link, here.clock)
        monkeypatch.setattr("bridges.gymnasium.turtlebot.world", lambda config: there)
        env = made("dds", yes=True, watchdog=0.4)
        env.reset()
        env.step(AHEAD)
        assert here.robot.body.target != STOP
        time.sleep(1.2)  # somebody learns
        assert here.robot.body.target == STOP
        *_, truncated, info = env.step(AHEAD)
        assert here.robot.body.target != STOP
        env.close()
        assert here.robot.body.target == STOP

    assert (truncated, info["fault"]) == (False, "")
    assert info["late"] > 1.0


def test_an_environment_and_a_simulator_over_dds(domain: int) -> None:
    """Ten times as fast as real time, so that nobody waits."""
    pytest.importorskip("cyclonedds")
    speed, link = 10.0, {"domain_id": domain}
    with simulator(f"speed={speed}", f"link.domain_id={domain}"):
        env = made("dds", speed=speed, link=link, reset="service", yes=True, watchdog=20.0)
        obs, _ = env.reset()
        ways = [float(obs[0]), *(float(env.step(AHEAD)[0][0]) for _ in range(4))]
        env.close()

    assert ways[0] == 0
    assert all(before < after for before, after in pairwise(ways))
    assert ways[-1] > 0.15  # 0.3 m if nothing is late; where nobody steps in time, it drives on


@contextmanager
def simulator(*arguments: str) -> Iterator[None]:
    process = subprocess.Popen(
        [sys.executable, "-m", "bridges.sim_turtlebot", "robot=dds", "view=null", *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        process.kill()
        process.wait(LIMIT)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"goal": (1.0,)}, "goal=(1.0,) is not allowed: it must be two finite numbers"),
        ({"reward": "dens"}, "choose one of: sparse, dense"),
        ({"horizon": 0}, "at least 1 step"),
        ({"wachdog": 1.0}, "did you mean 'watchdog'"),
        ({"watchdog": -1.0}, "watchdog=-1.0 is not allowed: it must be above 0"),
        ({"episodes": 3}, "there is no setting 'episodes'"),
        ({"link": {"domain": 3}}, "unexpected keyword argument 'domain'"),
        ({"link": {"domain_id": 300}}, "link.domain_id=300 is not allowed"),
        ({"robot": "ros"}, "robot=ros is not allowed"),
    ],
)
def test_what_is_wrong_is_told(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the words follow
        made(**{"robot": "memory", **arguments})

    assert words in str(error.value)


def test_a_robot_needs_no_jax() -> None:
    code = (
        "import gymnasium, sys\n"
        "env = gymnasium.make('bridges.gymnasium:emrld/TurtleBot3-v0', robot='memory')\n"
        "env.reset()\nenv.step(env.action_space.sample())\n"
        "sys.exit('jax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=60,
    )

    assert done.returncode == 0


def test_a_picture_shows_the_way() -> None:
    env = made(render_mode="rgb_array")
    env.reset()
    before = env.render()
    for _ in range(5):
        env.step(AHEAD)
    after = env.render()

    assert before.shape == (400, 400, 3)
    assert before.dtype == np.uint8
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 5
    assert (before != after).any()


def commands(env: Any) -> list:
    return [command for _, command in env.unwrapped._robot.commands]
