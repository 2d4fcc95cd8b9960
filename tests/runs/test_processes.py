"""Several processes that train together."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import read_metrics
from tests.conftest import Command
from tests.runs.curves import assert_same_curve


def test_two_processes_have_the_curve_of_one(
    command: Command, start: tuple[str, ...], alone: Path, tmp_path: Path
) -> None:
    done = command("train", *start, f"runs={tmp_path}", "processes=2")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "point2d" / "emrld-lines" / "seed0"
    assert_same_curve(folder, alone)
    assert (folder / "results.json").is_file()
    assert [path.name for path in folder.parent.iterdir()] == ["seed0"]


Pair = list[subprocess.Popen[str]]


@pytest.fixture
def pair(environment: dict[str, str], start: tuple[str, ...], tmp_path: Path) -> Iterator[Pair]:
    """Two processes in the middle of a long training, with checkpoints already."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    known = {text.partition("=")[0]: text for text in (*start, "meta.iterations=100000")}
    arguments = [*known.values(), f"runs={tmp_path}", "num_seeds=2"]
    meeting = (f"distributed.coordinator=127.0.0.1:{port}", "distributed.num_processes=2")
    train = [sys.executable, "-m", "emrld_jax.train", *arguments, *meeting]
    processes = [
        subprocess.Popen(
            [*train, f"distributed.process_id={i}", "distributed.timeout=30"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for i in range(2)
    ]
    try:
        _wait_for_checkpoint(tmp_path / "point2d" / "emrld-lines" / "seed1", processes)
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def _wait_for_checkpoint(folder: Path, processes: Pair) -> None:
    """Returns once there is one of a later iteration than the first."""
    deadline = time.monotonic() + 120
    while not any(p.name.isdecimal() and int(p.name) > 1 for p in folder.glob("checkpoints/*")):
        assert time.monotonic() < deadline, "no checkpoint in time"
        assert all(process.poll() is None for process in processes)
        time.sleep(0.01)


def test_a_lost_process_ends_the_other_and_the_runs_go_on(
    pair: Pair, command: Command, tmp_path: Path
) -> None:
    pair[1].kill()
    output, _ = pair[0].communicate(timeout=60)
    assert pair[0].returncode == 1
    assert "error: another process has ended" in output
    assert "Traceback" not in output
    folder = tmp_path / "point2d" / "emrld-lines"
    assert f"resume={folder}" in output
    reached = len(read_metrics(folder / "seed0" / "metrics.jsonl"))
    done = command("train", f"resume={folder}", f"meta.iterations={reached + 1}", "devices=2")
    assert done.returncode == 0, done.stderr
    assert f"after iteration {reached}" in done.stdout
    assert len(read_metrics(folder / "seed1" / "metrics.jsonl")) == reached + 1


def test_what_the_first_process_refuses_ends_the_other_too(
    command: Command, start: tuple[str, ...], tmp_path: Path
) -> None:
    """The run to continue is locked by a process that trains in it."""
    assert command("train", *start, f"runs={tmp_path}").returncode == 0
    folder = tmp_path / "point2d" / "emrld-lines" / "seed0"
    with RunFolder(folder).locked():
        done = command("train", f"resume={folder}", "meta.iterations=9", "processes=2")
    assert done.returncode == 2
    assert "another process is training" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_signal_to_any_process_stops_all_of_them(pair: Pair, tmp_path: Path) -> None:
    pair[1].send_signal(signal.SIGTERM)
    outputs = [process.communicate(timeout=60)[0] for process in pair]
    assert [process.returncode for process in pair] == [143, 143], outputs
    assert "Stopped after iteration" in outputs[0]
    records = [
        read_metrics(tmp_path / "point2d" / "emrld-lines" / f"seed{seed}" / "metrics.jsonl")
        for seed in range(2)
    ]
    assert len(records[0]) == len(records[1]) > 1
