"""The small parts of a run: folders, the metrics' file, signals, provenance."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest
import yaml

import envs_jax
from emrld_jax import algorithms
from emrld_jax.runs.cli import CONF, run_command, train_config
from emrld_jax.runs.config import ConfigError, EnvSettings, TrainConfig, check_config, default_w_rl
from emrld_jax.runs.folder import RunFolder, new_folder, new_run_folder
from emrld_jax.runs.metrics import MetricsLog, read_metrics
from emrld_jax.runs.provenance import code_version, sha256
from emrld_jax.runs.saved import load_config, save_config
from emrld_jax.runs.setup import set_up
from emrld_jax.runs.signals import TOLD, StopSignals
from envs_jax.physics import models


def test_a_run_never_overwrites_another(tmp_path: Path) -> None:
    config = TrainConfig(algo="maml", runs=str(tmp_path), seed=4, env=EnvSettings("two_wheeled"))
    first, note = new_run_folder(config, "")
    assert first.path == tmp_path / "two_wheeled" / "maml-optimal" / "seed4"
    assert note == ""
    second, note = new_run_folder(config, "")
    assert second.path.name == "seed4_2"
    assert first.resume_command in note  # it is unfinished
    first.results.write_text("{}")
    third, note = new_run_folder(config, "")
    assert third.path.name == "seed4_3"
    assert "resume" not in note
    assert "seed4_3" in note


def test_a_missing_package_ends_a_command_with_one_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(models, "find_spec", lambda package: None)

    def main() -> int:
        set_up(train_config(["env=half_cheetah"]))
        return 0

    with pytest.raises(SystemExit) as ended:
        run_command(main)
    assert ended.value.code == 2
    expected = "error: mujoco is not installed: pip install 'emrld-jax[mujoco]'\n"
    assert capsys.readouterr().err == expected


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


@pytest.mark.parametrize("line", ["{", "[]", "{}", '{"iteration": "1"}'])
def test_a_malformed_line_of_metrics_is_named(tmp_path: Path, line: str) -> None:
    lines = tmp_path / "metrics.jsonl"
    lines.write_text(f'{{"iteration": 0}}\n{line}\n')
    with pytest.raises(ConfigError, match=r"metrics\.jsonl, line 2"):
        read_metrics(lines)


def test_a_configuration_is_read_as_it_was_written(tmp_path: Path) -> None:
    config = TrainConfig(demos='${nope} it\'s "x".npz', seed=3)
    save_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config
    assert [file.name for file in tmp_path.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("  max_kl: 0.01\n", "", "lacks meta.max_kl"),
        ("seed: 0", "sed: 0", "lacks seed"),
        ("seed: 0", "seed: 0\nsed: 0", "unknown settings: sed"),
        ("seed: 0", "seed: x", "could not be converted to Integer"),
        ("seed: 0", "seed: [", "config.yaml: "),
        ("runs: runs", "runs: null", "runs=None is not allowed"),
        ("horizon: 100", "horizon: 0", "env.horizon=0 is not allowed"),
    ],
)
def test_a_changed_configuration_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "config.yaml"
    save_config(TrainConfig(), path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_config(path)


def test_bounds_are_told_with_all_their_digits() -> None:
    with pytest.raises(ConfigError, match=r"at least 0 and at most 1000000000$"):
        check_config(TrainConfig(seed=-1))


def test_metrics_are_valid_json(tmp_path: Path) -> None:
    with (
        MetricsLog(tmp_path / "metrics.jsonl", tmp_path / "events", 0) as log,
        pytest.raises(ValueError, match="JSON"),
    ):
        log.write({"iteration": 0, "outer/kl": float("nan")})


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_is_noted_and_the_second_would_end(
    number: int, code: int, capfd: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(number)
    with StopSignals() as stop:
        assert stop.exit_code == 0
        os.kill(os.getpid(), number)
        assert stop.received == number
        assert stop.exit_code == code
        assert signal.getsignal(number) is signal.SIG_DFL
    assert signal.getsignal(number) is before
    assert capfd.readouterr().err.splitlines() == [TOLD]


@pytest.mark.parametrize(("quality", "w_rl"), [("optimal", 0.2), ("suboptimal", 1.0), ("my", 0.2)])
def test_the_weight_of_the_policy_gradient_follows_the_demonstrations(
    quality: str, w_rl: float
) -> None:
    assert default_w_rl(quality) == w_rl


def test_provenance_parts(tmp_path: Path) -> None:
    file = tmp_path / "x"
    file.write_bytes(b"abc")  # the hash's published test vector
    assert sha256(file) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    head = subprocess.run(
        ["git", "rev-parse", "HEAD"],
        check=False,
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
    )
    assert code_version()["commit"] == (head.stdout.strip() or "unknown")


def test_an_algorithms_own_defaults_come_after_the_environments() -> None:
    """What one wants otherwise in an environment comes after both, then experiment, arguments."""
    emrld, maml = (train_config(["env=point2d", f"algo={name}"]) for name in ("emrld", "maml"))
    assert emrld.policy == maml.policy
    tuned = yaml.safe_load((CONF / "tuned" / "point2d-maml.yaml").read_text())
    assert maml.meta.max_kl == tuned["meta"]["max_kl"] != emrld.meta.max_kl
    assert train_config(["env=two_wheeled", "algo=promp"]).meta.learning_rate == 0.001
    given = ["env=point2d", "algo=maml", "experiment=paper", "adapt.learning_rate=0.3"]
    config = train_config(given)
    assert (config.meta.max_kl, config.adapt.learning_rate) == (0.01, 0.3)


def test_every_file_of_tuned_defaults_is_for_an_environment_and_an_algorithm() -> None:
    for path in (CONF / "tuned").glob("*.yaml"):
        env, _, algo = path.stem.partition("-")
        assert env in envs_jax.names()
        assert algo in algorithms.names()
