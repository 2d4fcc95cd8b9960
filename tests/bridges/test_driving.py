"""An episode on a robot, in a clock that the test owns."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from bridges.bundle import Bundle
from bridges.driving import Act, Actor, Drive, actor, log_prob
from bridges.episodes import Episode
from bridges.messages import STOP
from bridges.policy import Policy
from bridges.recording_checks import problem_of
from bridges.robot import TurtleBot3
from bridges.safety import limits_of
from emrld_jax import policy as jax_policy
from emrld_jax.types import Gaussian
from tests.bridges import robot_bundles
from tests.bridges.fake_robot import FakeRobot, rules

AHEAD = robot_bundles.constant((1.0, 0.0))  # 0.22 m/s


def steered(bundle: Bundle) -> Actor:
    return actor(Policy(bundle), None)


def driven(
    fake: FakeRobot,
    act: Actor,
    bundle: Bundle = AHEAD,
    interrupted: Callable[[], str | None] = lambda: None,
    **changes: Any,
) -> Episode:
    robot = TurtleBot3(fake, fake.clock, rules(**changes))
    robot.connect()
    assert bundle.zone is not None
    drive = Drive(robot, act, bundle.zone, fake.clock, bundle.control_period)
    return drive.run(interrupted)


def test_a_robot_that_drives_straight_reaches_the_goal_ahead() -> None:
    fake = FakeRobot(start=(5.0, 5.0, 1.0))

    episode = driven(fake, steered(AHEAD))

    # 0.11 m a step; from 1.8 m on it is in the goal's square: after step 17, at 1.87 m less what
    # the newest odometry is behind
    assert episode.ending == "success"
    assert episode.whole
    assert len(episode.steps) == 17
    assert episode.last_pose == pytest.approx([1.87, 0, 0], abs=0.007)
    assert [step.reward for step in episode.steps[:13]] == [0.0] * 13
    for t in (13, 14, 15):
        distance = 2.0 - 0.11 * (t + 1)
        assert episode.steps[t].reward == pytest.approx(1 - distance, abs=0.007)
    assert episode.steps[16][5:8] == (100 - 16 - 1, True, True)
    assert not any(step.done or step.success for step in episode.steps[:16])
    times = np.array([step.time for step in episode.steps])
    assert np.diff(times) == pytest.approx(np.full(16, 0.5))
    assert episode.missed == 0
    assert all(0 <= step.age <= 0.03 + 1e-9 for step in episode.steps)
    assert fake.received[-1][1] == STOP
    assert len(episode.odometry) == pytest.approx(17 * 0.5 / 0.03, abs=5)
    assert list(episode.commands) == fake.received


def test_an_episode_in_which_somebody_else_drives_is_not_learned_from() -> None:
    fake = FakeRobot()

    def act(obs: np.ndarray) -> Act:
        if obs[0] > 0.5:
            fake.drivers = ["node /teleop"]
        return steered(AHEAD)(obs)

    episode = driven(fake, act)

    assert (episode.ending, episode.whole) == ("other driver", False)
    assert 4 <= len(episode.steps) <= 6
    assert [command for _, command in fake.received[-5:]] == [STOP] * 5
    assert problem_of(episode, 100) is None


def test_the_horizon_ends_an_episode() -> None:
    episode = driven(FakeRobot(), steered(robot_bundles.constant((-1.0, 0.0))))

    assert (episode.ending, len(episode.steps)) == ("horizon", 100)
    assert episode.whole
    assert not any(step.done for step in episode.steps)


def test_leaving_the_arena_ends_an_episode_at_once() -> None:
    turned = robot_bundles.constant((1.0, 0.0), task=12)  # the goal is to the left
    fake = FakeRobot()

    episode = driven(fake, steered(turned), turned, arena=2.5)

    # 2.5 m at 0.22 m/s take 11.4 s: seen within a tick and an odometry, not at 11.5 s
    assert episode.ending == "arena"
    assert episode.whole
    assert len(episode.steps) == 23
    assert episode.steps[-1].done
    assert episode.steps[-1].reward == 0
    last = max(when for when, command in fake.received if command != STOP)
    assert last - episode.began < 11.46


def test_an_arena_that_is_left_before_the_next_action_was_left_by_the_step_before() -> None:
    turned = robot_bundles.constant((1.0, 0.0), task=12)
    fake, act = FakeRobot(), steered(turned)

    def slow(obs: np.ndarray) -> Act:
        if obs[0] > 2.4:  # it drives on, to 2.51 m
            fake.clock.sleep_until(fake.clock.now() + 0.48)
        return act(obs)

    episode = driven(fake, slow, turned, arena=2.5)

    assert (episode.ending, len(episode.steps)) == ("arena", 22)
    assert (episode.steps[-1].done, episode.steps[-1].success) == (True, False)
    assert episode.last_pose[0] > 2.5
    assert problem_of(episode, 100) is None
    assert [command for _, command in fake.received[-5:]] == [STOP] * 5


def test_a_robot_that_is_outside_before_it_acts_is_no_whole_episode() -> None:
    fake, act = FakeRobot(), steered(AHEAD)

    def pushed(obs: np.ndarray) -> Act:
        for _ in range(10):  # by hand, and slowly enough for odometry to be believed
            fake.pose = (fake.pose[0] + 0.05, 0.0, 0.0)
            fake.clock.sleep_until(fake.clock.now() + 0.1)
        return act(obs)

    episode = driven(fake, pushed, arena=0.3)

    assert (episode.ending, episode.steps, episode.whole) == ("arena", (), False)
    assert problem_of(episode, 100) is None
    assert {command for _, command in fake.received} == {STOP}


def test_a_robot_that_may_not_begin_is_an_episode_without_steps() -> None:
    episode = driven(FakeRobot(start=(5.0, 0.0, 0.0)), steered(AHEAD), from_start=False, arena=2.5)

    assert (episode.ending, episode.steps, episode.whole) == ("arena", (), False)
    assert episode.last_pose == pytest.approx([5.0, 0.0, 0.0])
    assert problem_of(episode, 100) is None


def test_whoever_interrupts_before_the_first_action_keeps_the_robot_from_moving() -> None:
    fake = FakeRobot()

    episode = driven(fake, steered(AHEAD), interrupted=lambda: "SIGINT")

    assert (episode.ending, episode.steps) == ("interrupted", ())
    assert {command for _, command in fake.received} == {STOP}


@pytest.mark.parametrize("reason", ["stale", "jump", "interrupted"])
def test_an_episode_that_is_broken_off_keeps_the_whole_steps(reason: str) -> None:
    fake = FakeRobot()
    start = 1.03  # s, about when it begins

    def change(now: float, odometry: Any) -> Any:
        if now < start + 2.2 or reason == "interrupted":
            return [odometry]
        return [] if reason == "stale" else [odometry._replace(y=odometry.y + 1)]

    fake.change = change
    episode = driven(
        fake,
        steered(AHEAD),
        interrupted=lambda: (
            "SIGINT" if reason == "interrupted" and fake.clock.now() > start + 2.2 else None
        ),
    )

    assert episode.ending == reason
    assert episode.detail
    assert not episode.whole
    assert len(episode.steps) in ((4,) if reason != "stale" else (4, 5))
    assert fake.received[-1][1] == STOP


def test_an_exception_in_the_policy_stops_the_robot() -> None:
    fake, act = FakeRobot(), steered(AHEAD)

    def breaks(obs: np.ndarray) -> Act:
        if obs[0] > 0.3:
            raise ZeroDivisionError
        return act(obs)

    with pytest.raises(ZeroDivisionError):
        driven(fake, breaks)

    assert 0.3 < fake.pose[0] < 0.5
    assert [command for _, command in fake.received[-5:]] == [STOP] * 5


def test_commands_that_come_late_are_counted_and_steps_keep_their_length() -> None:
    fake, act, calls = FakeRobot(), steered(AHEAD), []

    def slow(obs: np.ndarray) -> Act:
        calls.append(obs)
        if len(calls) in (3, 7):
            fake.clock.sleep_until(fake.clock.now() + 0.2)
        return act(obs)

    episode = driven(fake, slow)

    assert episode.missed == 2
    late = [i for i, step in enumerate(episode.steps) if step.latency > 0.05]
    assert late == [2, 6]
    assert episode.steps[2].latency == pytest.approx(0.2)
    times = np.array([step.time for step in episode.steps])
    assert np.diff(times)[[2, 6]] == pytest.approx(0.5)


def test_the_injected_turn_is_beside_the_policys() -> None:
    fake = FakeRobot()
    limits = limits_of((0.0, -2.84), (0.22, 2.84), -1.3, 0.22, 2.84, 1e9, 1e9)

    episode = driven(fake, steered(AHEAD), limits=limits, injected=-1.3)

    assert episode.steps[0].action == pytest.approx([1.0, 0.0], abs=1e-6)
    assert episode.steps[0].command == pytest.approx((0.22, -1.3))
    # -0.65 rad a control step, whatever odometry's delay
    turns = np.diff([step.obs[2] for step in episode.steps])
    assert np.mean(turns) == pytest.approx(-0.65, abs=0.01)


def test_noise_is_the_generators_and_its_density_is_the_trained_policys() -> None:
    policy = Policy(robot_bundles.collecting("emrld"))
    obs = np.array([0.3, -0.2, 1.5], np.float32)
    act = actor(policy, np.random.default_rng(5))(obs)

    noise = np.random.default_rng(5).standard_normal(2)
    assert act.action == pytest.approx(policy.mean(obs) + 0.5 * noise, abs=1e-6)
    gaussian = Gaussian(jnp.asarray(policy.mean(obs)), jnp.full(2, math.log(0.5)))
    expected = jax_policy.log_prob(gaussian, jnp.asarray(act.action))
    assert act.log_prob == pytest.approx(float(expected), abs=1e-5)
    assert log_prob(policy, obs, act.action) == act.log_prob
    assert np.array_equal(act.physical, policy.to_physical(act.action))
    assert actor(policy, None)(obs).action == pytest.approx(policy.mean(obs), abs=1e-6)
