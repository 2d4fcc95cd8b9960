"""The small parts of a run: folders, the metrics' file, signals, provenance."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from emrld_jax.runs.config import ConfigError, EnvSettings, TrainConfig, default_w_rl
from emrld_jax.runs.folder import RunFolder, new_folder, new_run_folder
from emrld_jax.runs.metrics import MetricsLog, read_metrics
from emrld_jax.runs.provenance import code_version, sha256
from emrld_jax.runs.signals import StopSignals


def test_a_run_never_overwrites_another(tmp_path: Path) -> None:
    config = TrainConfig(algo="maml", runs=str(tmp_path), seed=4, env=EnvSettings("two_wheeled"))
    first, note = new_run_folder(config)
    assert first.path == tmp_path / "two_wheeled" / "maml-optimal" / "seed4"
    assert note == ""
    second, note = new_run_folder(config)
    assert second.path.name == "seed4_2"
    assert first.resume_command in note  # it is unfinished
    first.results.write_text("{}")
    third, note = new_run_folder(config)
    assert third.path.name == "seed4_3"
    assert "resume" not in note
    assert "seed4_3" in note


def test_a_run_in_progress_cannot_be_continued(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with (
        folder.locked(),
        pytest.raises(ConfigError, match="another process"),
        RunFolder(tmp_path).locked(),
    ):
        pass
    with folder.locked():  # free again
        pass


def test_new_folder_makes_parents(tmp_path: Path) -> None:
    assert new_folder(tmp_path / "a" / "b").is_dir()


def test_metrics_after_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    lines = tmp_path / "metrics.jsonl"
    with MetricsLog(lines, tmp_path / "events", 0) as log:
        for i in range(4):
            log.write({"iteration": i, "outer/kl": 0.1 * i})
    with lines.open("a") as file:
        file.write('{"iteration": 4, "outer')  # cut off by a crash
    assert [record["iteration"] for record in read_metrics(lines)] == [0, 1, 2, 3]
    with MetricsLog(lines, tmp_path / "events", 2) as log:
        log.write({"iteration": 2, "outer/kl": 9.0})
    assert [record["outer/kl"] for record in read_metrics(lines)] == [0.0, 0.1, 9.0]


def test_metrics_are_valid_json(tmp_path: Path) -> None:
    with (
        MetricsLog(tmp_path / "metrics.jsonl", tmp_path / "events", 0) as log,
        pytest.raises(ValueError, match="JSON"),
    ):
        log.write({"iteration": 0, "outer/kl": float("nan")})


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_is_noted_and_the_second_would_end(number: int, code: int) -> None:
    before = signal.getsignal(number)
    with StopSignals() as stop:
        assert stop.exit_code == 0
        os.kill(os.getpid(), number)
        assert stop.received == number
        assert stop.exit_code == code
        assert signal.getsignal(number) is signal.SIG_DFL
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(("quality", "w_rl"), [("optimal", 0.2), ("suboptimal", 1.0), ("my", 0.2)])
def test_the_weight_of_the_policy_gradient_follows_the_demonstrations(
    quality: str, w_rl: float
) -> None:
    assert default_w_rl(quality) == w_rl


def test_provenance_parts(tmp_path: Path) -> None:
    file = tmp_path / "x"
    file.write_bytes(b"abc")  # the hash's published test vector
    assert sha256(file) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert json.dumps(code_version())
