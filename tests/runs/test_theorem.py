"""`diagnostics=true`: what it writes, and that training does not notice it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from emrld_jax.runs.bound_picture import theory
from emrld_jax.runs.checkpoints import Checkpoints
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.iteration import initial
from emrld_jax.runs.metrics import read_metrics
from emrld_jax.runs.saved import load_config
from emrld_jax.runs.setup import Setup, set_up, with_config
from emrld_jax.runs.theorem import Diagnosis, diagnosis
from emrld_jax.runs.variants import differences, variants
from emrld_jax.theory.bound import Terms
from tests.conftest import Command
from tests.runs.conftest import TINY

LOGGED = {
    *(f"theory/{name}" for name in Terms._fields),
    *("theory/bound", "theory/delta_mean"),
    *("theory/improvement", "theory/improvement_se"),
    *("theory/improvement_undiscounted", "theory/improvement_undiscounted_se"),
}


def test_training_does_not_notice_that_it_is_measured(
    command: Command, demos: Path, whole_run: tuple[Path, str], tmp_path: Path
) -> None:
    """The metrics and the last parameters are the same, bit for bit; terms and a picture join."""
    arguments = ("env=point2d", f"demos={demos}", f"runs={tmp_path}", "diagnostics=true", *TINY)
    done = command("train", *arguments)
    assert done.returncode == 0, done.stderr
    plain, run = whole_run[0], tmp_path / "point2d" / "emrld-lines" / "seed0"
    for own, more in zip(*(read_metrics(f / "metrics.jsonl") for f in (plain, run)), strict=True):
        assert set(more) - set(own) == LOGGED
        assert all(own[name] == more[name] for name in set(own) - {"time/iteration_s"})
        terms = Terms(*(more[f"theory/{name}"] for name in Terms._fields))
        np.testing.assert_allclose(more["theory/bound"], terms.bound, rtol=1e-4)
        assert more["theory/improvement"] >= more["theory/bound"]
        assert 0 <= more["theory/tv_old"] < more["theory/tv_demonstrator"] <= 1
    jax.tree.map(np.testing.assert_array_equal, last_state(plain), last_state(run))
    assert (run / "theory.png").stat().st_size > 10_000
    assert (run / "theory.svg").is_file()
    assert not (plain / "theory.png").exists()


def last_state(run: Path) -> Any:
    setup = set_up(load_config(run / "config.yaml"))
    with Checkpoints(run / "checkpoints", read_only=True) as checkpoints:
        restored = checkpoints.restore(initial(setup), print)
    assert restored is not None
    return restored.state


@pytest.fixture(scope="module")
def pair(demos: Path) -> list[Setup]:
    """Two runs of one program."""
    first = set_up(train_config(["env=point2d", f"demos={demos}", "vmap.w_rl=[0.2,5.0]", *TINY]))
    return [with_config(first, variant.config) for variant in variants(first.config)]


@pytest.fixture(scope="module")
def second_alone(pair: list[Setup]) -> Diagnosis:
    return diagnosis(pair[1:], {}, jax.devices()[:1])


def first_parameters(setup: Setup, seeds: Sequence[int]) -> Any:
    states = [setup.learner.init(jax.random.key(seed)) for seed in seeds]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(state.params for state in states))


def test_runs_side_by_side_are_measured_as_each_alone(
    pair: list[Setup], second_alone: Diagnosis
) -> None:
    """They differ in their keys, their parameters and a number of the algorithm."""
    values = differences([setup.config for setup in pair])
    assert list(values) == ["w_rl"]
    together = diagnosis(pair, values, jax.devices()[:1])
    old, new = (first_parameters(pair[0], seeds) for seeds in ((0, 1), (2, 3)))
    keys = np.stack([jax.random.key_data(jax.random.key(seed)) for seed in (0, 1)])
    first, second = together(old, new, keys, 5)
    own_old, own_new = (jax.tree.map(lambda leaf: leaf[1:], tree) for tree in (old, new))
    (alone,) = second_alone(own_old, own_new, keys[1:], 5)
    assert set(alone) == set(second) == LOGGED
    for name, value in alone.items():
        np.testing.assert_allclose(second[name], value, rtol=1e-3, atol=1e-3, err_msg=name)
    assert abs(first["theory/surrogate"] / second["theory/surrogate"] - 1) > 0.01


def test_what_is_not_finite_is_left_out(pair: list[Setup], second_alone: Diagnosis) -> None:
    """Parameters beyond all bounds: nothing is raised, and what is left can be written as JSON."""
    old = first_parameters(pair[1], [0])
    new = jax.tree.map(lambda leaf: leaf + np.float32(1e30), old)
    key = np.asarray(jax.random.key_data(jax.random.key(0)))[None]
    (found,) = second_alone(old, new, key, 0)
    assert "theory/surrogate" not in found
    assert "theory/steps_old" in found
    json.dumps(found, allow_nan=False)


def test_several_devices_are_refused(demos: Path) -> None:
    setup = set_up(train_config(["env=point2d", f"demos={demos}", "diagnostics=true", *TINY]))
    devices: list[Any] = [object(), object()]
    with pytest.raises(ConfigError, match="diagnostics=true is for one device, and these are 2"):
        diagnosis([setup], {}, devices)


def test_a_picture_does_without_a_number(tmp_path: Path) -> None:
    record = {"iteration": 0, **dict.fromkeys(LOGGED, 1.0)}
    lacking = {k: v for k, v in record.items() if k not in ("theory/surrogate", "theory/bound")}
    records = [record, {**lacking, "iteration": 1}, {**record, "iteration": 2}]
    theory(records, "three iterations", tmp_path / "theory")
    assert (tmp_path / "theory.png").is_file()
