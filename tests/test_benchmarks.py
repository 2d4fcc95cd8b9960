"""The benchmarks' arithmetic: counted operations, summaries of runs, ratios."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from benchmarks import ablation, communication, compare, dense, growth, precision, targets
from benchmarks.flops import matrix_flops
from benchmarks.jobs import job
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.setup import set_up
from emrld_jax.study.programs import Program


def test_products_are_counted_wherever_they_are() -> None:
    """[3, 4] @ [4, 5] is 120 operations; a scan does it 7 times, a loop as often as we say."""
    a, b = jnp.ones((3, 4)), jnp.ones((4, 5))
    assert matrix_flops(jnp.matmul, a, b) == 120
    batched = jax.vmap(jnp.matmul, in_axes=(0, None))
    assert matrix_flops(jax.jit(batched), jnp.ones((6, 3, 4)), b) == 6 * 120
    square = jnp.ones((4, 4))  # 128 operations

    def scanned(x: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda y, _: (y @ square, None), x, length=7)[0]

    def looped(x: jax.Array) -> jax.Array:
        return jax.lax.while_loop(lambda y: jnp.sum(y) < 9, lambda y: y @ square, x)

    assert matrix_flops(scanned, square) == 7 * 128
    assert matrix_flops(looped, square, trips=(3,)) == 3 * 128
    with pytest.raises(ValueError, match="1 trip counts too many"):
        matrix_flops(jnp.matmul, a, b, trips=(3,))


def finished_run(runs: Path, seed: int, returns: list[float]) -> Program:
    """A run as `summarize` reads it: two tasks, of which one has this return after adaptation."""
    own = job(runs, "two_wheeled_drift", "optimal", "emrld", seed)
    folder = own.folders[0].path
    folder.mkdir(parents=True)
    after = {"return": np.mean(returns), "success": 0.75, "success_per_task": [1.0, 0.5]}
    split = {"stages": [{}, after], "demonstrations": {"return": 80.0}}
    (folder / "results.json").write_text(json.dumps({"train": split, "test": split}))
    records = [
        {"iteration": i, "adapt/return_0": 0.0, "adapt/return_1": float(i), "time/iteration_s": 2.0}
        for i in range(100)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in records))
    return own


def test_a_row_of_the_table_of_targets(tmp_path: Path) -> None:
    jobs = [finished_run(tmp_path, seed, [10.0 * seed, 20.0]) for seed in (1, 2)]
    row = targets.summarize(jobs)
    assert row["return"] == row["held_out_return"] == [15.0, 20.0]
    assert row["tasks_solved"] == [0.5, 0.5]  # the second task succeeds in half of its episodes
    assert row["robot_experiment_success"] == [0.5, 0.5]
    assert (row["iterations"], row["training_s"]) == (100, 200.0)
    text = targets.table([row])
    assert "| 17.5 (15.0 to 20.0) | 75% | 50% |" in text
    assert text.endswith("-0.65 rad a step: emrld 50% (optimal).")


def test_a_row_of_the_ablation(tmp_path: Path) -> None:
    row = ablation.summarize("defaults", [finished_run(tmp_path, 0, [30.0])])
    assert row["return_at"][20] == [17.0]  # the mean of 15, .. 19
    assert (row["final"], row["s_per_iteration"]) == ([30.0], 2.0)


def test_a_comparison_shows_ratios_of_what_both_have() -> None:
    a = {"rows": [{"what": "x", "unit": "ms", "values": [2.0, 4.0, 3.0]}]}
    b = {"rows": [{"what": "x", "unit": "ms", "values": [6.0]}, {"what": "y", "values": [1]}]}
    assert compare.table(a, b).splitlines()[2:] == ["| x | 3 | 6 | 2.00 | ms |"]


PROGRAM = """
HloModule told

%sum (a: f32[], b: f32[]) -> f32[] {
  ROOT %s = f32[] add(%a, %b)
}

%product (c: (s32[], f32[10])) -> (s32[], f32[10]) {
  %v = f32[10]{0} all-reduce(%x), replica_groups={{0,1}}, to_apply=%sum
}

%learner (c: (s32[], f32[10])) -> (s32[], f32[10]) {
  %w = (s32[], f32[10]) while(%i), condition=%goes_on, body=%product
  %own = f32[100]{0} all-reduce(%x), replica_groups={{0},{1}}, to_apply=%sum
}

ENTRY %main (p: f32[10]) -> f32[3,20] {
  %l = (s32[], f32[10]) while(%t), condition=%c, body=%learner, {"known_trip_count":{"n":"4"}}
  %pair = (f32[], f32[7]{0}) all-reduce(%x, %y), replica_groups=[1,2]<=[2], to_apply=%sum
  ROOT %g = f32[3,20]{1,0} all-gather(%z), replica_groups={{0,1}}, dimensions={0}
}
"""


def test_what_a_program_tells_is_counted_with_its_loops() -> None:
    """4 learners of 3 products each; a group of one device is nobody to tell."""
    told = communication.count(PROGRAM, lambda inside: 3)
    assert told == {
        ("all-reduce", 40): 4 * 3,
        ("all-reduce", 4 + 28): 1,
        ("all-gather", 240): 1,
    }


def test_a_fitted_slope_is_the_exponent() -> None:
    rows = [{"value": x, "seconds": [0.5 * x**1.5] * 2} for x in (2, 4, 8, 16)]
    np.testing.assert_allclose(growth.fit(rows), (1.5, 0.5))


def test_aim_is_parted_into_bias_and_spread() -> None:
    """Two tasks: one always 3 and 4 m off; one 1 m off to this side and to the other."""
    rest = np.array([[[3.0, 4.0], [3.0, 4.0]], [[1.0, 0.0], [-1.0, 0.0]]])

    found = dense.Aim(rest)

    assert found.bias == pytest.approx((25 / 2) ** 0.5)
    assert found.spread == pytest.approx(0.5**0.5)


def test_a_controller_without_noise_returns_the_sum_of_its_distances() -> None:
    """20 steps of 0.1 m; beside the goal the episode goes on, at that distance."""
    env = envs_jax.make("point2d", reward="dense")
    goals = np.asarray(env.train_tasks().goal)
    exact, short = np.zeros((12, 1, 2)), -0.1 * (goals / 2)[:, None]

    assert dense.controlled_return(env, 1e-9, exact) == pytest.approx(-19.0, abs=1e-2)
    assert dense.controlled_return(env, 1e-9, short) == pytest.approx(-19.0 - 81 * 0.1, abs=1e-2)


def test_on_a_cpu_products_are_in_float32_whatever_is_asked_for() -> None:
    small = ["policy.hidden_sizes=[8]", "adapt.num_episodes=2", "env.horizon=10"]
    setup = set_up(train_config(["env=point2d", "env.reward=dense", *small]))
    rows = {row.what: row.values for row in precision.compare(setup, 2)}
    for what in ("the outer loss's gradient", "a Fisher-vector product of it"):
        exact, default = (rows[f"{name}: error of {what}"] for name in ("float32", "default"))
        assert exact == default
        assert 0 < exact[0] < 1e-4
