"""A robot whose loop hangs is stopped by a thread beside it."""

from __future__ import annotations

import threading
import time
from itertools import pairwise

import numpy as np
import pytest

from bridges.driving import Act, Drive, actor
from bridges.episodes import Episode
from bridges.messages import STOP, Command
from bridges.minder import Minder
from bridges.policy import Policy
from bridges.recording_checks import problem_of
from bridges.robot import TurtleBot3
from tests.bridges import robot_bundles
from tests.bridges.fake_robot import rules
from tests.bridges.real_time import Beside, beside

AHEAD = robot_bundles.constant((1.0, 0.0))  # 0.22 m/s
WATCHDOG, HANGS = 0.4, 1.5  # s


class Hanging:
    """Hangs once, from its third call on, and looks at the robot before it goes on."""

    def __init__(self, here: Beside) -> None:
        self._here, self._calls = here, 0
        self.span = (0.0, 0.0)
        self.before = self.after = STOP

    def __call__(self) -> None:
        self._calls += 1
        if self._calls == 3:
            self.before, began = self._here.robot.body.target, self._here.clock.now()
            time.sleep(HANGS)
            self.after, self.span = self._here.robot.body.target, (began, self._here.clock.now())


@pytest.mark.parametrize("where", ["policy", "terminal", "send"])
def test_a_loop_that_hangs_ends_the_episode_and_the_robot_is_stopped_meanwhile(
    where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert AHEAD.zone is not None
    steered = actor(Policy(AHEAD), None)
    with beside() as here:
        hang, send, main = Hanging(here), here.link.send, threading.current_thread()

        def act(obs: np.ndarray) -> Act:
            if where == "policy":
                hang()
            return steered(obs)

        def watch(episode: Episode) -> None:
            if where == "terminal":
                hang()

        def sends(command: Command) -> None:
            if where == "send" and threading.current_thread() is main and command != STOP:
                hang()
            send(command)

        monkeypatch.setattr(here.link, "send", sends)
        with TurtleBot3(here.link, here.clock, rules(watchdog=WATCHDOG)) as robot:
            drive = Drive(robot, act, AHEAD.zone, here.clock, 0.2)
            episode = drive.run(watch=watch)
            assert here.robot.body.target == STOP
            robot.begin()  # nothing is left of it
            assert robot.send_action((0.1, 0.0)) != STOP
            assert robot.hold(here.clock.now() + WATCHDOG + 0.2) is None

    assert hang.before != STOP
    assert hang.after == STOP
    assert (episode.ending, episode.whole) == ("stalled", False)
    assert "0.4 s" in episode.detail
    assert problem_of(episode, 100) is None
    began, ended = hang.span
    stops = [moment for moment, command in episode.commands if began < moment < ended]
    assert len(stops) >= 5
    # from WATCHDOG after the loop's last tick on, which was a tick before it hung at most
    assert WATCHDOG - 0.1 < stops[0] - began < WATCHDOG + 0.4
    assert all(a <= b for a, b in pairwise(stops))


def test_a_loop_that_ticks_is_left_in_peace_and_so_is_one_that_rests() -> None:
    stops: list[float] = []
    minder = Minder(lambda: stops.append(time.monotonic()), 1.0)
    minder.start()
    time.sleep(1.2)  # nothing drives yet
    minder.watch()
    for _ in range(24):
        time.sleep(0.05)
        minder.tick()
    minder.rest()
    time.sleep(1.2)
    minder.end()
    minder.end()

    assert (stops, minder.stalled) == ([], False)


def test_virtual_time_has_no_thread() -> None:
    minder = Minder(lambda: None, None)
    before = threading.active_count()
    minder.start()
    minder.watch()

    assert threading.active_count() == before
    minder.end()


def test_a_stop_that_does_not_go_through_is_sent_again() -> None:
    sent = threading.Semaphore(0)

    def stop() -> None:
        sent.release()
        raise OSError("no network")

    minder = Minder(stop, 0.05)
    minder.start()
    minder.watch()
    went = [sent.acquire(timeout=10) for _ in range(3)]
    minder.end()

    assert went == [True] * 3
