"""What stands beside a run's returns as that of its demonstrations."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import pytest

from emrld_jax.demos import DemoSet
from emrld_jax.runs.demonstrated import demonstrated
from envs_jax import make
from envs_jax.point2d import Point2D
from tests.runs.straight import straight_lines


@pytest.fixture(scope="module")
def lines() -> DemoSet:
    """20 steps of 0.1 m straight to goals 2 m away, of which the file claims something else."""
    env = Point2D()
    return straight_lines(env, env.train_tasks().goal[:3])._replace(
        returns=jnp.array([1.0, 2.0, 6.0]), success=jnp.array([True, False, True])
    )


def test_sparse_return_is_what_the_file_says(lines: DemoSet) -> None:
    found = demonstrated(make("point2d"), lines)
    assert found == {"return": 3.0, "success": pytest.approx(2 / 3), "reward": "sparse"}


@pytest.mark.parametrize(
    ("settings", "value", "success"),
    [
        ({"reward": "dense"}, -19.0, 1.0),  # 1.9 + 1.8 + .. + 0.1 m
        ({"reward": "dense", "horizon": 10}, -14.5, 0.0),  # 1.9 + .. + 1.0 m
        # inside: 0.5, 0.6, 0.7, 0.8, 0.9; then the 100 - 20 steps that remain
        ({"reward_radius": 0.55}, 3.5 + 80.0, 1.0),
        ({"reward_radius": 0.25, "horizon": 50}, 0.8 + 0.9 + 30.0, 1.0),
    ],
)
def test_in_another_environment_it_is_what_the_actions_earn(
    lines: DemoSet, settings: dict, value: float, success: float
) -> None:
    found = demonstrated(make("point2d", **settings), lines)
    assert found["return"] == pytest.approx(value, abs=1e-3)
    assert found["success"] == success
    assert found["reward"] == settings.get("reward", "sparse")


def test_physics_that_are_computed_otherwise_pay_the_same(lines: DemoSet) -> None:
    pytest.importorskip("mujoco")
    env = make("half_cheetah", mjx_iterations=2)
    assert demonstrated(env, lines)["return"] == 3.0  # nothing is played back


def test_a_runs_results_tell_it(whole_run: tuple[Path, str]) -> None:
    """Its reward is dense: what the file says, 81.7, would be beside numbers below 0."""
    results = json.loads((whole_run[0] / "results.json").read_text())
    for split in ("train", "test"):
        shown = results[split]["demonstrations"]
        assert shown["return"] == pytest.approx(-19.0, abs=1e-3)
        assert shown["reward"] == "dense"
    assert "-19.0" in whole_run[1]
