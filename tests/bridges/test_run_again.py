"""`bridges.run` in a folder that is not empty: what it goes on with, and what it refuses."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from bridges import adapting, bundle
from bridges.kept import folder_of
from bridges.messages import BridgeError
from bridges.recording import read
from bridges.run_settings import RunConfig
from tests.bridges import robot_bundles
from tests.bridges.conftest import AHEAD, Run, moves
from tests.bridges.fake_robot import FakeRobot

REAL = {"robot": "dds", "reset": "service"}


def test_a_full_folder_of_a_simulation_is_none_of_a_robot(
    main: Run, fake: FakeRobot, tmp_path: Path
) -> None:
    assert main(mode="collect", episodes=1, residual_angular_velocity=-0.65) == 0
    sent = len(fake.received)

    with pytest.raises(BridgeError) as error:
        main("--yes", mode="collect", episodes=1, **REAL)

    said = str(error.value)
    assert f"{tmp_path}/out/recording_0 was recorded with robot=memory, not real" in said
    assert "residual_angular_velocity=-0.65, not 0.0" in said
    assert "choose another out=" in said
    assert "max_linear" not in said
    assert "sim." not in said
    assert len(fake.received) == sent


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"sim.drift": 0.5}, "recorded with sim.drift=0.0, not 0.5:"),
        ({"seed": 1}, "recorded with seed=0, not 1:"),
        ({"max_linear": 0.1}, "recorded with max_linear=0.22, not 0.1:"),
        ({"dry_run": "true"}, "recorded with dry_run=False, not True:"),
    ],
)
def test_a_full_folder_is_only_of_the_same_settings(
    main: Run, settings: dict[str, Any], words: str
) -> None:
    assert main(mode="collect", episodes=1) == 0
    for episodes in (1, 2):  # whether or not any is missing
        with pytest.raises(BridgeError, match=words):
            main(mode="collect", episodes=episodes, **settings)


def test_a_robot_is_the_same_however_it_is_reached(
    main: Run, fake: FakeRobot, tmp_path: Path
) -> None:
    assert main("--yes", mode="collect", episodes=1, **REAL) == 0
    assert main("--yes", mode="collect", episodes=2, **{**REAL, "robot": "rclpy"}) == 0

    assert len(read(tmp_path / "out" / "recording_0").episodes) == 2


def test_simulated_episodes_have_another_folder_by_default() -> None:
    given = {name: folder_of(RunConfig("a/p.safetensors", name)) for name in ("dds", "memory")}

    assert given == {"dds": Path("robot/p"), "memory": Path("simulated/p")}
    assert folder_of(RunConfig("p.safetensors", "dds", dry_run=True)) == Path("dry_run/p")
    assert folder_of(RunConfig("p.safetensors", "memory", out="here")) == Path("here")


def test_one_by_one_with_the_same_bundle_executes_the_adapted_one(
    main: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for mode in ("collect", "adapt", "execute"):
        assert main(mode=mode, episodes=1) == 0
    said = capsys.readouterr().out
    assert f"{out}/adapted.safetensors is driven: it was adapted from the bundle" in said
    assert "not adapted" not in said
    made = bundle.read(out / "adapted.safetensors")
    assert read(out / "execution").header.bundle == made.content_sha256

    # adapted again, it would be another bundle than the one that was executed
    assert main(mode="adapt") == 0
    assert "is adapted to the recording already" in capsys.readouterr().out
    assert main(mode="execute", episodes=2, bundle=out / "adapted.safetensors") == 0
    assert len(read(out / "execution").episodes) == 2


def test_a_bundle_without_an_adapted_one_is_executed_with_a_note(
    main: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(mode="execute", episodes=1) == 0

    assert "note: the bundle is not adapted" in capsys.readouterr().out
    assert read(tmp_path / "out" / "execution").header.bundle == AHEAD.content_sha256
    with pytest.raises(BridgeError, match="another bundle than the one that adaptation makes"):
        main(episodes=1)  # would collect and adapt first
    assert not (tmp_path / "out" / "recording_0").exists()


def test_an_adapted_bundle_of_other_recordings_is_not_taken_by_itself(
    main: Run, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    assert main(mode="collect", episodes=1, out=elsewhere) == 0
    assert main(mode="adapt", recordings=f"[{elsewhere}/recording_0]") == 0

    with pytest.raises(BridgeError, match="but not to the recordings"):
        main(mode="execute", episodes=1)
    adapted = tmp_path / "out" / "adapted.safetensors"
    assert main(mode="execute", episodes=1, bundle=adapted) == 0


def test_no_episodes_are_added_to_what_was_learned_from(
    main: Run, fake: FakeRobot, tmp_path: Path
) -> None:
    adapted = tmp_path / "out" / "adapted.safetensors"
    assert main("--yes", mode="collect", episodes=1, **REAL) == 0
    assert main("--yes", episodes=2, **REAL) == 0  # not adapted yet: more are collected
    before, sent = adapted.read_bytes(), len(fake.received)

    for mode in ("all", "collect"):
        with pytest.raises(BridgeError, match=r"learned from .* choose another folder with out="):
            main("--yes", episodes=3, mode=mode, **REAL)

    assert len(fake.received) == sent
    assert adapted.read_bytes() == before
    assert main("--yes", episodes=3, mode="execute", **REAL) == 0
    assert moves(fake) > 0
    assert len(read(tmp_path / "out" / "execution").episodes) == 3


def test_several_inner_steps_are_executed_by_the_first_bundle_too(
    main: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = robot_bundles.constant((0.9, 0.0), log_std=-4.0, num_steps=2)
    bundle.write(tmp_path / "policy.safetensors", two)
    assert main(episodes=1) == 0
    assert main(episodes=2, mode="execute") == 0

    out = tmp_path / "out"
    made = bundle.read(out / "adapted.safetensors")
    assert read(out / "execution").header.bundle == made.content_sha256
    with pytest.raises(BridgeError, match="learned from"):
        main(episodes=2)


def test_a_signal_during_adaptation_ends_after_it(
    main: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    adapt, reached = adapting.adapted, []

    def adapted(*arguments: Any) -> Any:
        for _ in range(2):  # people are impatient
            os.kill(os.getpid(), signal.SIGINT)
        reached.append(capfd.readouterr().err)
        return adapt(*arguments)

    monkeypatch.setattr(adapting, "adapted", adapted)
    assert main(episodes=1) == 130

    assert reached == ["\nSIGINT: ends after the adaptation\n" * 2]
    assert "stopped by SIGINT" in capfd.readouterr().err
    assert (tmp_path / "out" / "adapted.safetensors").is_file()
    assert not (tmp_path / "out" / "execution").exists()
    assert main(episodes=1) == 0  # goes on
    assert (tmp_path / "out" / "execution").is_dir()
