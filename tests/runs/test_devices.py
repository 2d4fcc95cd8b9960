"""Tasks and seeds that several devices share."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emrld_jax.runs.metrics import read_metrics
from tests.conftest import Command
from tests.runs.conftest import SHORT
from tests.runs.curves import NAMES, assert_same_curve, assert_same_step
from tests.runs.straight import write_demos


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


@pytest.mark.parametrize("algo", ["emaml", "gmps"])
def test_outer_losses_are_of_all_tasks_wherever_they_are(
    command: Command, start: tuple[str, ...], tmp_path: Path, algo: str
) -> None:
    """One looks at all tasks to weigh each, one follows a gradient on demonstrations of its own."""
    folders = []
    own = [*start, f"algo={algo}"]
    if algo == "gmps":
        own.remove(SHORT)  # it has no TRPO
        own.append(f"outer_demos={write_demos(tmp_path / 'own.npz', num_train=4, num_test=0)}")
    for devices in (1, 4):
        runs = tmp_path / str(devices)
        done = command("train", *own, f"devices={devices}", f"runs={runs}")
        assert done.returncode == 0, done.stderr
        outer = "-outer-own" * (algo == "gmps")
        folders.append(runs / "point2d" / f"{algo}-lines{outer}" / "seed0")
    alone, shared = folders
    assert_same_curve(shared, alone)


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
    flags = {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count=4 {environment.get('XLA_FLAGS', '')}"
    }
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
