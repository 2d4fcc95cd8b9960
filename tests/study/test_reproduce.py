"""The command as it is typed, and what its figures and tables show of made-up runs."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from emrld_jax import reproduce, settings, sweep
from emrld_jax.analysis.groups import Group, group_runs
from emrld_jax.analysis.loading import load_runs
from emrld_jax.analysis.statistics import performance_profile
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.saved import save_config
from emrld_jax.runs.setup import set_up
from emrld_jax.runs.variants import variants
from emrld_jax.study import figures, tables
from emrld_jax.study.plan import ReproduceConfig, programs, studies
from emrld_jax.study.programs import Program
from tests.analysis.conftest import ITERATIONS, table, write, write_run
from tests.conftest import Command


def groups_in(folder: Path) -> list[Group]:
    return group_runs(load_runs([folder])).groups


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that are saved."""
    saved: list[Figure] = []
    monkeypatch.setattr(figures, "save", lambda figure, path: saved.append(figure))
    return saved


def labels(axes: Any) -> list[str]:
    legend = axes.get_legend()
    return [text.get_text() for text in legend.get_texts()] if legend else []


def points(line: Any) -> Any:
    """What a line goes through, [N, 2]."""
    return np.asarray(line.get_xydata())


def test_curves_have_a_panel_for_each_environment_and_set(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    """Each line with its seeds; MAML's, which takes no demonstrations, in both columns."""
    for seed, value in enumerate((40.0, 60.0)):
        write_run(tmp_path / f"a{seed}", seed=seed, value=value)
        write_run(tmp_path / f"b{seed}", seed=seed, value=20.0, algo="gmps", demos="suboptimal")
        write_run(tmp_path / f"c{seed}", seed=seed, value=10.0, algo="maml")
    write_run(tmp_path / "d", environment="two_wheeled", value=5.0)
    figures.draw_curves(groups_in(tmp_path), "iterations", tmp_path / "curves")
    first, second, third, fourth = drawn[0].axes
    assert first.get_title() == "point2d, optimal demonstrations"
    assert labels(first) == ["demonstrations", "emrld (2)", "maml (2)"]
    assert labels(second) == ["demonstrations", "maml (2)", "gmps (2)"]
    assert labels(third) == ["demonstrations", "emrld (1)"]
    assert labels(fourth) == []
    means = [line for line in first.lines if line.get_label() == "emrld (2)"]
    np.testing.assert_allclose(points(means[0])[:, 1], 50.0 * np.array([0.25, 0.5, 0.75, 1.0]))
    thin = [line for line in first.lines if line.get_linewidth() == 0.5]
    assert len(thin) == 4  # one a seed


def test_the_sensitivity_shows_a_line_a_value_with_the_other_weight_at_one(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    pairs = [(0.2, 1.0), (0.4, 1.0), (1.0, 1.0), (1.0, 0.2)]
    for w_rl, w_bc in pairs:
        write_run(tmp_path / f"{w_rl}-{w_bc}", w_rl=w_rl, w_bc=w_bc)
    figures.draw_lines(figures.sensitivity_panels(groups_in(tmp_path)), tmp_path / "x")
    shown = [labels(axes) for axes in drawn[0].axes]  # in rows of two
    assert shown[0] == ["w_rl 0.2 (1)", "w_rl 0.4 (1)", "w_rl 1 (1)"]
    assert shown[1] == ["w_bc 0.2 (1)", "w_bc 1 (1)"]
    assert shown[2:] == [[], []]  # EMRLD-WS has no run


def test_the_ablation_shows_what_each_part_is_worth(tmp_path: Path, drawn: list[Figure]) -> None:
    for name, weights in {"a": (0.2, 1.0), "b": (0.2, 0.0), "c": (0.0, 1.0)}.items():
        write_run(tmp_path / name, w_rl=weights[0], w_bc=weights[1])
    figures.draw_lines(figures.ablation_panels(groups_in(tmp_path)), tmp_path / "x")
    (axes,) = drawn[0].axes
    assert labels(axes) == ["both (1)", "w_bc = 0 (1)", "w_rl = 0 (1)"]


def test_trajectories_are_those_of_the_last_held_out_task(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    write_run(tmp_path / "a", episodes=True)
    figures.draw_trajectories(groups_in(tmp_path), tmp_path / "x")
    (axes,) = drawn[0].axes
    ends = [tuple(points(line)[-1]) for line in axes.lines]
    assert (0.0, 2.0) in ends  # the made-up episode after adaptation ends at the second task's goal
    assert (2.0, 0.0) not in ends
    assert axes.get_title() == "emrld (1 seed)"


def test_tables_have_the_interquartile_mean_and_the_seeds(tmp_path: Path) -> None:
    for seed, value in enumerate((0.0, 50.0, 52.0, 54.0)):
        write_run(tmp_path / str(seed), seed=seed, value=value)
    groups = groups_in(tmp_path)
    rows = list(csv.DictReader(tables.results_csv(groups).splitlines()))
    (row,) = [
        r
        for r in rows
        if (r["tasks"], r["measure"], r["when"]) == ("training tasks", "return", "after")
    ]
    assert float(row["iqm"]) == 51.0  # the middle two
    assert (row["seeds"], row["algorithm"], row["env_steps"]) == ("4", "emrld", "4000")
    text = tables.results_markdown(groups)
    assert "| point2d | optimal (100.0) | emrld | 4 | 51.0 [" in text


def test_tables_leave_out_what_demonstrations_return_by_another_reward(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    write_run(tmp_path / "a", env__reward="dense")
    groups = groups_in(tmp_path)
    assert "| point2d (dense reward) | optimal | emrld |" in tables.results_markdown(groups)
    figures.draw_curves(groups, "iterations", tmp_path / "curves")
    assert labels(drawn[0].axes[0]) == ["emrld (1)"]


def evaluate(run: Path, name: str, returns: list[float], successes: list[float]) -> None:
    """Writes an evaluation after 0, 1, .. adaptation steps into a made-up run."""
    stages = [
        {"adaptation_steps": k, "return": value, "success": success}
        for k, (value, success) in enumerate(zip(returns, successes, strict=True))
    ]
    (run / "evaluations" / name).mkdir(parents=True)
    entry = {"stages": stages, "iteration": ITERATIONS, "configuration": {"tasks": "test"}}
    write(run / "evaluations" / name / "evaluation.json", entry)


def test_a_table_has_the_returns_after_each_number_of_steps(tmp_path: Path) -> None:
    """Five seeds: without one at each end, the mean of three."""
    after = {1: (70.0, 80.0, 30.0, 75.0, 90.0), 2: (1.0, 2.0, 9.0, 3.0, -5.0)}
    own = "test-steps2-episodes50-seed0"
    for seed in range(5):
        run = write_run(tmp_path / f"a{seed}", seed=seed)
        name = f"{own}_2" if seed == 4 else own  # one that was stopped, and made again
        returns = [0.0, *(column[seed] for column in after.values())]
        evaluate(run, name, returns, [0.0, 0.25 * seed, 1.0])
        evaluate(run, f"{own}-deterministic", [1e6] * 3, [0.0] * 3)
        evaluate(run, "test-steps3-episodes50-seed0", [1e6] * 4, [0.0] * 4)
    one = write_run(tmp_path / "b", algo="maml")
    evaluate(one, own, [1.5, 2.5, 3.5], [0.0, 0.0, 0.0])
    write_run(tmp_path / "c", algo="gmps")  # not evaluated
    groups = groups_in(tmp_path)

    head, line, first, second = tables.adaptation_markdown(groups, 2).splitlines()
    columns = "environment | demonstrations | algorithm | seeds"
    assert head == f"| {columns} | after 0 steps | after 1 step | after 2 steps |"
    assert line == "|---|---|---|---|---|---|---|"
    assert first.startswith("| point2d | optimal | emrld | 5 | 0.0 [0.0, 0.0] | 75.0 [")
    assert first.split(" | ")[6].startswith("2.0 [")
    assert second == "| point2d | none | maml | 1 | 1.5 | 2.5 | 3.5 |"

    rows = list(csv.DictReader(tables.adaptation_csv(groups, 2).splitlines()))
    assert [row["algorithm"] for row in rows] == ["emrld", "maml"]
    assert float(rows[0]["return_1"]) == 75.0
    assert float(rows[0]["success_1"]) == 0.5
    # the middle three of five draws lie within the seeds' returns
    assert 30.0 <= float(rows[0]["return_1_low"]) < 75.0 < float(rows[0]["return_1_high"]) <= 90.0
    assert (rows[1]["return_2"], rows[1]["return_2_low"], rows[1]["seeds"]) == ("3.5", "nan", "1")


def test_algorithms_without_demonstrations_stand_beside_each_set(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / f"a{seed}", seed=seed, value=30.0, demos="suboptimal")
        write_run(tmp_path / f"b{seed}", seed=seed, value=20.0)
        write_run(tmp_path / f"c{seed}", seed=seed, value=10.0 + 20.0 * seed, algo="maml")
    text = tables.improvements_markdown(groups_in(tmp_path))
    assert "| point2d, suboptimal | emrld | maml | 0.75 [" in text  # 30 to 10 and 30
    assert "| point2d, optimal | emrld | maml | 0.50 [" in text
    assert "| point2d | none | maml | 2 |" in tables.results_markdown(groups_in(tmp_path))


def test_improvements_count_pairs_of_runs(tmp_path: Path) -> None:
    for seed, (own, other) in enumerate(((10.0, 5.0), (20.0, 15.0))):
        write_run(tmp_path / f"a{seed}", seed=seed, value=own)
        write_run(tmp_path / f"b{seed}", seed=seed, value=other, algo="maml")
    # of four pairs emrld wins 10-5, 20-5, 20-15 and loses 10-15
    assert "| point2d, optimal | emrld | maml | 0.75 [" in tables.improvements_markdown(
        groups_in(tmp_path)
    )


def test_each_seed_has_a_line_with_its_own_figures(tmp_path: Path) -> None:
    for seed, value in enumerate((40.0, 60.0)):
        write_run(tmp_path / f"a{seed}", seed=seed, value=value)
    run = write_run(tmp_path / "b", value=5.0, algo="maml", seed=3)
    write(run / "results.json", {"train": table(5.0, 100.0), "test": None})
    first, second, third = csv.DictReader(tables.seeds_csv(groups_in(tmp_path)).splitlines())
    assert [first["seed"], second["seed"], third["seed"]] == ["0", "1", "3"]
    assert (second["environment"], second["algorithm"]) == ("point2d", "emrld")
    assert float(first["training_return_after"]) == 40.0
    assert float(second["training_return_after"]) == 60.0
    assert float(second["training_return_before"]) == 0.0
    assert float(second["held_out_return_after"]) == 50.0  # 10 less, as it is made up
    assert float(second["held_out_success_after"]) == 0.5
    assert (third["demonstrations"], third["held_out_return_after"]) == ("none", "")


def test_profiles_are_those_over_tasks_and_draw_whole_runs(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    returns = np.array([[0.0, 10.0, 20.0], [0.0, 40.0, 30.0]])  # of two seeds on three tasks
    for seed, own in enumerate(returns):
        run = write_run(tmp_path / f"a{seed}", seed=seed)
        results = table(float(own.mean()), 100.0)
        results["stages"][1]["return_per_task"] = own.tolist()
        write(run / "results.json", {"train": table(0.0, 100.0), "test": results})
    write_run(tmp_path / "b", environment="two_wheeled")  # made before tasks were written down
    figures.draw_profiles(groups_in(tmp_path), tmp_path / "x")
    axes, other = drawn[0].axes
    assert axes.get_title() == "point2d, optimal demonstrations"
    assert labels(axes) == ["emrld (2)"]
    (line,) = axes.lines
    above, shares = points(line).T
    np.testing.assert_allclose(shares, performance_profile([*returns.T], above).value)
    at = np.abs(above - 25.0).argmin()
    assert (shares[0], shares[-1]) == (1.0, 0.0)
    assert shares[at] == pytest.approx(2 / 6)
    (band,) = axes.collections
    ends = np.asarray(band.get_paths()[0].vertices, float)
    near = ends[np.isclose(ends[:, 0], above[at]), 1]
    # of resamples of two runs one in four has only the first, with none of its tasks above
    np.testing.assert_allclose([near.min(), near.max()], [0.0, 2 / 3])
    assert other.get_title() == "two_wheeled, optimal demonstrations: no held-out tasks"


def test_pictures_are_written_as_png_and_svg(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    figures.draw_curves(groups_in(tmp_path), "seconds", tmp_path / "curves")
    assert {path.suffix for path in tmp_path.glob("curves.*")} == {".png", ".svg"}


def leave_finished(program: Program, trained: Path) -> None:
    """Makes a trained run's files those of each of the program's runs, with their own settings."""
    setup = set_up(cli.train_config(program.arguments(program.seeds[0], len(program.seeds))))
    for own in (variant.config for variant in variants(setup.config)):
        point = tuple(settings.value(own, name) for name, _ in program.grid)
        folder = program.folder(own.seed, point)
        shutil.copytree(trained, folder.path, ignore=shutil.ignore_patterns("evaluations"))
        save_config(own, folder.config)


def test_all_figures_from_one_command_that_is_stopped_once(
    environment: dict[str, str], command: Command, tmp_path: Path
) -> None:
    """Of each kind of program one is trained; others, which only differ in numbers, are copies."""
    out = tmp_path / "made"
    chosen = ("envs=[point2d,two_wheeled_drift]", "qualities=[optimal]", "algos=[emrld]")
    arguments = ("figure=all", "fast=true", *chosen, "seeds=1", "steps=2", f"out={out}")
    first = subprocess.Popen(
        [sys.executable, "-m", "emrld_jax.reproduce", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    results = out / "runs" / "main" / "point2d" / "emrld-optimal" / "seed0" / "results.json"
    while not results.is_file():
        assert first.poll() is None
        time.sleep(0.1)
    first.send_signal(signal.SIGINT)
    printed, _ = first.communicate(timeout=60)
    assert first.returncode == 128 + signal.SIGINT, printed
    assert "stopped; the same command goes on where it was" in printed
    trained = results.stat().st_mtime_ns

    config = cli.updated(ReproduceConfig(), cli.parse(arguments, ReproduceConfig(), {}))
    kept = ("main/emrld", "sensitivity/emrld/w_rl", "without_w_bc/emrld")
    for program in programs(studies(config)):
        kind = "/".join([program.runs.name, program.algo, *(name for name, _ in program.grid)])
        if kind not in kept:
            leave_finished(program, results.parent)

    done = command("reproduce", *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    assert results.stat().st_mtime_ns == trained
    for name in ("curves_iterations", "sensitivity", "ablation", "trajectories", "profiles"):
        for suffix in (".svg", ".png"):
            assert (out / f"{name}{suffix}").stat().st_size > 500
    rows = list(csv.DictReader((out / "results.csv").read_text().splitlines()))
    found = {(row["environment"], row["algorithm"], row["seeds"]) for row in rows}
    # the sensitivity of EMRLD-WS takes the curves' run of it
    others = {("point2d", "emrld_ws", "1"), ("two_wheeled_drift", "emrld", "1")}
    assert found == {("point2d", "emrld", "1"), *others}
    assert (out / "seeds.csv").read_text().count("\n") == 1 + 3
    steps = list(csv.DictReader((out / "adaptation_steps.csv").read_text().splitlines()))
    assert {row["environment"] for row in steps} == {"point2d", "two_wheeled_drift"}
    assert all(float(row["return_2"]) >= 0 for row in steps)
    assert "| after 2 steps |" in (out / "adaptation_steps.md").read_text()
    assert "w_rl=0.4" in (out / "weights.md").read_text()
    assert "test-steps2" in (out / "report.html").read_text()
    study = json.loads((out / "study.json").read_text())
    assert study["runs"] == 3 + 2 * 8 + 2
    assert 0 < study["cpu_hours"] < 2 * study["process_hours"]
    assert [each["figure"] for each in study["commands"]] == ["all"]


def test_all_algorithms_of_the_paper_train_in_a_fast_study(
    command: Command, tmp_path: Path
) -> None:
    chosen = ("envs=[point2d]", "qualities=[optimal]", "steps=0", f"out={tmp_path}")
    done = command("reproduce", "fast=true", *chosen)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = list(csv.DictReader((tmp_path / "seeds.csv").read_text().splitlines()))
    trained = sorted(row["algorithm"] for row in rows)  # a seed each
    assert trained == ["emrld", "emrld_ws", "gmps", "maml", "meta_bc"]
    assert "nan" not in (tmp_path / "improvements.md").read_text()  # one seed has no interval


def test_a_launcher_that_is_not_installed_is_refused_with_its_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sweep.EXTRAS, "elsewhere", "far")
    with pytest.raises(ConfigError, match=r"not installed: pip install 'emrld-jax\[far\]'"):
        reproduce._check_launcher("elsewhere")
    reproduce._check_launcher("basic")


def test_what_is_wrong_is_told_before_any_training(command: Command, tmp_path: Path) -> None:
    for wrong, words in {
        "envs=[point3d]": "did you mean 'point2d'",
        "figure=trajectories": "needs none of envs=['point2d']",
        "launcher=nonsense": "launcher=nonsense is unknown (there are: basic, joblib, ray, ",
        "launcher=submitit_slum": "did you mean 'submitit_slurm'",
    }.items():
        given = (wrong,) if wrong.startswith("envs") else (wrong, "envs=[point2d]")
        done = command("reproduce", *given, f"out={tmp_path / 'made'}")
        assert done.returncode == 2, done.stdout
        assert words in done.stderr
        assert not (tmp_path / "made").exists()
