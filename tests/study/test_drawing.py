"""What commands leave in one folder, one after another, of runs that are made up."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from emrld_jax import reproduce, settings
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.saved import save_config
from emrld_jax.runs.setup import set_up
from emrld_jax.runs.variants import variants
from emrld_jax.study import figures
from emrld_jax.study.plan import ReproduceConfig, programs, studies
from emrld_jax.study.programs import Program
from tests.analysis.conftest import write, write_run

HERE = ("envs=[point2d]", "qualities=[optimal]")


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Draws what is finished, once the runs of its own are; returns the exit code."""
    monkeypatch.setattr(figures, "save", lambda _, path: path.with_suffix(".svg").write_text("a"))

    def run(*arguments: str, finish: bool = True) -> int:
        steps = () if any("steps=" in text for text in arguments) else ("steps=0",)
        given = ("fast=true", *HERE, *steps, f"out={tmp_path}", "draw=true", *arguments)
        config = cli.updated(ReproduceConfig(), cli.parse(given, ReproduceConfig(), {}))
        for program in programs(studies(config)) if finish else ():
            pretend(program)
        monkeypatch.setattr("sys.argv", ["reproduce", *given])
        return reproduce.main()

    return run


def pretend(program: Program, value: float = 50.0) -> None:
    """Makes up those of a program's runs that are not there."""
    setup = set_up(cli.train_config(program.arguments(program.seeds[0], len(program.seeds))))
    for own in (variant.config for variant in variants(setup.config)):
        point = tuple(settings.value(own, name) for name, _ in program.grid)
        folder = program.folder(own.seed, point)
        if not folder.finished:
            write_run(folder.path, seed=own.seed, value=value)
            lines = folder.metrics.read_text().splitlines(keepends=True)
            folder.metrics.write_text("".join(lines[: own.meta.iterations]))
            save_config(own, folder.config)


def rows(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


def read(folder: Path) -> Any:
    return json.loads((folder / "study.json").read_text())


def test_a_smaller_study_keeps_what_a_larger_one_has_left(study: Any, tmp_path: Path) -> None:
    assert study("figure=curves", "algos=[emrld,emrld_ws]", "seeds=2") == 0
    assert not (tmp_path / "weights.csv").exists()  # no weight but the curves' own is there
    curves = (tmp_path / "curves_iterations.svg").stat().st_mtime_ns

    assert study("figure=ablation") == 0
    assert study("figure=sensitivity") == 0
    found = {(row["algorithm"], row["seeds"]) for row in rows(tmp_path / "results.csv")}
    assert found == {("emrld", "2"), ("emrld_ws", "2")}
    seeds = [(row["algorithm"], row["seed"]) for row in rows(tmp_path / "seeds.csv")]
    assert seeds == [("emrld", "0"), ("emrld", "1"), ("emrld_ws", "0"), ("emrld_ws", "1")]
    assert (tmp_path / "curves_iterations.svg").stat().st_mtime_ns == curves
    for name in ("profiles.svg", "ablation.svg", "sensitivity.svg", "report.html"):
        assert (tmp_path / name).is_file()
    weights = {row["algorithm"] for row in rows(tmp_path / "weights.csv")}
    assert {"emrld, w_rl=0.2, w_bc=0", "emrld, w_rl=0, w_bc=1"} <= weights  # the ablation's
    assert {"emrld, w_rl=0.4, w_bc=1", "emrld_ws, w_rl=1, w_bc=0.8"} <= weights
    assert {row["algorithm"] for row in rows(tmp_path / "weights_seeds.csv")} == weights

    # the curves of one algorithm take in the other one
    assert study("figure=curves", "algos=[emrld]", "seeds=1") == 0
    assert (tmp_path / "curves_iterations.svg").stat().st_mtime_ns > curves
    assert {row["algorithm"] for row in rows(tmp_path / "results.csv")} == {"emrld", "emrld_ws"}
    left = read(tmp_path)
    drawn = [each["figure"] for each in left["commands"]]
    assert drawn == ["curves", "ablation", "sensitivity", "curves"]
    assert left["runs"] == 2 * 2 + 2 + 2 * 8


def test_study_json_keeps_commands_and_tells_of_the_runs_own_machines(
    study: Any, tmp_path: Path
) -> None:
    write(tmp_path / "study.json", {"command": "python -m before", "seeds": 5})  # of an old version
    arguments = ("figure=curves", "algos=[emrld]", "seeds=3")
    assert study(*arguments) == 0
    for seed, cpu in enumerate(("one", "another", "one")):
        file = tmp_path / f"runs/main/point2d/emrld-optimal/seed{seed}/provenance.json"
        record = json.loads(file.read_text())
        record["machine"] = {"cpu": cpu}
        file.write_text(json.dumps(record))
    assert study(*arguments) == 0
    left = read(tmp_path)
    first, second = left["commands"]  # a command that is given again is listed once
    assert first["command"] == "python -m before"
    assert "seeds=3" in second["command"]
    assert left["machines"] == [{"cpu": "one"}, {"cpu": "another"}]
    assert left["commits"] == ["a" * 10]
    assert left["hours_of"] == "0 of 1 programs"  # made up, so nobody has noted what they took
    assert left["drawn"]["machine"]["cores"] > 0
    ledger = {"program": "point2d, emrld, optimal demonstrations, fast", "wall_s": 36, "cpu_s": 18}
    (tmp_path / "runs/compute.jsonl").write_text(json.dumps(ledger) + "\n")
    assert study(*arguments) == 0
    assert read(tmp_path)["hours_of"] == "1 of 1 programs"
    assert read(tmp_path)["cpu_hours"] == pytest.approx(0.005)
    (tmp_path / "study.json").write_text("{")  # nothing may fail of it
    assert study(*arguments) == 0
    assert len(read(tmp_path)["commands"]) == 1


def test_runs_of_other_settings_are_not_shown_beside_these(
    study: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    long = Program(tmp_path / "runs/main", "two_wheeled", "optimal", "emrld", (0,), fast=True)
    pretend(long)
    config = long.folder(0).config
    config.write_text(config.read_text().replace("w_bc: 1.0", "w_bc: 0.5"))
    assert study("figure=curves", "algos=[emrld]") == 0
    said = capsys.readouterr().out.replace("\n", "")
    assert "not shown: " in said
    assert "has w_bc=0.5, but this study needs 1.0" in said
    assert {row["environment"] for row in rows(tmp_path / "results.csv")} == {"point2d"}


def test_a_damaged_run_is_named_with_what_to_do(
    study: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert study("figure=curves", "algos=[emrld,gmps]") == 0
    place = tmp_path / "runs/main/point2d"
    results = place / "emrld-optimal/seed0/results.json"
    results.write_text(results.read_text()[:30])
    (place / "gmps-optimal/seed0/metrics.jsonl").write_text("")
    capsys.readouterr()
    assert study("figure=curves", "algos=[emrld,gmps]", finish=False) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"Remove {results}: the command that trains the run then evaluates it again" in said
    assert f"Move {place / 'gmps-optimal/seed0'} away: the command that trains it" in said


def test_runs_without_a_whole_evaluation_are_told(
    study: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert study("figure=curves", "algos=[emrld]", "seeds=2") == 0
    for seed in range(2):
        parent = tmp_path / f"runs/main/point2d/emrld-optimal/seed{seed}/evaluations"
        (parent / "test-steps1-episodes2-seed0").mkdir(parents=True)
        stages = [{"adaptation_steps": k, "return": 1.0, "success": 0.0} for k in range(2)]
        entry = {"stages": stages, "iteration": 2, "configuration": {"tasks": "test"}}
        text = json.dumps(entry)[: 100 if seed else None]
        (parent / "test-steps1-episodes2-seed0/evaluation.json").write_text(text)
    capsys.readouterr()
    given = ("figure=curves", "algos=[emrld]", "seeds=2")
    assert study(*given, "steps=1", finish=False) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "adaptation_steps: 1 of 2 runs have no whole evaluation after 1 steps" in said
    (row,) = rows(tmp_path / "adaptation_steps.csv")
    assert row["seeds"] == "1"


@pytest.mark.parametrize("made", [False, True])
def test_drawing_from_a_mistyped_folder_is_refused_and_makes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, made: bool
) -> None:
    out = tmp_path / "reprodcued"
    if made:
        out.mkdir()
    monkeypatch.setattr("sys.argv", ["reproduce", "draw=true", *HERE, f"out={out}"])
    with pytest.raises(ConfigError, match=rf"draw=true with out={out}: there are no runs"):
        reproduce.main()
    assert [*tmp_path.rglob("*")] == [out] * made


def test_drawing_what_has_only_begun_fails(study: Any, tmp_path: Path) -> None:
    assert study("figure=curves", "algos=[emrld]") == 0
    (tmp_path / "runs/main/point2d/emrld-optimal/seed0/results.json").unlink()
    assert study("figure=curves", "algos=[emrld]", finish=False) == 1
