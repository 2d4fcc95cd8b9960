"""Scores, curves and comparisons of made-up runs, against worked numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emrld_jax.analysis.comparisons import THRESHOLDS, compare
from emrld_jax.analysis.curves import axis, curve
from emrld_jax.analysis.groups import Group, group_runs
from emrld_jax.analysis.loading import load_runs
from emrld_jax.analysis.scores import adaptations, headline, references, score
from tests.analysis.conftest import MakeRun, table, write


def groups(folder: Path) -> list[Group]:
    return group_runs(load_runs([folder])).groups


def test_scores_and_the_headline(make_run: MakeRun, tmp_path: Path) -> None:
    for seed, value in enumerate((10.0, 20.0, 30.0, 100.0)):
        make_run(f"{seed}", seed=seed, value=value, seconds=seed + 1.0)
    (group,) = groups(tmp_path)
    assert [score(run, "train") for run in group.runs] == [10.0, 20.0, 30.0, 100.0]
    assert score(group.runs[0], "test", stage=0) == 0.0
    assert score(group.runs[0], "test", stage=2) is None
    (row,) = headline([group])
    cell = row.cells["train", "return", "after"]
    assert (float(cell.estimate.value), cell.seeds) == (25.0, 4)
    assert 10.0 <= cell.estimate.low < 25.0 < cell.estimate.high <= 100.0
    assert row.cells["test", "success", "after"].estimate.value == 0.5
    assert row.demonstrated == {"train": 100.0, "test": 80.0}
    assert (row.seconds, row.env_steps) == (10.0, 4000.0)  # 4 iterations of 2.5 s


def test_a_split_without_tasks_has_no_figures(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("a")
    write(path / "results.json", {"train": table(5.0, 1.0), "test": None})
    (row,) = headline(groups(tmp_path))
    assert {split for split, _, _ in row.cells} == {"train"}
    assert row.demonstrated == {"train": 1.0}


def test_curves_against_iterations(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("0", seed=0, value=40.0)
    make_run("1", seed=1, value=80.0)
    found = curve(groups(tmp_path)[0])
    np.testing.assert_array_equal(found.x, [1, 2, 3, 4])
    np.testing.assert_allclose(found.value, [15, 30, 45, 60])
    np.testing.assert_allclose(found.each, [[10, 20, 30, 40], [20, 40, 60, 80]])
    np.testing.assert_allclose((found.low, found.high), found.each)  # 1 of 4 resamples: 25 %
    assert found.seeds == (0, 1)
    before = curve(groups(tmp_path)[0], "success", "before", "env_steps")
    np.testing.assert_array_equal(before.x, [1000, 2000, 3000, 4000])
    np.testing.assert_array_equal(before.value, 0.0)


def test_curves_against_seconds_are_read_at_common_times(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("0", seed=0, value=40.0, seconds=1.0)  # 10 a second, from 1 s to 4 s
    make_run("1", seed=1, value=80.0, seconds=2.0)  # 10 a second, from 2 s to 8 s
    found = curve(groups(tmp_path)[0], against="seconds")
    assert (found.x[0], found.x[-1]) == (2.0, 4.0)
    np.testing.assert_allclose(found.each, [10 * found.x, 10 * found.x])


def test_a_long_curve_is_thinned(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("0")
    (group,) = groups(tmp_path)
    long = np.arange(1000.0)
    columns = {**group.runs[0].metrics, "iteration": long, "adapt/return_1": 3 * long}
    found = curve(group._replace(runs=(group.runs[0]._replace(metrics=columns),)))
    assert len(found.x) == 120
    assert (found.x[0], found.x[-1]) == (1.0, 1000.0)
    np.testing.assert_allclose(found.value, 3 * (found.x - 1))
    assert np.isnan(found.low).all()  # of one seed


def test_an_axis_must_be_known(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("0")
    with pytest.raises(ValueError, match="'hours' is not an axis; there are iterations"):
        axis(groups(tmp_path)[0].runs[0], "hours")


def test_returns_are_divided_by_the_best_demonstrations(make_run: MakeRun, tmp_path: Path) -> None:
    bad = make_run("bad", demos="suboptimal", value=60.0)
    write(bad / "results.json", {"train": table(60.0, 0.5), "test": None})
    assert references(groups(tmp_path), "train") == {"point2d": 0.5}
    make_run("good", value=90.0)
    found = groups(tmp_path)
    assert references(found, "train") == {"point2d": 100.0}
    assert references(found, "test") == {"point2d": 80.0}
    by_problem = {own.problems[0][1]: own for own in compare(found, "train", "return")[-2:]}
    assert by_problem["suboptimal"].competitors[0].score.value == 0.6
    assert by_problem["optimal"].competitors[0].score.value == 0.9


def test_dense_returns_stand_apart_beside_their_own_demonstrations(
    make_run: MakeRun, tmp_path: Path
) -> None:
    dense: dict[str, Any] = {"env__reward": "dense", "value": -60.0}
    own = table(-60.0, -19.0)
    own["demonstrations"]["reward"] = "dense"
    write(make_run("new", **dense) / "results.json", {"train": own, "test": None})
    make_run("old", algo="maml", **dense)  # of a version that told the sparse return, 100
    make_run("sparse", value=70.0)
    found = {row.group.problem: row for row in headline(groups(tmp_path))}
    name = "point2d (dense reward)"
    assert found[name, "optimal"].demonstrated == {"train": -19.0}
    assert found[name, "none"].demonstrated == {}
    assert found["point2d", "optimal"].demonstrated == {"train": 100.0, "test": 80.0}
    assert references(groups(tmp_path), "train") == {"point2d": 100.0}  # none below 0
    problems = [own.problems for own in compare(groups(tmp_path), "train", "return")]
    assert problems == [(("point2d", "optimal"),)]


def test_algorithms_are_compared_over_what_they_share(make_run: MakeRun, tmp_path: Path) -> None:
    for environment in ("point2d", "two_wheeled"):
        for seed in range(3):
            for algo, value in (("emrld", 90.5), ("maml", 10.0)):
                name = f"{environment}/{algo}/{seed}"
                given = {"environment": environment, "algo": algo, "seed": seed}
                make_run(name, value=value + seed, **given)
    make_run("alone", algo="emrld_ws", value=50.0)  # on one of the two environments
    over, *single = compare(groups(tmp_path), "train", "return")
    assert over.problems == (("point2d", "optimal"), ("two_wheeled", "optimal"))
    assert {own.label: own.seeds for own in over.competitors} == {"emrld": (3, 3), "maml": (3, 3)}
    emrld = over.competitors[0]
    assert emrld.score.value == pytest.approx(
        0.915
    )  # 90.5 (2), 91.5 (2), 92.5 (2) without the ends
    above = emrld.profile.value[[0, int(np.searchsorted(THRESHOLDS, 0.92))]]
    np.testing.assert_allclose(above, [1.0, 1 / 3], atol=1e-9)
    (improvement,) = over.improvements
    assert (improvement.first, improvement.second) == ("emrld", "maml")
    assert tuple(map(float, improvement.probability)) == (1.0, 1.0, 1.0)
    assert [own.problems for own in single] == [(problem,) for problem in over.problems]
    assert len(single[0].competitors) == 3
    assert len(single[0].improvements) == 3


def test_adaptation_steps_of_evaluations(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in (0, 1):
        path = make_run(f"{seed}", seed=seed)
    stages = [{"adaptation_steps": k, "return": 10.0 * k, "success": 0.1} for k in range(4)]
    (path / "evaluations/steps3").mkdir(parents=True)
    entry = {"stages": stages, "iteration": 4, "configuration": {"tasks": "test"}}
    write(path / "evaluations/steps3/evaluation.json", entry)
    train, test, more = adaptations(groups(tmp_path)[0])
    assert (train.split, test.split, more.split) == ("train", "test", "test")
    assert (test.source, more.source) == ("final table", "steps3")
    assert [cell.estimate.value for cell in test.cells["return"]] == [0.0, 40.0]
    assert [cell.seeds for cell in test.cells["return"]] == [2, 2]
    assert more.steps == [0, 1, 2, 3]
    assert [cell.estimate.value for cell in more.cells["return"]] == [0.0, 10.0, 20.0, 30.0]
    assert more.cells["return"][0].seeds == 1
