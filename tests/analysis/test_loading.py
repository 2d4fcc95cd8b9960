"""Only whole runs are read; groups hold runs that differ in their seed alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emrld_jax.analysis.groups import COMMIT, Grouped, differing_settings, group_runs
from emrld_jax.analysis.loading import load_runs
from emrld_jax.runs.config import ConfigError
from tests.analysis.conftest import ITERATIONS, MakeRun, table, write


def grouped(*folders: Path) -> Grouped:
    return group_runs(load_runs(folders))


def test_a_run_is_read(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("here/deep/below/many/folders/seed3", seed=3, algo="emrld_ws", value=70.0)
    (run,) = load_runs([tmp_path]).runs
    assert (run.path, run.seed, run.algorithm, run.environment) == (
        path,
        3,
        "emrld_ws",
        "point2d",
    )
    assert run.demonstrations == "optimal"
    assert run.commits == ("a" * 10,)
    assert run.seconds == 8.0
    np.testing.assert_array_equal(run.metrics["adapt/return_1"], [17.5, 35.0, 52.5, 70.0])
    assert [stage["return"] for stage in run.stages("test")] == [0.0, 60.0]


def test_a_run_is_read_once_however_it_is_named(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("a/seed0")
    assert len(load_runs([tmp_path, path, tmp_path / "a"]).runs) == 1


def cut_metrics(path: Path) -> None:
    text = (path / "metrics.jsonl").read_text()
    (path / "metrics.jsonl").write_text(text[:-20])


def spoil(name: str, text: str) -> Callable[[Path], None]:
    def harm(path: Path) -> None:
        (path / name).write_text(text)

    return harm


def recorded(**given: Any) -> Callable[[Path], None]:
    """Puts other values into the record of how the run began."""

    def harm(path: Path) -> None:
        file = path / "provenance.json"
        write(file, {**json.loads(file.read_text()), **given})

    return harm


def without_last_success(path: Path) -> None:
    file = path / "metrics.jsonl"
    file.write_text(file.read_text().replace('"adapt/success_1"', '"adapt/other"', 1))


def no_return(path: Path) -> None:
    broken = table(1.0, 1.0)
    broken["stages"][1]["return"] = float("nan")
    write(path / "results.json", {"train": broken, "test": None})


def bad_demonstrations(path: Path) -> None:
    write(path / "results.json", {"train": {**table(1.0, 1.0), "demonstrations": 3}, "test": None})


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda p: (p / "results.json").unlink(), "interrupted or still training"),
        (cut_metrics, "half-written: metrics.jsonl tells of 3 of 4"),
        (lambda p: (p / "metrics.jsonl").unlink(), "tells of 0 of 4"),
        (spoil("metrics.jsonl", '{"iteration": 1}\n'), "one iteration after the other"),
        (spoil("metrics.jsonl", "no JSON\n"), "line 1 is not JSON"),
        (spoil("results.json", '{"train"'), "results.json cannot be read"),
        (spoil("results.json", "{}"), "neither train nor test"),
        (bad_demonstrations, "results.json lacks the demonstrations' return"),
        (no_return, "lacks a finite return"),
        (spoil("config.yaml", "a: [1"), "config.yaml cannot be read"),
        (spoil("config.yaml", "model: gpt\n"), "not a run folder of emrld_jax.train"),
        (lambda p: (p / "config.yaml").unlink(), "it has no config.yaml"),
        (lambda p: (p / "provenance.json").unlink(), "provenance.json cannot be read"),
        (spoil("provenance.json", "{}"), "provenance.json must have"),
        (recorded(machine="laptop"), "machine='laptop' is not a table of names and values"),
        (recorded(machine=None), "machine=None is not a table"),
        (recorded(packages=["jax"]), "must have code, packages, demos, resumed"),
        (recorded(resumed=[3]), "lacks the code's commit"),
        (without_last_success, "adapt/success_1 is missing in some lines"),
    ],
)
def test_what_is_not_whole_is_named_with_its_reason(
    make_run: MakeRun, tmp_path: Path, harm: Callable[[Path], None], reason: str
) -> None:
    make_run("good", seed=1)
    bad = make_run("bad")
    harm(bad)
    found = load_runs([tmp_path])
    assert [run.seed for run in found.runs] == [1]
    ((path, said),) = found.skipped
    assert path == bad
    assert reason in said


def test_a_record_without_a_machine_is_read(make_run: MakeRun, tmp_path: Path) -> None:
    """It is only shown."""
    file = make_run("a") / "provenance.json"
    record = json.loads(file.read_text())
    del record["machine"]
    write(file, record)
    assert len(load_runs([tmp_path]).runs) == 1


def test_how_far_an_interrupted_run_came(make_run: MakeRun, tmp_path: Path) -> None:
    bad = make_run("bad")
    (bad / "results.json").unlink()
    cut_metrics(bad)
    assert "3 of 4 meta-iterations" in load_runs([tmp_path]).skipped[0].reason


def test_a_folder_without_runs_is_named(tmp_path: Path) -> None:
    assert load_runs([tmp_path]).skipped == [(tmp_path, "no run folder is in it")]
    with pytest.raises(ConfigError, match="no such folder"):
        load_runs([tmp_path / "nothing"])


def test_runs_of_versions_with_other_settings_are_read(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("old")
    lines = (path / "config.yaml").read_text().replace("w_bc: 1.0\n", "weight: 2\n")
    (path / "config.yaml").write_text(lines)
    make_run("new", seed=1)
    old, new = grouped(tmp_path).groups
    assert {old.label, new.label} == {
        "emrld, w_bc=(not a setting then), weight=2",
        "emrld, w_bc=1, weight=(not a setting then)",
    }


def test_seeds_make_a_group_and_settings_part_it(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in (10, 2, 1):
        make_run(f"a/{seed}", seed=seed, w_rl=0.2, runs=f"somewhere{seed}")
    make_run("b/1", seed=1, w_rl=0.4)
    make_run("c/1", seed=1, w_rl=0.4, algo="emrld_ws")
    make_run("d/1", seed=1, w_rl=0.2, environment="two_wheeled")
    found = grouped(tmp_path)
    assert [(group.environment, group.label, group.seeds) for group in found.groups] == [
        ("point2d", "emrld, w_rl=0.2", (1, 2, 10)),
        ("point2d", "emrld, w_rl=0.4", (1,)),
        ("point2d", "emrld_ws", (1,)),
        ("two_wheeled", "emrld", (1,)),
    ]
    assert not found.skipped
    assert set(differing_settings([group.runs[0] for group in found.groups])) == {
        "algo",
        "w_rl",
        "env.name",
    }


def test_other_demonstrations_are_not_mixed(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("a", seed=0)
    path = make_run("b", seed=1)
    record = json.loads((path / "provenance.json").read_text())
    record["demos"]["sha256"] = "e" * 64
    write(path / "provenance.json", record)
    assert [group.label for group in grouped(tmp_path).groups] == [
        "emrld, demos=eeeeeeeeee",
        "emrld, demos=ffffffffff",
    ]


def test_demonstrations_of_the_outer_loss_part_lines(make_run: MakeRun, tmp_path: Path) -> None:
    """Those that have none, and those of before, which had no such setting, are together."""
    own = {"algo": "gmps", "demos": "suboptimal"}
    make_run("a", seed=0, **own)
    before = make_run("b", seed=1, **own) / "config.yaml"
    before.write_text(before.read_text().replace("outer_demos: null\n", ""))
    for seed, content in ((2, "a"), (3, "a"), (4, "b")):
        path = make_run(f"{seed}", seed=seed, outer_demos=f"/somewhere/{seed}/lines.npz", **own)
        record = json.loads((path / "provenance.json").read_text())
        record["outer_demos"] = {"path": "lines.npz", "sha256": content * 64}
        write(path / "provenance.json", record)
    found = {group.label: group.seeds for group in grouped(tmp_path).groups}
    assert found == {
        "gmps, outer_demos=as demos": (0, 1),
        "gmps, outer_demos=lines aaaaaaaaaa": (2, 3),
        "gmps, outer_demos=lines bbbbbbbbbb": (4,),
    }


def test_commits_together_are_told(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("a", seed=0)
    make_run("b", seed=1, commit="b" * 40)
    found = grouped(tmp_path)
    (group,) = found.groups
    assert group.commits == ("a" * 10, "b" * 10)
    assert "point2d, optimal, emrld: runs of different commits together (aaaaaaaaaa, " in str(
        found.notes
    )


def test_the_same_seed_of_two_commits_is_compared(make_run: MakeRun, tmp_path: Path) -> None:
    for commit in "ab":
        for seed in (0, 1):
            make_run(f"{commit}{seed}", seed=seed, commit=commit * 40)
    found = grouped(tmp_path)
    assert [(group.seeds, group.differing) for group in found.groups] == [
        ((0, 1), {COMMIT: "a" * 10}),
        ((0, 1), {COMMIT: "b" * 10}),
    ]
    assert "lines are of different commits" in str(found.notes)


def test_a_repeat_is_no_further_sample(make_run: MakeRun, tmp_path: Path) -> None:
    first = make_run("seed0", value=1.0)
    second = make_run("seed0_2", value=2.0, time="2026-01-02T00:00:00+00:00")
    found = grouped(tmp_path)
    assert [run.path for run in found.groups[0].runs] == [second]
    ((path, reason),) = found.skipped
    assert path == first
    assert "repeat of seed 0" in reason
    assert str(second) in reason


def evaluation(path: Path, name: str, **given: Any) -> Path:
    """Writes an evaluation of the finished policy into a run; what is given replaces its values."""
    folder = path / "evaluations" / name
    folder.mkdir(parents=True)
    stages, configuration = table(5.0, 1.0)["stages"], {"tasks": "test"}
    entry = {"stages": stages, "iteration": ITERATIONS, "configuration": configuration}
    write(folder / "evaluation.json", {**entry, **given})
    return folder


def test_evaluations_of_the_finished_policy_are_read(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("a")
    evaluation(path, "whole")
    evaluation(path, "early", iteration=ITERATIONS - 1)
    found = load_runs([tmp_path])
    assert [list(run.evaluations) for run in found.runs] == [["whole"]]
    assert not found.skipped  # an early one is of another policy, and not damaged


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda p: (p / "evaluation.json").write_text("{"), "evaluation.json cannot be read"),
        (lambda p: write(p / "evaluation.json", []), "evaluation.json is not a table"),
        (lambda p: write(p / "evaluation.json", {"stages": [1]}), "lacks a finite return"),
        ({"iteration": "4"}, "does not say after how many iterations"),
        ({"configuration": ["test"]}, "configuration.tasks is neither train nor test"),
        ({"configuration": {"tasks": "both"}}, "configuration.tasks is neither train nor test"),
    ],
)
def test_a_damaged_evaluation_is_named_and_its_run_stays(
    make_run: MakeRun,
    tmp_path: Path,
    harm: Callable[[Path], object] | dict[str, Any],
    reason: str,
) -> None:
    path = make_run("a")
    evaluation(path, "whole")
    bad = evaluation(path, "bad", **(harm if isinstance(harm, dict) else {}))
    if not isinstance(harm, dict):
        harm(bad)
    found = grouped(tmp_path)
    assert [list(run.evaluations) for run in found.groups[0].runs] == [["whole"]]
    ((where, said),) = found.skipped
    assert where == bad
    assert reason in said
