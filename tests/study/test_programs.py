"""What a study trains, what is left of it to do, and how it is carried out."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.overrides import parse
from emrld_jax.runs.saved import load_config, save_config
from emrld_jax.runs.setup import set_up
from emrld_jax.study import launching, running
from emrld_jax.study.checking import check_runs
from emrld_jax.study.launching import sweeps
from emrld_jax.study.plan import ReproduceConfig, programs, studies
from emrld_jax.study.programs import Program
from emrld_jax.study.running import log_of, run_all, took
from emrld_jax.study.watching import Watch
from tests.analysis.conftest import write_run

EVALUATION = {
    "iteration": 150,
    "configuration": {"tasks": "test"},
    "stages": [{"adaptation_steps": 0, "return": 1.5, "success": 0.0}],
}


def program(runs: Path, **changed: Any) -> Program:
    own = Program(runs, "point2d", "optimal", "emrld", (0, 1, 2))
    return own._replace(**changed)


def begin(folder: Path, *, finished: bool = False) -> None:
    folder.mkdir(parents=True)
    (folder / "config.yaml").touch()
    if finished:
        (folder / "results.json").touch()


def arguments(command: list[str]) -> set[str]:
    """Of a command line of `emrld_jax.train`."""
    assert command[:3] == [sys.executable, "-m", "emrld_jax.train"]
    return set(command[3:])


def test_new_seeds_are_trained_together_and_begun_ones_go_on(tmp_path: Path) -> None:
    own = program(tmp_path, seeds=(0, 1, 2, 3, 4, 5))
    place = tmp_path / "point2d" / "emrld-optimal"
    begin(place / "seed0", finished=True)
    begin(place / "seed2")
    begin(place / "seed3")
    resumed, first, rest = map(arguments, own.commands())
    assert resumed == {f"resume={place / 'seed2'}{os.pathsep}{place / 'seed3'}"}
    assert {"seed=1", "env=point2d", "demos=optimal", "algo=emrld"} <= first
    assert not any(text.startswith("num_seeds") for text in first)
    assert {"seed=4", "num_seeds=2"} <= rest
    assert not own.finished


def test_points_that_were_left_out_are_trained_one_by_one(tmp_path: Path) -> None:
    own = program(tmp_path, seeds=(0, 1), grid=(("w_rl", (0.2, 1.0)),))
    begin(own.folder(0, (0.2,)).path, finished=True)
    new, left_out = map(arguments, own.commands())
    assert {"seed=1", "vmap.w_rl=[0.2,1]"} <= new
    assert {"seed=0", "vmap.w_rl=[1]"} <= left_out


def test_what_a_kill_left_before_a_run_began_is_cleared_away(tmp_path: Path) -> None:
    own = program(tmp_path)
    left, other, begun = (folder.path for folder in own.folders)
    for folder in (left, other):
        folder.mkdir(parents=True)
    (left / "provenance.json").touch()
    (other / "thesis.tex").touch()
    begin(begun)
    own.clear()
    assert not left.exists()
    assert other.exists()
    assert begun.exists()


def test_a_diverged_run_does_not_hold_up_the_others(tmp_path: Path) -> None:
    own = program(tmp_path, seeds=(0, 1), steps=3)
    for folder in own.folders:
        begin(folder.path)
    own.folders[1].diverged.touch()
    resumed, evaluated = own.commands()
    assert f"resume={own.folders[0].path}" in resumed
    assert f"run={own.folders[0].path}" in evaluated
    assert [folder.path for folder in own.diverged] == [own.folders[1].path]


def test_nothing_is_left_of_a_finished_program(tmp_path: Path) -> None:
    own = program(tmp_path, grid=(("w_rl", (0.2, 1.0)),))
    for value in ("w_rl=0.2", "w_rl=1"):
        for seed in range(3):
            begin(tmp_path / "point2d" / "emrld-optimal" / value / f"seed{seed}", finished=True)
    assert own.finished
    assert own.commands() == []


def test_each_run_is_evaluated_once_after_its_training(tmp_path: Path) -> None:
    own = program(tmp_path, seeds=(0, 1), steps=3)
    train, *evaluations = own.commands()
    assert {"seed=0", "num_seeds=2"} <= arguments(train)
    assert [command[2] for command in evaluations] == ["emrld_jax.evaluate"] * 2
    assert {"tasks=test", "adapt.num_steps=3"} <= set(evaluations[0])
    for folder in own.folders:
        begin(folder.path, finished=True)
    assert not own.finished
    done = own.folders[0].evaluations / "test-steps3-episodes50-seed0"
    done.mkdir(parents=True)
    whole = json.dumps(EVALUATION)
    (done / "evaluation.json").write_text(whole)
    ((*_, where, _, _, _),) = own.commands()
    assert where == f"run={own.folders[1].path}"
    (done / "evaluation.json").write_text(whole[:20])
    assert len(own.commands()) == 2  # what was cut off is made again, beside it
    (again := done.with_name(f"{done.name}_2")).mkdir()
    (again / "evaluation.json").write_text(whole)
    assert len(own.commands()) == 1
    nothing = [{"adaptation_steps": 0, "return": None, "success": 0.0}]
    (again / "evaluation.json").write_text(json.dumps({**EVALUATION, "stages": nothing}))
    assert len(own.commands()) == 2  # so is what tables could not be made of


def test_values_are_trained_side_by_side(tmp_path: Path) -> None:
    own = program(tmp_path, grid=(("w_bc", (0.2, 0.4)),), settings=("w_rl=1",))
    (command,) = own.commands()
    assert {"vmap.w_bc=[0.2,0.4]", "w_rl=1", "seed=0", "num_seeds=3"} <= arguments(command)
    assert len(own.folders) == 6


def test_the_curves_are_all_algorithms_on_all_environments() -> None:
    """MAML takes no demonstrations, so one line stands for both sets."""
    (study,) = studies(ReproduceConfig())
    assert len(study.programs) == 4 * (2 * 5 - 1)
    assert len(set(study.programs)) == len(study.programs)
    maml = [p for p in study.programs if p.algo == "maml"]
    assert [p.demos for p in maml] == ["optimal"] * 4
    assert all(p.seeds == (0, 1, 2, 3, 4) for p in study.programs)


@pytest.mark.parametrize("figure", ["curves", "trajectories"])
def test_what_takes_no_demonstrations_is_in_one_place_whichever_are_chosen(figure: str) -> None:
    chosen = (["optimal"], ["suboptimal"], ["suboptimal", "optimal"])
    places = set()
    for qualities in chosen:
        config = ReproduceConfig(figure=figure, envs=["two_wheeled_drift"], qualities=qualities)
        own = [p for p in programs(studies(config)) if p.algo == "maml"]
        places |= {program.folder(0).path.parent.name for program in own}
    assert places == {"maml-optimal"}


def test_all_figures_share_what_they_share() -> None:
    """Of 36, 6, 6 and 5 programs the later ones have 2, 2 and all 5 from the first."""
    planned = studies(ReproduceConfig(figure="all"))
    assert [len(study.programs) for study in planned] == [36, 6, 6, 5]
    assert len(programs(planned)) == 36 + 4 + 4


def test_a_fast_study_has_one_seed_unless_more_are_given() -> None:
    for given, expected in ({"fast": True}, 1), ({"fast": True, "seeds": 3}, 3), ({}, 5):
        planned = programs(studies(ReproduceConfig(figure="all", **given)))
        assert {p.seeds for p in planned} == {tuple(range(expected))}


def test_a_fast_program_is_named_in_short_and_evaluated_on_few_episodes(tmp_path: Path) -> None:
    own = program(tmp_path, seeds=(0,), steps=3, fast=True)
    assert own.name == "point2d, emrld, optimal demonstrations, fast"
    train, evaluate = own.commands()
    assert {"meta.iterations=2", "policy.hidden_sizes=[8,8]"} <= arguments(train)
    assert evaluate[-1] == "episodes=2"
    begin(own.folders[0].path, finished=True)
    evaluated = own.folders[0].evaluations / "test-steps3-episodes2-seed0"
    evaluated.mkdir(parents=True)
    (evaluated / "evaluation.json").write_text(json.dumps(EVALUATION))
    assert own.finished
    assert not own._replace(fast=False).finished


def test_the_sensitivity_has_five_values_of_each_weight(tmp_path: Path) -> None:
    (study,) = studies(ReproduceConfig(figure="sensitivity"))
    for algo in ("emrld", "emrld_ws"):
        main, rl, bc = (p for p in study.programs if p.algo == algo)
        assert (main.settings, main.grid) == ((), ())  # w_rl is 0.2 there, w_bc 1
        assert (rl.settings, rl.grid) == (("w_bc=1",), (("w_rl", (0.4, 0.6, 0.8, 1.0)),))
        assert (bc.settings, bc.grid) == (("w_rl=1",), (("w_bc", (0.2, 0.4, 0.6, 0.8)),))


def test_a_figure_without_its_environment_is_refused() -> None:
    config = ReproduceConfig(figure="trajectories", envs=["point2d"])
    with pytest.raises(ConfigError, match="figure=trajectories needs none of envs="):
        studies(config)


@pytest.mark.parametrize("figure", ["all", "curves", "trajectories"])
@pytest.mark.parametrize("name", ["envs", "qualities", "algos"])
def test_empty_lists_are_refused_by_name(figure: str, name: str) -> None:
    config = ReproduceConfig(figure=figure)
    setattr(config, name, [])
    with pytest.raises(ConfigError, match=rf"^{name}=\[\] is not allowed: it must name one"):
        studies(config)


def test_lists_of_names_are_checked_one_by_one() -> None:
    values = parse(["envs=[point2d,half_cheetah]"], ReproduceConfig(), {})
    assert values["envs"] == ["point2d", "half_cheetah"]
    with pytest.raises(ConfigError, match="envs=point3d is unknown; did you mean 'point2d'"):
        parse(["envs=[half_cheetah,point3d]"], ReproduceConfig(), {})


def test_sweeps_are_grids_of_environments_and_algorithms(tmp_path: Path) -> None:
    pairs = [(e, a) for e in ("point2d", "two_wheeled") for a in ("emrld", "gmps")]
    same = [program(tmp_path, env=env, algo=algo) for env, algo in pairs]
    varied = program(tmp_path, grid=(("w_rl", (0.4, 1.0)),))
    (of_grid, grid), (of_weights, weights) = sweeps([*same, varied], "submitit_slurm")
    assert (of_grid, of_weights) == (same, [varied])
    assert {"env=point2d,two_wheeled", "algo=emrld,gmps", "num_seeds=3"} <= set(grid)
    assert grid[0] == weights[0] == "hydra/launcher=submitit_slurm"
    assert {"env=point2d", "algo=emrld", "w_rl=0.4,1"} <= set(weights)


class Scripted(Program):
    """A program whose commands are Python scripts."""

    def commands(self) -> list[list[str]]:
        return [[sys.executable, "-c", text] for text in self.settings]


def scripted(runs: Path, seed: int, text: str) -> Program:
    own = Scripted(runs, "point2d", "optimal", "emrld", (seed,))
    folder = own.folders[0].path
    begin(folder)
    return own._replace(
        settings=(f"import pathlib, time\nat = pathlib.Path({str(folder)!r})\n{text}",)
    )


FINISH = "(at / 'results.json').touch()"


def test_what_processes_took_is_added_up(tmp_path: Path) -> None:
    runs = tmp_path / "runs" / "main"
    busy = "start = time.process_time()\nwhile time.process_time() - start < 0.5: pass\n"
    own = scripted(runs, 0, f"time.sleep(0.5)\n{busy}{FINISH}")
    failing = scripted(runs, 1, "raise SystemExit(1)")
    both = [own, failing]
    run_all(both, lambda going, seconds: None)
    hours, counted = took(tmp_path / "runs", both)
    assert counted == 2
    assert 1.0 < 3600 * hours["process_hours"] < 20
    assert 0.5 <= 3600 * hours["cpu_hours"] < 3600 * hours["process_hours"]
    (alone, counted) = took(tmp_path / "runs", [failing, failing._replace(algo="gmps")])
    assert counted == 1
    assert alone["cpu_hours"] < hours["cpu_hours"] - 0.4 / 3600
    for folder, own_programs in ((tmp_path, both), (tmp_path / "runs", [])):
        assert took(folder, own_programs) == ({"process_hours": 0, "cpu_hours": 0}, 0)
    with (tmp_path / "runs" / "compute.jsonl").open("a") as ledger:
        ledger.write('{"program": "cut off by a ki')
    assert took(tmp_path / "runs", both) == (hours, 2)


def test_nothing_goes_on_after_an_error(tmp_path: Path) -> None:
    own = scripted(tmp_path, 0, "(at / 'began').touch(); time.sleep(3); (at / 'late').touch()")
    folder = own.folders[0].path

    def watch(going: Any, seconds: float) -> None:
        if (folder / "began").is_file():
            raise OSError("no space is left")

    with pytest.raises(OSError, match="no space"):
        run_all([own], watch)
    time.sleep(3.5)
    assert not (folder / "late").exists()


def wait_for(file: Path) -> None:
    deadline = time.monotonic() + 60
    while not file.is_file():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_launcher_gets_what_is_new_and_the_rest_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new, begun = program(tmp_path), program(tmp_path, algo="gmps")
    lost = program(tmp_path, algo="maml")
    begin(begun.folders[0].path)
    log_of(begun).parent.mkdir(parents=True, exist_ok=True)
    log_of(begun).write_text("of an earlier command")
    handed: list[Program] = []

    class Sweep:
        """A sweep that finishes all runs of what it is handed, but for one."""

        def __init__(self, command: list[str], stdout: Any, **_: Any) -> None:
            assert command[2] == "emrld_jax.sweep"
            for folder in new.folders:
                begin(folder.path, finished=True)
            stdout.write("one job failed")

        def poll(self) -> int:
            return 0

        def wait(self) -> int:
            return 0

    def spied(programs: Any, launcher: str) -> Any:
        handed.extend(programs)
        return sweeps(programs, launcher)

    monkeypatch.setattr("emrld_jax.study.launching.subprocess.Popen", Sweep)
    monkeypatch.setattr(launching, "sweeps", spied)
    outcome = launching.launch_all([new, begun, lost], "joblib", lambda going, seconds: None)
    assert handed == [new, lost]
    failed = dict(outcome.failed)
    assert set(failed) == {begun, lost}
    assert (log := failed[lost]) is not None
    assert log.read_text() == "one job failed"
    assert failed[begun] is None  # it was not touched, whatever an earlier command has logged


def test_programs_are_carried_out_and_failures_are_told_with_their_log(tmp_path: Path) -> None:
    good = [scripted(tmp_path, seed, FINISH) for seed in range(3)]
    bad = scripted(tmp_path, 3, "raise SystemExit('no such thing')")
    lazy = scripted(tmp_path, 4, "print('ends, and has finished nothing')")
    seen: list[Program] = []
    outcome = run_all([*good, bad, lazy], lambda going, seconds: seen.extend(going))
    assert all(own.finished for own in good)
    assert {own for own, _ in outcome.failed} == {bad, lazy}
    assert outcome.exit_code == 0
    log = dict(outcome.failed)[bad]
    assert log is not None
    assert "no such thing" in log.read_text()
    assert set(seen) == {*good, bad, lazy}


def test_what_is_finished_is_not_run_again(tmp_path: Path) -> None:
    own = scripted(tmp_path, 0, "raise SystemExit(1)")
    (own.folders[0].path / "results.json").touch()
    assert run_all([own], lambda going, seconds: None) == running.Outcome([], 0)


def test_a_signal_stops_the_programs_and_begins_no_others(tmp_path: Path) -> None:
    wait = "(at / 'began').touch(); time.sleep(60)"
    own = [scripted(tmp_path, seed, wait) for seed in range(40)]

    def watch(going: Any, seconds: float) -> None:
        if (own[0].folders[0].path / "began").is_file():
            os.kill(os.getpid(), signal.SIGTERM)

    start = time.monotonic()
    assert threading.current_thread() is threading.main_thread()
    outcome = run_all(own, watch)
    assert outcome.exit_code == 128 + signal.SIGTERM
    assert time.monotonic() - start < 30
    began = [p for p in own if (p.folders[0].path / "began").is_file()]
    assert 1 <= len(began) <= len(os.sched_getaffinity(0))


def test_the_time_left_is_shared_out_by_what_is_done(tmp_path: Path) -> None:
    console = Console(record=True, width=120)
    own = program(tmp_path, seeds=(0, 1))
    folder = write_run(own.folders[0].path)  # 4 iterations, finished
    metrics = (folder / "metrics.jsonl").read_text()
    (folder / "metrics.jsonl").write_text("")
    watch = Watch([own], lambda _: 4, console)
    (folder / "metrics.jsonl").write_text(metrics)
    watch([own], 100.0)  # half of it is done, in 100 s
    text = console.export_text()
    assert "0/1 programs finished, 50%, about 1:40 of training left" in text
    assert "point2d, emrld, optimal demonstrations: 0 of 4 meta-iterations" in text
    watch([own], 101.0)
    assert console.export_text() == ""  # not so soon again
    watch([own._replace(seeds=(0,), steps=3)], 200.0)
    assert "optimal demonstrations: trained, being evaluated" in console.export_text()


def configured(own: Program) -> TrainConfig:
    config = TrainConfig(num_seeds=len(own.seeds))
    config.meta.iterations = 4
    return config


def begun(tmp_path: Path, **settings: Any) -> Program:
    own = program(tmp_path, seeds=(0, 1))
    for seed, folder in enumerate(own.folders):
        write_run(folder.path, seed=seed, **settings)
        config = set_up(load_config(folder.config)).config
        save_config(config, folder.config)
    return own


def test_runs_that_are_there_are_taken_if_they_are_the_same(tmp_path: Path) -> None:
    own = begun(tmp_path)
    notes = check_runs([own], configured)
    assert [note.partition(": ")[2] for note in notes] == [
        "of other demonstrations than x.npz holds now",  # a made-up hash
        "of another version of the code, aaaaaaaaaa",
    ] * 2
    (own.folders[1].provenance).write_text("{")
    assert "cannot be used: " in check_runs([own], configured)[2]


def test_a_finished_run_whose_settings_are_lost_is_refused(tmp_path: Path) -> None:
    own = program(tmp_path, seeds=(0,))
    begin(own.folders[0].path, finished=True)
    own.folders[0].config.unlink()
    with pytest.raises(ConfigError, match=r"seed0 is finished, but has no config.yaml"):
        check_runs([own], configured)


def test_a_run_of_other_settings_is_refused(tmp_path: Path) -> None:
    own = begun(tmp_path, meta__max_kl=0.5)
    with pytest.raises(
        ConfigError, match=r"seed0 has meta.max_kl=0.5, but this study needs 0.01: take another"
    ):
        check_runs([own], configured)
