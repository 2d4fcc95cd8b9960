"""Runs of one program: numbers and seeds side by side, on several devices, in several processes."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from emrld_jax.meta.learner import MetaState
from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import read_metrics
from tests.conftest import Command
from tests.runs.conftest import TINY
from tests.runs.straight import write_demos

Records = list[dict[str, Any]]
NAMES = ("adapt/return_0", "adapt/return_1")


def assert_same_curve(ours: Path, theirs: Path) -> None:
    """Up to rounding, which conjugate gradient magnifies, by the second iteration to 1e-2."""
    own_records, their_records = (read_metrics(run / "metrics.jsonl") for run in (ours, theirs))
    for number, (own, expected) in enumerate(zip(own_records, their_records, strict=True)):
        for name in NAMES:
            rtol = 1e-2 if number else 1e-5
            np.testing.assert_allclose(own[name], expected[name], rtol=rtol, err_msg=name)
    assert_same_step(own_records[0], their_records[0])


def assert_same_step(ours: dict[str, float], theirs: dict[str, float]) -> None:
    """A first meta-step: its gradient up to rounding, its length as conjugate gradient has it."""
    tolerances = {"outer/gradient_norm": 1e-4, "outer/params_norm": 1e-3, "outer/kl": 3e-2}
    for name, rtol in tolerances.items():
        np.testing.assert_allclose(ours[name], theirs[name], rtol=rtol, err_msg=name)


def assert_other_curve(ours: Path, theirs: Path) -> None:
    first, second = (read_metrics(folder / "metrics.jsonl")[1] for folder in (ours, theirs))
    assert abs(first[NAMES[1]] / second[NAMES[1]] - 1) > 1e-4


@pytest.fixture(scope="session")
def even_demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four training tasks, which two and four devices can share."""
    return write_demos(tmp_path_factory.mktemp("even") / "lines.npz", num_train=4)


@pytest.fixture(scope="session")
def start(even_demos: Path) -> tuple[str, ...]:
    return ("env=point2d", f"demos={even_demos}", *TINY)


@pytest.fixture(scope="session")
def alone(
    command: Command, start: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run of seed 0 on one device."""
    runs = tmp_path_factory.mktemp("alone")
    done = command("train", *start, f"runs={runs}")
    assert done.returncode == 0, done.stderr
    return runs / "point2d" / "emrld-lines" / "seed0"


def test_numbers_and_seeds_side_by_side(
    command: Command, start: tuple[str, ...], alone: Path, tmp_path: Path
) -> None:
    """With w_rl = 0.2, the default, a run is what it is alone; with another value it is not."""
    varied = ("vmap.w_rl=[0.2,1.0]", "vmap.meta.max_kl=[0.01,0.03]", "num_seeds=2")
    done = command("train", *start, f"runs={tmp_path}", *varied)
    assert done.returncode == 0, done.stderr
    parent = tmp_path / "point2d" / "emrld-lines"
    folders = {
        (w, kl, seed): parent / f"w_rl={w:g},meta.max_kl={kl:g}" / f"seed{seed}"
        for w in (0.2, 1.0)
        for kl in (0.01, 0.03)
        for seed in (0, 1)
    }
    for (w, kl, seed), folder in folders.items():
        config = yaml.safe_load((folder / "config.yaml").read_text())
        assert (config["w_rl"], config["meta"]["max_kl"], config["seed"]) == (w, kl, seed)
        assert (config["vmap"], config["num_seeds"]) == ({}, 1)
        assert (folder / "results.json").is_file()
    assert_same_curve(folders[0.2, 0.03, 0], alone)
    for other in ((1.0, 0.03, 0), (0.2, 0.01, 0), (0.2, 0.03, 1)):
        assert_other_curve(folders[other], alone)
    assert "mean of 8 runs" in done.stdout


def test_runs_that_began_together_go_on_together(
    command: Command, start: tuple[str, ...], tmp_path: Path
) -> None:
    """Also where one of them was killed before its newest checkpoint."""
    arguments = (*start, f"runs={tmp_path}", "num_seeds=2", "vmap.w_bc=[0.2,1.0]")
    assert command("train", *arguments).returncode == 0
    parent = tmp_path / "point2d" / "emrld-lines"
    folders = [parent / f"w_bc={w}" / f"seed{seed}" for w in ("0.2", "1") for seed in (0, 1)]
    expected = [read_metrics(folder / "metrics.jsonl") for folder in folders]
    for folder in folders:
        (folder / "results.json").unlink()
    newest = folders[0] / "checkpoints" / "3"
    newest.rename(tmp_path / "aside")
    done = command("train", f"resume={parent}")
    assert done.returncode == 0, done.stderr
    assert "after iteration 2" in done.stdout
    for folder, records in zip(folders, expected, strict=True):
        again = read_metrics(folder / "metrics.jsonl")
        assert [r[NAMES[1]] for r in again] == [r[NAMES[1]] for r in records]
        assert (folder / "results.json").is_file()
    # what was ahead of the others was done again, and so was its checkpoint
    assert all((folder / "checkpoints" / "3").is_dir() for folder in folders)


def test_runs_to_continue_may_be_named_and_must_fit(
    command: Command, alone: Path, tmp_path: Path
) -> None:
    """Two of three unfinished runs; the third has another activation."""
    first, second, other = (tmp_path / name for name in ("first", "second", "other"))
    for folder in (first, second, other):
        shutil.copytree(alone, folder)
        (folder / "results.json").unlink()
    config = yaml.safe_load((other / "config.yaml").read_text())
    config["policy"]["activation"] = "relu"
    (other / "config.yaml").write_text(yaml.safe_dump(config))
    done = command("train", f"resume={tmp_path}")
    assert done.returncode == 2
    assert "policy.activation is tanh and relu" in done.stderr
    assert str(other) in done.stderr
    done = command("train", f"resume={first}:{second}", "meta.iterations=4")
    assert done.returncode == 0, done.stderr
    assert [len(read_metrics(f / "metrics.jsonl")) for f in (first, second, other)] == [4, 4, 3]


def test_checkpoints_ahead_of_where_runs_go_on_are_dropped(tmp_path: Path) -> None:
    params = {"w": np.zeros(3, np.float32)}
    key = jax.random.key_data(jax.random.key(0))
    runs = [Progressed(MetaState(params, ()), key, step, 0) for step in (10, 15, 20)]
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        checkpoints.save(runs[0])
        checkpoints.save(runs[2])
        with pytest.raises(OSError, match="a later iteration than 15"):
            checkpoints.save(runs[1])
        checkpoints.drop_after(10)
        checkpoints.save(runs[1])
        restored = checkpoints.restore(runs[0], print)
    assert restored is not None
    assert restored.iteration == 15


@pytest.mark.parametrize("algo", ["emaml", "promp", "gmps"])
def test_outer_losses_are_of_all_tasks_wherever_they_are(
    command: Command, start: tuple[str, ...], tmp_path: Path, algo: str
) -> None:
    """One looks at all tasks to weigh each, one takes several steps on a batch, one has
    demonstrations of its own."""
    folders = []
    own = [f"algo={algo}"]
    if algo == "gmps":
        own.append(f"outer_demos={write_demos(tmp_path / 'own.npz', num_train=4, num_test=0)}")
    for devices in (1, 4):
        runs = tmp_path / str(devices)
        done = command("train", *start, *own, f"devices={devices}", f"runs={runs}")
        assert done.returncode == 0, done.stderr
        outer = "-outer-own" * (algo == "gmps")
        folders.append(runs / "point2d" / f"{algo}-lines{outer}" / "seed0")
    assert_same_curve(*folders)


def test_one_run_that_diverges_leaves_the_others_a_way_on(
    command: Command, start: tuple[str, ...], tmp_path: Path
) -> None:
    varied = "vmap.adapt.learning_rate=[0.005,1e38]"
    done = command("train", *start, f"runs={tmp_path}", varied)
    assert done.returncode == 1, done.stderr
    parent = tmp_path / "point2d" / "emrld-lines"
    healthy, diverged = (parent / f"adapt.learning_rate={x}" / "seed0" for x in ("0.005", "1e+38"))
    assert f"{diverged} diverged" in done.stdout
    assert "infinite or NaN" in json.loads((diverged / "diverged.json").read_text())["error"]
    assert not (healthy / "diverged.json").exists()
    assert f"resume={healthy}\n" in done.stdout
    assert f"resume={diverged}" not in done.stdout
    done = command("train", f"resume={healthy}")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_devices_share_tasks_and_seeds(
    command: Command, start: tuple[str, ...], alone: Path, tmp_path: Path, num_seeds: int
) -> None:
    """Four devices: four parts of the tasks, or two of the seeds and two of the tasks."""
    done = command("train", *start, f"runs={tmp_path}", f"num_seeds={num_seeds}", "devices=4")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "point2d" / "emrld-lines" / "seed0"
    assert_same_curve(folder, alone)
    assert (folder.parent / "seed1").is_dir() == (num_seeds == 2)
    on_one = command("train", f"resume={folder}", "meta.iterations=4")
    assert on_one.returncode == 0, on_one.stderr
    assert len(read_metrics(folder / "metrics.jsonl")) == 4


def test_devices_that_do_not_divide_the_work(
    command: Command, start: tuple[str, ...], tmp_path: Path
) -> None:
    done = command("train", *start, f"runs={tmp_path}", "devices=3")
    assert done.returncode == 2
    assert "3 devices cannot share 1 run(s) of 4 tasks" in done.stderr
    assert "these numbers can: 1, 2, 4" in done.stderr
    assert not any(tmp_path.iterdir())


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


ON_FOUR = """
import json, sys
import jax
from emrld_jax.meta import batching
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.machines import split_cpu
split_cpu(1)  # the flag says how many
from emrld_jax.runs.iteration import Together, initial
from emrld_jax.runs.setup import set_up, with_config
from dataclasses import replace
first = set_up(train_config(sys.argv[1:]))
setups = [with_config(first, replace(first.config, seed=seed)) for seed in (0, 1)]
memory = []
for devices in (1, 2, 4):
    together = Together(setups[:1], jax.devices()[:devices])
    programs = together.compiled(together.begin([initial(first)]))
    memory.append([program.memory_analysis().temp_size_in_bytes for program in programs])
metrics = []
for on_cpu, devices in ((True, 1), (False, 1), (False, 4)):
    batching._on_cpu = lambda: on_cpu
    together = Together(setups, jax.devices()[:devices])
    metrics.append(together.iterate(together.begin([initial(s) for s in setups]))[1])
print(json.dumps([memory, metrics]))
"""


@pytest.fixture(scope="session")
def on_four(environment: dict[str, str], start: tuple[str, ...]) -> Any:
    """On 1, 2 and 4 devices: bytes of both programs; and metrics of two seeds by layout."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, "-c", ON_FOUR, *start]
    done = subprocess.run(
        command, env=environment | flags, capture_output=True, text=True, check=False, timeout=240
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_an_accelerators_layout_computes_the_same(on_four: Any) -> None:
    """Seeds and tasks in one batch, in place of one after the other; on one and on four devices."""
    expected, *others = on_four[1]
    for metrics in others:
        for own, theirs in zip(metrics, expected, strict=True):
            assert own.keys() == theirs.keys()
            np.testing.assert_allclose(own[NAMES[1]], theirs[NAMES[1]], rtol=1e-5)
            assert_same_step(own, theirs)
    assert expected[0]["outer/gradient_norm"] > 0


def test_a_device_needs_less_memory_where_there_are_more(on_four: Any) -> None:
    one, two, four = np.array(on_four[0])
    assert (two < 0.7 * one).all()
    assert (four < 0.7 * two).all()


@pytest.mark.parametrize("launcher", ["basic", "joblib", "submitit_local"])
def test_hydras_launchers_carry_out_a_sweep(
    command: Command, start: tuple[str, ...], tmp_path: Path, launcher: str
) -> None:
    known = {text.partition("=")[0]: text for text in (*start, "meta.iterations=1")}
    swept = ("seed=0,1", "w_bc=0.5", f"hydra/launcher={launcher}")
    done = command("sweep", *known.values(), *swept, f"runs={tmp_path}")
    assert done.returncode == 0, done.stderr
    parent = tmp_path / "point2d" / "emrld-lines"
    for seed in (0, 1):
        config = yaml.safe_load((parent / f"seed{seed}" / "config.yaml").read_text())
        assert (config["seed"], config["w_bc"]) == (seed, 0.5)
        assert (parent / f"seed{seed}" / "results.json").is_file()


@pytest.mark.parametrize("argument", ["vmap.w_rl=[0.1,0.2]", "processes=2", "resume=runs"])
def test_a_sweep_refuses_what_is_for_one_program(command: Command, argument: str) -> None:
    done = command("sweep", "seed=0,1", argument)
    assert done.returncode == 2
    assert "is for one program" in done.stderr


def test_a_sweep_is_checked_before_any_run_starts(command: Command, tmp_path: Path) -> None:
    done = command("sweep", "seed=0,1", "meta.max_kl=0.01,-1", f"runs={tmp_path}")
    assert done.returncode == 2
    assert "meta.max_kl=-1.0 is not allowed" in done.stderr
    assert not any(tmp_path.iterdir())
