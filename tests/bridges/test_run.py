"""`bridges.run` from end to end, with a simulated robot in the same process."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridges import bundle, run
from bridges.bundle import Stage
from bridges.locking import locked
from bridges.messages import STOP, BridgeError
from bridges.policy import Policy
from bridges.recording import read
from bridges.recording_checks import INDEX
from bridges.run_settings import RunConfig
from bridges.signals import Interrupted, Signals
from bridges.stages import collectors
from tests.bridges import robot_bundles
from tests.bridges.conftest import AHEAD, ROOT, Run, moves
from tests.bridges.fake_robot import FakeRobot


def test_the_whole_loop(main: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(episodes=2, residual_angular_velocity=0.01) == 0
    said = capsys.readouterr().out

    before, after = read(out / "recording_0"), read(out / "execution")
    assert (before.header.noise, after.header.noise) == (True, False)
    assert [len(r.episodes) for r in (before, after)] == [2, 2]
    made = bundle.read(out / "adapted.safetensors")
    assert made.stage == (1, True)
    assert [before.header.bundle, after.header.bundle] == collectors(made)
    # what the robot turns by itself is beside what the policy asks for: 0.02 rad/s
    steps = [recording.episodes[0].steps[0] for recording in (before, after)]
    for step in steps:
        assert step.command.angular == pytest.approx(2.84 * step.action[1] + 0.02, abs=1e-6)
    assert np.allclose(steps[1].action, Policy(made).mean([0, 0, 0]), atol=1e-6)
    summary = json.loads((out / "summary.json").read_text())
    assert list(summary["recordings"]) == ["recording_0", "execution"]
    told = summary["recordings"]["recording_0"]
    returns = [sum(step.reward for step in episode.steps) for episode in before.episodes]
    assert told["return"] == pytest.approx(np.mean(returns))
    assert told["whole_episodes"] == 2
    for name in ("paths.png", "paths.svg"):
        assert (out / name).stat().st_size > 5000
    assert "adapted to 2 episodes" in said
    assert "recording_0: episode 2 of 2: " in said

    # once more: nothing is left to do
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*.mcap")}
    assert main(episodes=2, residual_angular_velocity=0.01) == 0
    said = capsys.readouterr().out
    assert said.count("2 whole episodes are there already") == 2
    assert "is adapted to the recording already" in said
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.mcap")} == files


def test_an_episode_has_its_own_noise_however_often_the_collecting_was_stopped(
    main: Run, tmp_path: Path
) -> None:
    for out, numbers in (("at_once", (3,)), ("bit_by_bit", (1, 2, 3))):
        for episodes in numbers:
            assert main(mode="collect", episodes=episodes, out=tmp_path / out) == 0
    first = [
        [
            episode.steps[0].action.tolist()
            for episode in read(tmp_path / out / "recording_0").episodes
        ]
        for out in ("at_once", "bit_by_bit")
    ]

    assert first[0] == first[1]
    assert len({tuple(action) for action in first[0]}) == 3


def test_parts_of_the_loop_one_by_one(
    main: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(mode="collect", episodes=2) == 0
    assert main(mode="adapt") == 0
    assert "adapted to 2 episodes" in capsys.readouterr().out
    adapted = out / "adapted.safetensors"
    assert main(mode="execute", episodes=1, bundle=adapted, deterministic="false") == 0
    assert read(out / "execution").header.noise

    with pytest.raises(BridgeError, match="adapted already"):
        main(mode="collect", bundle=adapted)
    with pytest.raises(BridgeError, match=r"elsewhere/recording_0 is missing; mode=collect"):
        main(mode="adapt", out=tmp_path / "elsewhere")
    with pytest.raises(BridgeError, match="is no recording"):
        main(mode="adapt", recordings=f"[{tmp_path}]")
    with pytest.raises(BridgeError, match="execution was recorded with noise=True, not False"):
        main(mode="execute", episodes=2)


def test_nothing_moves_before_a_person_has_agreed(
    main: Run, fake: FakeRobot, questions: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(robot="dds", mode="collect", episodes=3) == 0

    assert len(questions) == 3
    assert questions[0] == 0
    assert 0 < questions[1] < questions[2]
    said = capsys.readouterr().out
    assert "at up to 0.22 m/s" in said
    assert "2.00 m ahead and 0.00 m to the left" in said
    assert said.count("Put the robot back to its start") == 2
    assert fake.resets == 0


def test_yes_spares_the_first_question(main: Run, fake: FakeRobot, questions: list[int]) -> None:
    assert main("--yes", robot="dds", mode="collect", episodes=2) == 0

    assert len(questions) == 1


def test_yes_says_that_a_command_that_goes_on_begins_where_the_robot_stands(
    main: Run, fake: FakeRobot, questions: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    told = []
    for episodes in (1, 3):
        assert main("--yes", robot="dds", mode="collect", episodes=episodes) == 0
        told.append(capsys.readouterr().out.count("wherever the robot stands now"))

    assert told == [0, 1]  # once: before the next one somebody is asked
    assert len(questions) == 1


def test_a_simulator_is_put_back_without_questions(
    main: Run, fake: FakeRobot, questions: list[int]
) -> None:
    assert main("--yes", robot="dds", mode="collect", episodes=2, reset="service") == 0

    assert not questions
    assert fake.resets >= 2


def test_without_anybody_to_ask_nothing_moves(
    main: Run, fake: FakeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nobody() -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", nobody)
    with pytest.raises(BridgeError, match="nobody to ask"):
        main(robot="dds", mode="collect")

    assert moves(fake) == 0


def test_a_dry_run_publishes_nothing_and_teaches_nothing(
    main: Run, fake: FakeRobot, questions: list[int]
) -> None:
    assert main(robot="dds", mode="collect", dry_run="true", episodes=1, reset="service") == 0

    assert not fake.received
    assert fake.resets == 0
    assert not questions
    with pytest.raises(BridgeError, match="dry run"):
        main(mode="adapt")
    with pytest.raises(BridgeError, match="dry_run has nothing to adapt from"):
        main(dry_run="true")


def test_three_episodes_in_a_row_may_not_be_broken_off(
    main: Run, fake: FakeRobot, tmp_path: Path, questions: list[int]
) -> None:
    began: list[float] = []

    def silent(now: float, odometry: Any) -> Any:
        """Nothing is told while it drives, from 2 s on."""
        if odometry.linear == 0:
            began[:] = [now]
        return [odometry] if now - began[0] < 2 else []

    fake.change = silent
    with pytest.raises(BridgeError, match=r"3 episodes in a row were broken off.*stale"):
        main("--yes", robot="dds", mode="collect")

    episodes = read(tmp_path / "out" / "recording_0").episodes
    assert [episode.ending for episode in episodes] == ["stale"] * 3
    assert (tmp_path / "out" / "summary.json").is_file()  # what was driven is worth seeing
    assert len(questions) == 2
    assert fake.received[-1][1] == STOP


def test_an_episode_that_cannot_begin_is_broken_off_and_the_next_one_may(
    main: Run, fake: FakeRobot, tmp_path: Path
) -> None:
    fake.start = fake.pose = (9.0, 0.0, 0.0)  # outside the arena around odometry's origin
    put_back = iter([None, (0.0, 0.0, 0.0)])

    def person(question: str) -> None:
        fake.pose = next(put_back) or fake.pose

    config = RunConfig(
        str(tmp_path / "policy.safetensors"),
        *("dds", "collect", 1, str(tmp_path / "out")),
        origin="odometry",
    )
    assert run.run(config, person) == 0

    episodes = read(tmp_path / "out" / "recording_0").episodes
    assert [episode.whole for episode in episodes] == [False, True]
    assert (episodes[0].ending, len(episodes[0].steps)) == ("arena", 0)


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        (signal.SIGTERM, 143),
        (signal.SIGHUP, 129),
        (signal.SIGQUIT, 131),
        (signal.SIGTSTP, 148),  # Ctrl-Z would leave it driving
    ],
)
def test_a_signal_stops_the_robot_and_keeps_what_is_recorded(
    main: Run, fake: FakeRobot, tmp_path: Path, number: int, code: int
) -> None:
    def interrupt(now: float, odometry: Any) -> Any:
        if 40 <= len(fake.received) < 44:  # more than once: people are impatient
            os.kill(os.getpid(), number)
        return [odometry]

    fake.change = interrupt
    assert main("--yes", robot="dds", mode="collect", episodes=2, reset="service") == code

    (episode,) = read(tmp_path / "out" / "recording_0").episodes
    assert (episode.ending, episode.detail) == ("interrupted", signal.Signals(number).name)
    assert 1 <= len(episode.steps) <= 5
    assert [command for _, command in fake.received[-10:]] == [STOP] * 10
    assert (tmp_path / "out" / "summary.json").is_file()
    fake.change = lambda now, odometry: [odometry]
    assert main("--yes", robot="dds", mode="collect", episodes=2, reset="service") == 0
    whole = [e.whole for e in read(tmp_path / "out" / "recording_0").episodes]
    assert whole == [False, True, True]


def test_one_command_at_a_time_writes_to_a_folder(main: Run, tmp_path: Path) -> None:
    with locked(tmp_path / "out"):
        with pytest.raises(BridgeError, match="another command is writing to"):
            main(mode="collect", episodes=1)
        assert list((tmp_path / "out").iterdir()) == []
    assert not (tmp_path / "out").exists()  # nothing came of it
    assert main(mode="collect", episodes=1) == 0


def test_a_signal_is_raised_at_once_where_nothing_drives() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with Signals(), pytest.raises(Interrupted, match="SIGTERM"):
        os.kill(os.getpid(), signal.SIGTERM)

    assert signal.getsignal(signal.SIGTERM) == before


def test_a_signal_whose_exception_got_lost_ends_the_command_all_the_same() -> None:
    with Signals() as signals:
        with suppress(Interrupted):  # as a library does that calls Python back
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Interrupted, match="SIGTERM"):
            signals.check()


def test_a_signal_that_is_postponed_is_told_and_raised_at_the_end(
    capfd: pytest.CaptureFixture[str],
) -> None:
    reached = []

    def work(signals: Signals) -> None:
        with signals.postponed("the work"):
            os.kill(os.getpid(), signal.SIGINT)
            reached.append(capfd.readouterr().err)

    with Signals() as signals, pytest.raises(Interrupted, match="SIGINT"):
        work(signals)
    assert reached == ["\nSIGINT: ends after the work\n"]


def test_a_loop_that_hangs_is_ended_by_a_later_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    moments = iter([10.0, 10.0, 10.9, 11.1])
    monkeypatch.setattr("bridges.signals.time.monotonic", lambda: next(moments))
    seen = []

    def hang(signals: Signals) -> None:
        with signals.deferred():
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGINT)
                seen.append(signals.reason())

    with Signals() as signals, pytest.raises(Interrupted):
        hang(signals)
    assert seen == ["SIGINT", "SIGINT"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"bundle": "null"}, "bundle=FILE is missing"),
        ({"bundle": "nowhere"}, "there is no such file"),
        ({"bundle": ROOT}, f"python -m emrld_jax.export run={ROOT} out=policy.safetensors"),
        ({"robot": "dds", "sim.drift": 1}, "sim.* is for robot=memory"),
        ({"speed": 2}, "speed has no meaning with robot=memory"),
        ({"max_linear": 0}, "max_linear=0.0 is not allowed"),
        ({"residual_angular_velocity": 5}, "no command is allowed"),
    ],
)
def test_what_is_wrong_is_told_before_anything_moves(
    main: Run, settings: dict[str, Any], words: str
) -> None:
    with pytest.raises(BridgeError) as error:
        main(mode="collect", **settings)

    assert words in str(error.value)


def test_a_policy_that_drives_something_else_is_refused(main: Run, tmp_path: Path) -> None:
    bundle.write(tmp_path / "point.safetensors", robot_bundles.of_point2d())
    with pytest.raises(BridgeError, match="the bundle is of point2d, whose policy sees x, y"):
        main(bundle=tmp_path / "point.safetensors")

    assert not (tmp_path / "out").exists()


def test_help_names_the_settings_and_needs_no_jax_nor_rosbags() -> None:
    code = (
        "import sys, runpy; sys.argv = ['x', '--help']\n"
        "try: runpy.run_module('bridges.run', run_name='__main__')\n"
        "except SystemExit as end: assert not end.code\n"
        "heavy = {'jax', 'rosbags', 'matplotlib', 'cyclonedds'}\n"
        "sys.exit(not heavy.isdisjoint(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    for name in ("mode=all", "watchdog=0.5", "residual_angular_velocity=0.0", "link.peers=[]"):
        assert f"\n  {name}\n" in done.stdout


def test_an_index_that_lies_is_found_out(main: Run, tmp_path: Path) -> None:
    assert main(mode="collect", episodes=1) == 0
    index = tmp_path / "out" / "recording_0" / INDEX
    index.write_text(index.read_text().replace('"noise": true', '"noise": false'))
    with pytest.raises(BridgeError, match="is of another recording"):
        main(mode="adapt")


def test_a_robots_computer_needs_neither_jax_nor_matplotlib(main: Run, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "missing = ('jax', 'flax', 'matplotlib', 'omegaconf', 'hydra')\n"
        "sys.modules.update(dict.fromkeys(missing))\n"
        "from bridges import run\n"
        "try:\n"
        "    sys.argv.append('mode=all')\n"
        "    run.main()\n"
        "except run.BridgeError as error:\n"
        "    print('refused before it drives:', error)\n"
        "sys.argv[-1] = 'mode=collect'\n"
        "print(run.main())\n"
        "sys.argv[1:] = [x for x in sys.argv[1:] if 'mode' not in x] + ['mode=adapt']\n"
        "run.run_command(run.main)"
    )
    given = (f"bundle={tmp_path}/policy.safetensors", f"out={tmp_path}/out", "robot=memory")
    done = subprocess.run(
        [sys.executable, "-c", code, *given, "episodes=1"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert done.stdout.startswith("refused before it drives: adapting needs JAX")
    assert "no picture, for matplotlib is missing\n0\n" in done.stdout
    assert done.returncode == 2
    assert done.stderr.startswith("error: adapting needs JAX")


def test_a_bundle_that_is_adapted_already_is_only_executed(main: Run, tmp_path: Path) -> None:
    bundle.write(tmp_path / "adapted.safetensors", replace(AHEAD, stage=Stage(0, True)))
    assert main(bundle=tmp_path / "adapted.safetensors", episodes=1) == 0

    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert list(summary["recordings"]) == ["execution"]


def test_every_inner_step_has_a_recording_of_its_own(main: Run, tmp_path: Path) -> None:
    policy = robot_bundles.constant((0.9, 0.0), log_std=-4.0, num_steps=2)
    bundle.write(tmp_path / "policy.safetensors", policy)
    assert main(episodes=2) == 0

    out = tmp_path / "out"
    between = bundle.read(out / "policy_1.safetensors")
    made = bundle.read(out / "adapted.safetensors")
    assert (between.stage, made.stage) == ((1, False), (2, True))
    hashes = [
        read(out / name).header.bundle for name in ("recording_0", "recording_1", "execution")
    ]
    assert hashes == [one.content_sha256 for one in (policy, between, made)]
    assert main(episodes=2) == 0  # finds all of it


def test_a_robot_in_real_time_is_told_of_before_an_episode_ends(
    main: Run, fake: FakeRobot, capsys: pytest.CaptureFixture[str]
) -> None:
    said: list[str] = []

    def listen(now: float, odometry: Any) -> Any:
        if odometry.linear and not said:
            said.append(capsys.readouterr().out)
        return [odometry]

    fake.change = listen
    assert main("--yes", robot="dds", mode="collect", episodes=1) == 0

    (before,) = said
    assert "connected to the robot, which takes geometry_msgs/msg/TwistStamped\n" in before
    assert re.search(r"recording_0: episode 1 of 1 begins, at most \d+ s\n", before)


@pytest.mark.parametrize(("speed", "told"), [(-1.0, True), (0.9, False)])
def test_a_robot_that_stood_still_while_collecting_is_told(
    main: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], speed: float, told: bool
) -> None:
    still = robot_bundles.constant((speed, 0.0), log_std=-6.0)
    bundle.write(tmp_path / "policy.safetensors", still)
    assert main(mode="collect", episodes=1) == 0

    assert ("the robot stood still in this episode" in capsys.readouterr().out) == told
