"""Recordings: written as episodes end, read back whole or refused; ROS's tools open them."""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from bridges.driving import Drive, actor
from bridges.episodes import Episode
from bridges.messages import TWIST, TWIST_STAMPED, BridgeError
from bridges.policy import Policy
from bridges.recording import Recorder, header_of, read, whole_episodes
from bridges.recording_checks import INDEX, RecordingError
from bridges.robot import TurtleBot3
from tests.bridges import robot_bundles
from tests.bridges.fake_robot import FakeRobot, rules

BUNDLE = robot_bundles.constant((0.8, 0.0), log_std=-5.0)


def header(**changes: Any) -> Any:
    given = {"noise": True, "dry_run": False, "command_type": TWIST_STAMPED, "driving": {"a": 1}}
    return header_of(BUNDLE, **{**given, **changes})


def driven(seed: int = 0, broken: bool = False) -> Episode:
    fake = FakeRobot(start=(0.3, -0.2, 2.0))
    if broken:
        fake.change = lambda now, o: [o] if now < 4 else [o._replace(x=math.nan)]
    robot = TurtleBot3(fake, fake.clock, rules())
    robot.connect()
    act = actor(Policy(BUNDLE), np.random.default_rng(seed))
    assert BUNDLE.zone is not None
    return Drive(robot, act, BUNDLE.zone, fake.clock, 0.5).run()


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    return [driven(0), driven(1, broken=True), driven(2)]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode]) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "recording"
    recorder = Recorder(folder, header())
    for episode in episodes:
        recorder.add(episode)
    return folder


@pytest.fixture
def folder(tmp_path: Path, original: Path) -> Path:
    """A copy, to spoil."""
    return Path(shutil.copytree(original, tmp_path / "recording"))


def assert_same(found: Episode, written: Episode) -> None:
    """The episode that was read is the one that was written, whose times began elsewhere."""
    for step, other in zip(found.steps, written.steps, strict=True):
        assert np.array_equal(step.obs, other.obs)
        assert np.array_equal(step.action, other.action)
        assert step[3:] == other[3:]
        assert step.time == pytest.approx(other.time - written.began)
    assert np.array_equal(found.last_pose, written.last_pose)
    for message, told in zip(found.odometry, written.odometry, strict=True):
        assert message[2:] == pytest.approx(told[2:], nan_ok=True)
        assert message.stamp == pytest.approx(told.stamp, abs=2e-9)
        assert message.received == pytest.approx(told.received - written.began, abs=2e-9)
    for (when, command), (moment, sent) in zip(found.commands, written.commands, strict=True):
        assert command == sent
        assert when == pytest.approx(moment - written.began, abs=2e-9)
    for name in ("began_wall", "ending", "detail", "missed"):
        assert getattr(found, name) == getattr(written, name)


def test_what_is_written_is_read(folder: Path, episodes: list[Episode]) -> None:
    found_all = read(folder)

    assert found_all.header == header()
    assert [episode.ending for episode in episodes] == ["success", "not finite", "success"]
    for found, written in zip(found_all.episodes, episodes, strict=True):
        assert_same(found, written)
    assert len(whole_episodes(found_all)) == 2


@pytest.mark.parametrize("command_type", [TWIST, TWIST_STAMPED])
def test_an_independent_reader_finds_ros_messages(
    tmp_path: Path, episodes: list[Episode], command_type: str
) -> None:
    episode = episodes[0]
    Recorder(tmp_path / "r", header(command_type=command_type)).add(episode)

    with AnyReader([tmp_path / "r" / "episode_000"]) as reader:
        kinds = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        rows = [(c.topic, t, reader.deserialize(d, c.msgtype)) for c, t, d in reader.messages()]

    assert kinds == {
        "/odom": ("nav_msgs/msg/Odometry", len(episode.odometry)),
        "/cmd_vel": (command_type, len(episode.commands)),
        "/emrld/steps": ("std_msgs/msg/Float64MultiArray", len(episode.steps)),
        "/emrld/episode": ("std_msgs/msg/String", 1),
    }
    odometry: Any = [message for topic, _, message in rows if topic == "/odom"]
    first = episode.odometry[0]
    assert odometry[0].header.frame_id == "odom"
    assert odometry[0].child_frame_id == "base_footprint"
    stamp = odometry[0].header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(first.stamp, abs=1e-8)
    turn = odometry[0].pose.pose.orientation
    assert 2 * math.atan2(turn.z, turn.w) == pytest.approx(first.theta)
    assert odometry[-1].pose.pose.position.x == episode.odometry[-1].x
    commands: Any = [message for topic, _, message in rows if topic == "/cmd_vel"]
    twist = commands[0] if command_type == TWIST else commands[0].twist
    assert (twist.linear.x, twist.angular.z) == episode.commands[0][1]
    if command_type == TWIST_STAMPED:  # by the clock that the bag's own times are of
        stamped = [1e9 * m.header.stamp.sec + m.header.stamp.nanosec for m in commands]
        written = [t for topic, t, _ in rows if topic == "/cmd_vel"]
        np.testing.assert_allclose(stamped, written, rtol=0, atol=1e4)
    assert [t for _, t, _ in rows] == sorted(t for _, t, _ in rows)
    about: Any = rows[-1][2]
    assert json.loads(about.data)["recording"]["bundle"] == BUNDLE.content_sha256


def test_humble_reads_the_bags_metadata(folder: Path) -> None:
    """Its reader knows no version after 8, and takes a topic's QoS as a text that holds YAML."""
    text = (folder / "episode_000" / "metadata.yaml").read_text()
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["version"] == 8
    for topic in information["topics_with_message_count"]:
        (qos,) = yaml.safe_load(topic["topic_metadata"]["offered_qos_profiles"])
        assert (qos["history"], qos["depth"]) == (1, 10)  # as rmw numbers them: keep last
        assert (qos["reliability"], qos["durability"]) == (1, 2)  # reliable, volatile


def test_a_recording_goes_on_where_it_was(folder: Path, episodes: list[Episode]) -> None:
    recorder = Recorder(folder, header())
    assert recorder.whole == 2
    recorder.add(episodes[0])

    assert [e.ending for e in read(folder).episodes] == [e.ending for e in [*episodes, episodes[0]]]


def test_a_recording_of_something_else_is_not_continued(folder: Path, tmp_path: Path) -> None:
    other = robot_bundles.constant((0.0, 0.0)).content_sha256
    with pytest.raises(RecordingError, match="another bundle"):
        Recorder(folder, replace(header(), bundle=other))
    with pytest.raises(RecordingError, match="recorded with a=1, not 2:"):
        Recorder(folder, header(driving={"a": 2}))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RecordingError, match="is not empty, and no recording"):
        Recorder(tmp_path, header())


@pytest.mark.parametrize("where", ["fsync", "rename"])
def test_what_ends_the_writing_loses_no_other_episode(
    folder: Path, episodes: list[Episode], where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing tidies up after the writing is broken off, as after a kill."""

    def broken_off(*_: Any) -> None:
        raise KeyboardInterrupt

    recorder = Recorder(folder, header())
    with monkeypatch.context() as patch:
        patch.setattr(os, where, broken_off)
        with pytest.raises(KeyboardInterrupt):
            recorder.add(episodes[0])
    assert len(read(folder).episodes) == 3
    (folder / "episode_003").mkdir(exist_ok=True)  # or just after the renaming

    Recorder(folder, header()).add(episodes[0])

    assert len(read(folder).episodes) == 4
    bags = [f"episode_{k:03d}" for k in range(4)]
    assert sorted(path.name for path in folder.iterdir()) == [*bags, INDEX]


def edit(folder: Path, change: Any) -> None:
    index = json.loads((folder / INDEX).read_text())
    change(index)
    (folder / INDEX).write_text(json.dumps(index))


def damage(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))


MCAP = "episode_001/episode_001.mcap"


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / INDEX).unlink(), "is no recording"),
        (lambda f: (f / INDEX).write_text("{"), "is not JSON"),
        (lambda f: (f / INDEX).write_text("[]"), "does not say format"),
        (lambda f: edit(f, lambda i: i.update(version=2)), "version 2"),
        (lambda f: edit(f, lambda i: i.pop("bundle")), "bundle is missing"),
        (lambda f: edit(f, lambda i: i.update(horizon="9")), "horizon is missing, or of another"),
        (lambda f: edit(f, lambda i: i["episodes"][0].pop("sha256")), r"episodes\[0\] lacks"),
        (lambda f: edit(f, lambda i: i["episodes"][0].update(bag="../x")), "is in bag"),
        (lambda f: edit(f, lambda i: i.update(bundle="0" * 64)), "is of another recording"),
        (lambda f: (f / MCAP).unlink(), "is missing"),
        (lambda f: damage(f / MCAP), "damaged or changed"),
        (lambda f: (f / MCAP).write_bytes((f / MCAP).read_bytes()[:-100]), "damaged or changed"),
        (lambda f: (f / "episode_001/metadata.yaml").unlink(), "cannot be read as a bag"),
        (lambda f: (f / "episode_001/metadata.yaml").write_text("a: ["), "cannot be read as a bag"),
    ],
)
def test_a_recording_that_is_not_whole_is_refused(folder: Path, spoil: Any, words: str) -> None:
    spoil(folder)

    with pytest.raises(BridgeError, match=words):
        read(folder)


def test_a_bag_of_something_else_is_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    for name in ("episode_000", "episode_001"):
        shutil.rmtree(folder / name)
        shutil.copytree(other / "episode_002", folder / name)
        (folder / name / "episode_002.mcap").rename(folder / name / f"{name}.mcap")
    with pytest.raises(RecordingError, match="damaged or changed"):
        read(folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: e._replace(ending="horizon"), "does not end in 'horizon'"),
        (lambda e: e._replace(steps=e.steps[:-1]), "does not end in 'success'"),
        (
            lambda e: e._replace(steps=(e.steps[0]._replace(time=e.steps[1].time), *e.steps[1:])),
            "not in the order of time",
        ),
        (
            lambda e: e._replace(steps=(e.steps[0]._replace(done=True), *e.steps[1:])),
            "goes on after a step that ends it",
        ),
        (
            lambda e: e._replace(steps=(e.steps[0]._replace(log_prob=math.inf), *e.steps[1:])),
            "not one of an episode",
        ),
    ],
)
def test_episodes_that_cannot_be_are_refused(
    tmp_path: Path, episodes: list[Episode], change: Any, words: str
) -> None:
    Recorder(tmp_path / "r", header()).add(change(episodes[0]))

    with pytest.raises(BridgeError, match=words):
        read(tmp_path / "r")
