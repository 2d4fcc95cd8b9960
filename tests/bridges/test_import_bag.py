"""Teleoperated bags become demonstrations."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import envs_jax
from bridges import import_bag, teleoperation
from bridges.bag_content import BagContent
from bridges.bag_messages import ODOMETRY, command_message, odometry_message
from bridges.clock import VirtualClock
from bridges.driving import Drive, actor
from bridges.messages import STOP, TWIST, TWIST_STAMPED, BridgeError, Command, Odometry
from bridges.policy import Policy
from bridges.recording import Recorder, header_of
from bridges.robot import TurtleBot3
from bridges.run_settings import RunConfig
from bridges.simulation.robot import SimulatedRobot
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.transports.memory import pair
from bridges.world import driving_settings, rules_of, world
from emrld_jax import demos
from tests.bridges import robot_bundles

START = [1.0, -2.0, 0.7]
Script = tuple[tuple[float, Command], ...]
# what a person does: seconds and the velocities meanwhile
SCRIPT: Script = ((3.0, Command(0.2, 0.0)), (2.0, Command(0.1, 0.5)), (4.0, Command(0.2, 0.1)))
REST = 1.3  # s before and after
ARRIVAL = 1.7e9  # s: the bag's clock is another one than odometry's
STAMPS = 500.0

Rows = list[tuple[float, str, Any]]  # s, topic, odometry or command
Spoil = Callable[[Rows], Rows]


def driven(drift: float = 0.0, script: Script = SCRIPT) -> Rows:
    """Odometry and commands of a simulated robot that a person drives, at 20 commands a second."""
    robot: SimulatedRobot | None = None

    def tick(moment: float) -> None:
        assert robot is not None
        robot.tick(moment)

    clock = VirtualClock(0.01, tick)
    link, end = pair(clock)
    end.open()
    settings = SimulatedRobotSettings(start=START, drift=drift, quantization=None)
    robot = SimulatedRobot(end, settings)
    link.open()
    rows: Rows = []
    for seconds, command in ((REST, STOP), *script, (REST, STOP)):
        for _ in range(round(20 * seconds)):
            rows.append((clock.now(), "/cmd_vel", command))
            link.send(command)
            clock.sleep_until(clock.now() + 0.05)
            rows += [(o.received, "/odom", o) for o in link.take()]
    return rows


@pytest.fixture(scope="module")
def rows() -> Rows:
    return driven()


def write(
    folder: Path,
    rows: Rows,
    kind: str = TWIST,
    plugin: StoragePlugin = StoragePlugin.SQLITE3,
    store: Stores = Stores.ROS2_HUMBLE,
) -> Path:
    types = get_typestore(store)
    kinds = {"/odom": ODOMETRY, "/cmd_vel": kind}
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        topics = {topic for _, topic, _ in rows}
        connections = {t: writer.add_connection(t, kinds[t], typestore=types) for t in topics}
        for moment, topic, what in sorted(rows, key=lambda row: row[0]):
            if isinstance(what, Odometry):
                message = odometry_message(types.types, what._replace(stamp=what.stamp + STAMPS))
            else:
                message = command_message(types.types, what, kind, 0.0)
            data = types.serialize_cdr(message, kinds[topic])
            writer.write(connections[topic], round(1e9 * (ARRIVAL + moment)), data)
    return folder


@pytest.fixture
def main(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., str]:
    """The command in this process; what it says."""

    def call(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["import_bag", *arguments])
        assert import_bag.main() == 0
        return capsys.readouterr().out

    return call


# 9 s of driving, 18 steps
ACTIONS = [(0.2, 0.0)] * 6 + [(0.1, 0.5)] * 4 + [(0.2, 0.1)] * 8


@pytest.mark.parametrize(
    ("kind", "plugin", "store"),
    [
        (TWIST, StoragePlugin.SQLITE3, Stores.ROS2_HUMBLE),
        (TWIST_STAMPED, StoragePlugin.MCAP, Stores.ROS2_JAZZY),
    ],
)
def test_a_drive_becomes_a_demonstration(
    tmp_path: Path, rows: Rows, main: Any, kind: str, plugin: StoragePlugin, store: Stores
) -> None:
    bag = write(tmp_path / "bag", rows, kind, plugin, store)

    said = main(str(bag), "--out", str(tmp_path / "demos.npz"), "env=two_wheeled")

    env = envs_jax.make("two_wheeled")
    file = demos.load(tmp_path / "demos.npz", env)
    (obs,), (action,), (mask,) = (np.asarray(x) for x in file.train.demos)
    number = int(mask.sum())
    physical = np.array([env.to_physical(a) for a in action[:number]])
    # the goal is where the drive ended, so the episode ends 0.2 m before it
    assert 14 <= number <= 17
    assert physical == pytest.approx(np.array(ACTIONS[:number]), abs=0.012)
    assert obs[0] == pytest.approx([0, 0, 0], abs=1e-6)
    # 0.2 m/s for 3 s, straight on from where it stood; the way to that speed takes 0.08 s
    assert obs[6] == pytest.approx([0.6, 0.0, 0.0], abs=0.015)
    assert obs[10, 2] == pytest.approx(1.0, abs=0.03)
    assert bool(file.train.success[0])
    assert float(file.train.returns[0]) > 100 - 18
    assert file.quality == "teleoperated"
    assert "longest gap 0.03 s, 0 above 0.5 s" in said
    assert "task: goal=[" in said
    assert "all within the environment's bounds" in said
    assert "as driven: return" in said
    assert "replayed in two_wheeled: return" in said
    assert "steps after the episode's end were cut off" in said


def test_settings_name_the_task_and_the_file(tmp_path: Path, rows: Rows, main: Any) -> None:
    bag = write(tmp_path / "bag", rows)
    out = tmp_path / "demos.npz"

    said = main(f"bag={bag}", f"out={out}", "goal=[0.9,1.2]", "quality=suboptimal")

    file = demos.load(out, envs_jax.make("two_wheeled"))
    assert np.asarray(file.train.tasks.goal) == pytest.approx(np.array([[0.9, 1.2]]))
    assert file.quality == "suboptimal"
    assert "as given" in said
    with pytest.raises(BridgeError, match="exists; choose another file"):
        main(f"bag={bag}", f"out={out}")


def test_without_commands_odometry_tells_the_actions(tmp_path: Path, rows: Rows) -> None:
    from bridges import bag_content

    bag = write(tmp_path / "bag", [row for row in rows if row[1] == "/odom"])

    drive = teleoperation.resampled(bag_content.read(bag), 0.5)

    assert "no commands are in the bag" in " ".join(drive.notes)
    assert drive.action[1:5] == pytest.approx(np.array(ACTIONS[1:5]), abs=0.01)
    assert drive.action[7:9] == pytest.approx(np.array(ACTIONS[7:9]), abs=0.01)


def test_what_the_environment_cannot_do_is_clipped_and_told(
    tmp_path: Path, rows: Rows, main: Any
) -> None:
    bag = write(tmp_path / "bag", rows)

    said = main(
        *(str(bag), "--out", f"{tmp_path}/d.npz", "env=two_wheeled_drift"),
        "residual_angular_velocity=0",
    )

    # 0.2 m/s of 0 to 0.15 m/s: 5/3 in a policy's units, 2/3 too many
    assert "outside the environment's bounds, by up to 0.67 of a policy's units" in said
    assert "does not reach the goal" in said


def test_drift_is_guessed_but_must_be_given(tmp_path: Path, main: Any) -> None:
    bag = write(tmp_path / "bag", driven(drift=-0.4))

    with pytest.raises(BridgeError, match=r"needs residual_angular_velocity.*looks like -0\.20"):
        main(str(bag), "--out", f"{tmp_path}/d.npz", "env=two_wheeled_drift")


def changed(**values: float) -> Spoil:
    """All odometry after 5 s with these numbers added."""

    def spoil(rows: Rows) -> Rows:
        return [
            (t, topic, w._replace(**{k: getattr(w, k) + v for k, v in values.items()}))
            if topic == "/odom" and t > 5
            else (t, topic, w)
            for t, topic, w in rows
        ]

    return spoil


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (changed(x=math.nan), "is not finite"),
        (changed(x=1.0), "which no TurtleBot3 does"),
        (changed(stamp=3.0), "odometry is missing for 3"),
        (lambda rows: [r for r in rows if r[1] != "/odom"], "there is no odometry on /odom"),
        (lambda rows: [r for r in rows if r[1] == "/odom" or r[2] == STOP], "is never driven"),
        (
            lambda rows: [
                (t, k, w._replace(frame="map") if k == "/odom" else w) for t, k, w in rows
            ],
            "odometry is of 'base_footprint' in 'map'",
        ),
        (
            lambda rows: [
                (t, k, w._replace(x=1000 * w.x, y=1000 * w.y) if k == "/odom" else w)
                for t, k, w in rows
            ],
            "which no TurtleBot3 does",
        ),
    ],
)
def test_a_bag_that_is_no_drive_is_refused(
    tmp_path: Path, rows: Rows, main: Any, spoil: Spoil, words: str
) -> None:
    bag = write(tmp_path / "bag", spoil(rows))

    with pytest.raises(BridgeError) as error:
        main(str(bag), "--out", f"{tmp_path}/d.npz")

    assert words in str(error.value)
    assert not (tmp_path / "d.npz").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "bag=PATH is missing"),
        (("nowhere", "--out", "x.npz"), "there is no such bag"),
        (("bag", "--out", "x.txt"), "must end in .npz"),
        (("bag", "env=point2d"), "env=point2d is not allowed"),
        (("bag", "commands=/odom"), "/odom is of type nav_msgs/msg/Odometry; it must be"),
        (("bag", "goal=[1]"), "goal=[1.0] is not allowed: it must be [x,y]"),
        (("bag", "residual_angular_velocity=1"), "is two_wheeled_drift's"),
        (("bag", "env=two_wheeled_drift", "goal=[1,1]"), "goal is two_wheeled's"),
        (("bag", "goal=[90,1]"), "the demonstration is refused"),
        (("broken",), "cannot be read as a bag"),
    ],
)
def test_what_is_wrong_is_told(
    tmp_path: Path,
    rows: Rows,
    main: Any,
    arguments: Sequence[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    if "bag" in arguments:
        write(tmp_path / "bag", rows)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metadata.yaml").write_text("[")

    with pytest.raises(BridgeError) as error:
        main(*arguments)

    assert words in str(error.value)


def test_commands_hold_until_the_next_one() -> None:
    """Worked: 0.1 m/s from 0.2 s on, 0.3 m/s from 0.9 s on, nothing from 1.5 s on."""
    time = np.linspace(0, 3, 91)
    content = BagContent(
        time=time,
        pose=np.outer(time, [0.1, 0.0, 0.0]),
        twist=np.zeros((91, 2)),
        command_time=np.array([0.2, 0.9, 1.5]),
        command=np.array([[0.1, 0.0], [0.3, -1.0], [0.0, 0.0]]),
        notes=(),
    )

    drive = teleoperation.resampled(content, 0.5)

    # from 0.2 s to 1.5 s: 2.6 periods, so three
    assert drive.pose.shape == (4, 3)
    expected = [
        (0.1, 0.0),
        ((0.2 * 0.1 + 0.3 * 0.3) / 0.5, -0.3 / 0.5),
        (0.3 * 0.3 / 0.5, -0.3 / 0.5),
    ]
    assert drive.action == pytest.approx(np.array(expected))


@pytest.mark.parametrize(
    ("seconds", "command", "words"),
    [
        (3.0, STOP, "never driven"),
        (3.0, Command(0.0, 0.5), r"hardly moves in this bag: 0\.000 m .* in 6 control steps"),
        (0.4, Command(0.2, 0.0), r"m from where it began, in 1 control step;"),
    ],
)
def test_a_robot_that_hardly_moves_demonstrates_nothing(
    tmp_path: Path, main: Any, seconds: float, command: Command, words: str
) -> None:
    bag = write(tmp_path / "bag", driven(script=((seconds, command),)))

    with pytest.raises(BridgeError, match=words):
        main(str(bag), f"out={tmp_path}/demos.npz")
    assert not (tmp_path / "demos.npz").exists()


INJECTED = -0.6  # rad/s, 0.3 rad a control period


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode of 0.14 m/s and 0.1 rad/s by the policy; the bridge turned the robot meanwhile."""
    bundle = robot_bundles.constant((2 * 0.14 / 0.22 - 1, 0.1 / 2.84), log_std=-5.0)
    config = RunConfig("unused", "memory", residual_angular_velocity=0.5 * INJECTED)
    reached = world(config)
    header = header_of(
        bundle,
        noise=False,
        dry_run=False,
        command_type=TWIST_STAMPED,
        driving=driving_settings(config),
    )
    folder = tmp_path_factory.mktemp("out") / "recording_0"
    assert bundle.zone is not None
    with TurtleBot3(reached.link, reached.clock, rules_of(config, bundle)) as robot:
        act = actor(Policy(bundle), None)
        zone = bundle.zone._replace(horizon=10)
        Recorder(folder, header).add(Drive(robot, act, zone, reached.clock, 0.5).run())
    return folder


@pytest.mark.parametrize(
    ("arguments", "turns", "words"),
    [
        (("env=two_wheeled",), 0.1 + INJECTED, "actions are what was sent"),
        (("env=two_wheeled_drift", "residual_angular_velocity=-0.3"), 0.1, "taken off"),
    ],
)
def test_what_the_bridge_injected_is_told_and_taken_off(
    tmp_path: Path,
    recording: Path,
    main: Any,
    arguments: tuple[str, ...],
    turns: float,
    words: str,
) -> None:
    out = tmp_path / "demos.npz"
    said = main(str(recording / "episode_000"), f"out={out}", *arguments)

    assert f"added {INJECTED:g} rad/s to what its policy asked for: " in said
    assert words in said
    env = envs_jax.make(arguments[0].removeprefix("env="))
    (action,) = demos.load(out, env).train.demos.action
    physical = np.array([env.to_physical(a) for a in action])
    assert np.allclose(physical[1:-1, 1], turns, atol=0.001)
    assert np.allclose(physical[1:-1, 0], 0.14, atol=0.001)


def test_an_episode_is_asked_for_where_a_whole_recording_is_given(
    tmp_path: Path, recording: Path, main: Any
) -> None:
    with pytest.raises(BridgeError, match=r"whole recording .* such as .*recording_0/episode_000"):
        main(str(recording), f"out={tmp_path}/demos.npz")


def test_what_the_bridge_injected_is_found_without_being_told(recording: Path, main: Any) -> None:
    with pytest.raises(BridgeError, match=r"this drive looks like -0\.30"):
        main(str(recording / "episode_000"), "env=two_wheeled_drift")
