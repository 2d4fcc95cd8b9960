"""Exports: the bundle is the run's policy for a task, at the stage that its algorithm begins at."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import envs_jax
from bridges import activations, bundle, exporting, onnx_file
from bridges.bundle import Bundle, Stage
from bridges.exporting import Exported, export, robot_task
from bridges.learning import learning
from bridges.messages import BridgeError
from bridges.parameters import params_of
from bridges.policy import Policy
from emrld_jax import export as command_module
from emrld_jax.demos import DemoError
from emrld_jax.meta.adaptation import Adapted
from emrld_jax.meta.staged import adapt_with
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.provenance import sha256
from emrld_jax.runs.setup import Setup
from emrld_jax.runs.trained import load_trained
from emrld_jax.sampling.rollouts import collector
from emrld_jax.types import Demos
from tests.bridges.bundles import a_bundle
from tests.bridges.runs import make_run
from tests.conftest import Command
from tests.runs.straight import write_demos

Run = Callable[..., Path]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Makes run folders, each once."""
    made: dict[tuple[str, ...], Path] = {}
    runs = tmp_path_factory.mktemp("runs")

    def make(*arguments: str) -> Path:
        if arguments not in made:
            made[arguments] = make_run(runs, *arguments)
        return made[arguments]

    return make


def assert_close(result: Any, expected: Any) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), result, expected)


def largest_change(a: Any, b: Any) -> float:
    changes = jax.tree.map(lambda x, y: np.max(np.abs(x - y)), a, b)
    return float(max(jax.tree.leaves(changes)))


def adapted_at_once(setup: Setup, params: Any, task: Any, demos: Demos) -> Adapted:
    """Adaptation as simulation does it, which collects its episodes itself."""
    collect = collector(setup.env, setup.learner.policy, 2, 0.95, 1.0)

    @jax.jit
    def adapted(params: Any, task: Any, demos: Demos) -> Adapted:
        return setup.learner.adapt(params, jax.random.key(0), task, demos, collect)

    return adapted(params, task, demos)


def exported(
    run: str, split: str = "test", task: int | None = None, demos: str | None = None
) -> Bundle:
    return export(run, split, task, demos, note=pytest.fail).bundle


def test_a_bundle_says_what_the_run_was(run: Run) -> None:
    path = run("env=two_wheeled_drift")
    trained = load_trained(path)
    made = exported(str(path))

    assert made.environment.name == "two_wheeled_drift"
    assert envs_jax.make(*made.environment[:1], **made.environment[1]) == trained.setup.env
    assert made.task == {"residual_angular_velocity": -0.65}
    assert made.zone is not None
    assert (made.zone.goal, made.zone.reward, made.zone.horizon) == ([2.0, 1.0], "dense", 12)
    assert made.observation == (["x", "y", "theta"], ["m", "m", "rad"])
    assert made.action.names == ["linear_velocity", "angular_velocity"]
    assert (made.action.low, made.action.high) == ([0.0, -1.5], [0.15, 1.5])
    assert made.control_period == 0.5
    assert made.policy == ([8], "tanh", False)
    assert (made.algorithm, made.seed, made.stage) == ("emrld", 0, Stage(0, False))
    assert made.settings["adapt"] == asdict(trained.setup.config.adapt)
    assert made.settings["w_rl"] == 0.2
    assert made.settings["policy"]["std"] == 0.3
    np.testing.assert_allclose(made.tensors["policy/log_std"], np.log(0.3), rtol=1e-6)
    began = json.loads((path / "provenance.json").read_text())
    origin = made.provenance
    assert origin["run"]["iteration"] == 3
    assert origin["run"]["code"] == began["code"]
    assert origin["run"]["demos"]["sha256"] == sha256(trained.setup.demos_path)
    assert (origin["export"]["split"], origin["export"]["task"]) == ("test", 24)
    for part in ("policy", "meta"):
        jax.tree.map(np.testing.assert_array_equal, params_of(made, part), trained.params)


def test_a_bundle_holds_the_demonstration_of_its_task(run: Run) -> None:
    path = run("env=point2d")
    demos = load_trained(path).setup.demos.train.demos
    lengths = demos.mask.sum(axis=1).astype(int)
    task, steps = int(lengths.argmin()), int(lengths.min())
    made = exported(str(path), "train", task)

    assert 10 < steps < demos.mask.shape[1]
    assert made.tensors["demos/obs"].shape == (steps, 2)
    np.testing.assert_array_equal(made.tensors["demos/obs"], demos.obs[task, :steps])
    np.testing.assert_array_equal(made.tensors["demos/action"], demos.action[task, :steps])


def test_demonstrations_alone_adapt_at_once(run: Run) -> None:
    path = run("env=two_wheeled_drift", "algo=meta_bc")
    setup, params, _ = load_trained(path)
    task, demos = jax.tree.map(lambda x: x[-1], (setup.demos.test.tasks, setup.demos.test.demos))
    whole = adapted_at_once(setup, params, task, demos)
    made = exported(str(path))

    assert made.stage == Stage(0, True)
    jax.tree.map(np.testing.assert_array_equal, params_of(made, "meta"), params)
    assert_close(params_of(made, "policy"), whole.params)
    assert largest_change(params, whole.params) > 1e-3


def test_a_bundle_is_warm_started_and_holds_all_that_adapting_needs(
    run: Run, tmp_path: Path
) -> None:
    """The same as simulation does at once: a warm start, then two steps with their episodes."""
    path = run(
        *("env=point2d", "algo=emrld_ws", "adapt.num_steps=2", "adapt.warm_start_rate=0.1"),
        "policy.learn_std=true",
    )
    setup, params, _ = load_trained(path)
    task, demos = jax.tree.map(lambda x: x[2], (setup.demos.test.tasks, setup.demos.test.demos))
    whole = adapted_at_once(setup, params, task, demos)
    bundle.write(tmp_path / "policy.safetensors", exported(str(path), task=2))
    made = bundle.read(tmp_path / "policy.safetensors")
    own = learning(made)
    rollouts = [rollout for rollout in whole.rollouts if rollout is not None]
    staged = adapt_with(own.learner, own.params, own.task, own.demos, rollouts)

    assert made.stage == Stage(0, False)
    jax.tree.map(np.testing.assert_array_equal, params_of(made, "meta"), params)
    assert_close(params_of(made, "policy"), whole.path[1])
    assert (own.env, own.settings.adapt) == (setup.env, setup.config.adapt)
    assert (staged.adapted, staged.used) == (True, 2)
    assert_close(staged.params, whole.params)
    for before, after in pairwise(whole.path):
        assert largest_change(before, after) > 1e-3


def test_settings_of_another_version_are_refused(run: Run) -> None:
    made = exported(str(run("env=point2d")))
    for settings in ({}, {**made.settings, "w_new": 1.0}, {**made.settings, "meta": {"x": 1}}):
        with pytest.raises(BridgeError, match="cannot be assembled by this version"):
            learning(replace(made, settings=settings))
    with pytest.raises(BridgeError, match="'dqn' is unknown"):
        learning(replace(made, algorithm="dqn"))


def test_the_cheetah_is_exported(run: Run) -> None:
    made = exported(str(run("env=half_cheetah")))

    assert (made.zone, made.task, made.control_period) == (None, {"direction": 1.0}, 0.05)
    assert made.policy.squash
    assert Policy(made).mean(np.zeros(20)).shape == (6,)


def test_the_robots_task_is_that_of_the_paper() -> None:
    drift, point = envs_jax.make("two_wheeled_drift"), envs_jax.make("point2d")

    assert robot_task(drift, drift.test_tasks()) == 24
    assert robot_task(drift, drift.train_tasks()) == 0
    assert robot_task(point, point.test_tasks()) == 0


def test_other_demonstrations_say_what_tasks_there_are(run: Run, tmp_path: Path) -> None:
    demos = write_demos(tmp_path / "lines.npz", num_train=3, num_test=0)
    path = str(run("env=point2d"))
    made = exported(path, "train", 2, str(demos))

    goal = envs_jax.make("point2d").train_tasks().goal[2]
    np.testing.assert_array_equal(np.array(made.task["goal"], np.float32), goal)
    assert made.provenance["export"]["demos"]["sha256"] == sha256(demos)
    np.testing.assert_allclose(made.tensors["demos/obs"][10], goal / 2, rtol=1e-5)
    with pytest.raises(ConfigError, match=r"split=test: .*no demonstrations.*split=train takes"):
        exported(path, "test", demos=str(demos))
    with pytest.raises(ConfigError, match=r"task=3 is not allowed: .*it must be 0 to 2"):
        exported(path, "train", 3, str(demos))
    with pytest.raises(DemoError, match="demonstrations of point2d cannot teach two_wheeled"):
        exported(str(run("env=two_wheeled_drift")), demos=str(demos))


def test_the_outer_losss_own_demonstrations_need_not_be_there(run: Run, tmp_path: Path) -> None:
    settings = ("env=point2d", "algo=gmps")
    outer = tmp_path / "outer.npz"
    shutil.copy(load_trained(run(*settings)).setup.demos_path, outer)
    path = run(*settings, f"outer_demos={outer}")
    there = exported(str(path))
    outer.unlink()

    gone = exported(str(path))

    assert (gone.settings, gone.stage) == (there.settings, there.stage)
    assert gone.tensors.keys() == there.tensors.keys()
    for name, values in there.tensors.items():
        np.testing.assert_array_equal(gone.tensors[name], values)


def test_demonstrations_that_have_changed_are_told(run: Run, tmp_path: Path) -> None:
    path = shutil.copytree(run("env=point2d"), tmp_path / "seed0")
    record = json.loads((path / "provenance.json").read_text())
    record["demos"]["sha256"] = "of another file"
    (path / "provenance.json").write_text(json.dumps(record))
    notes: list[str] = []

    export(str(path), note=notes.append)

    assert len(notes) == 1
    assert notes[0].endswith("point2d_optimal.npz is not the file that the run was trained on")


def test_numpy_that_computes_otherwise_is_noticed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(activations.ACTIVATIONS, "tanh", np.sin)

    with pytest.raises(BridgeError, match="NumPy computes other actions than JAX"):
        exported(str(run("env=point2d")))


@pytest.mark.parametrize("wrong", [np.nan, 0.01])
def test_agreement_is_of_what_is_executed_too(wrong: float) -> None:
    def act(obs: np.ndarray, off: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        return obs[:, :2], obs[:, :2] + off

    with pytest.raises(BridgeError, match="other actions"):
        exporting.check_agreement(
            Exported(a_bundle(), act), lambda obs: act(obs, wrong), "something"
        )
    assert exporting.check_agreement(Exported(a_bundle(), act), act, "it") == 0.0


# ONNX


@pytest.mark.parametrize("squash", [False, True])
@pytest.mark.parametrize("activation", activations.ACTIVATIONS)
def test_an_onnx_model_computes_the_same(activation: str, squash: bool) -> None:
    for sizes, bounding in (((16, 16), "norm"), ((), "box")):
        made = a_bundle(2, 2, sizes, activation, squash, bounding)
        last = f"policy/layer_{len(sizes)}/kernel"
        tensors = {**made.tensors, last: 20 * made.tensors[last]}  # so that much is bounded
        made = replace(made, tensors=tensors)
        policy = Policy(made)
        obs = np.random.default_rng(0).uniform(-9, 9, (500, 2)).astype(np.float32)
        mean, physical = onnx_file.runner(onnx_file.model(made))(obs)

        np.testing.assert_allclose(mean, policy.mean(obs), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(physical, policy.to_physical(policy.mean(obs)), atol=1e-5)
        if bounding == "norm":
            assert np.linalg.norm(physical, axis=1).max() == pytest.approx(0.1, rel=1e-5)


def test_an_onnx_model_describes_itself() -> None:
    import onnxruntime

    made = a_bundle()
    session = onnxruntime.InferenceSession(
        onnx_file.model(made), providers=onnxruntime.get_available_providers()
    )
    (observation,) = session.get_inputs()
    outputs = {output.name: output.shape for output in session.get_outputs()}
    (std,) = session.run(["standard_deviation"], {"observation": np.zeros((1, 3), np.float32)})

    assert (observation.name, observation.shape) == ("observation", ["N", 3])
    assert outputs == {
        "mean_action": ["N", 2],
        "physical_action": ["N", 2],
        "standard_deviation": [2],
    }
    np.testing.assert_allclose(std, 0.3, rtol=1e-6)
    about = json.loads(session.get_modelmeta().custom_metadata_map["emrld"])
    assert about == json.loads(bundle.about_text(made))


# The command


def called(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["export", *arguments])
    return command_module.main()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "run=RUN_DIR is missing"),
        (("run=nowhere",), "nowhere: there is no such run folder"),
        (("run={here}",), "is not a run folder"),
        (("run={empty}",), "has no checkpoint yet"),
        (("run={run}", "task=12"), "it must be 0 to 11"),
        (("run={run}", "task=-1"), "task=-1 is not allowed"),
        (("run={run}", "split=all"), "split=all is unknown"),
        (("run={run}", "demos=nowhere.npz"), "there is no such file"),
        (("run={run}", "out=policy.pkl"), "must end in .safetensors or .onnx"),
        (("run={run}", "out={run}/config.yaml/x.onnx"), "cannot be written"),
        (("run={run}", "out={there}"), "exists; choose another file"),
        (("rum={run}",), "did you mean 'run'"),
    ],
)
def test_what_is_wrong_is_told(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    words: str,
) -> None:
    (there := tmp_path / "there.safetensors").write_text("mine")
    (empty := tmp_path / "seed0").mkdir()
    shutil.copy(run("env=point2d") / "config.yaml", empty)
    places = {"run": run("env=point2d"), "here": tmp_path, "there": there, "empty": empty}
    monkeypatch.chdir(tmp_path)

    with pytest.raises((ConfigError, DemoError)) as error:
        called(monkeypatch, *(argument.format(**places) for argument in arguments))

    assert words in str(error.value)
    assert there.read_text() == "mine"
    assert not (tmp_path / "policy.safetensors").exists()


def test_a_missing_extra_is_named(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_file, "find_spec", lambda name: None)

    with pytest.raises(ConfigError, match=r"pip install -e '\.\[onnx\]'"):
        called(monkeypatch, f"run={run('env=point2d')}", f"out={tmp_path}/p.onnx")


def test_a_model_that_computes_otherwise_is_not_written(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = onnx_file.runner
    monkeypatch.setattr(onnx_file, "runner", lambda model: lambda obs: runner(model)(1.01 * obs))

    with pytest.raises(ConfigError, match="onnxruntime computes other actions"):
        called(monkeypatch, f"run={run('env=point2d')}", f"out={tmp_path}/p.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ["safetensors", "onnx"])
def test_the_command_writes_a_file(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, ending: str
) -> None:
    out = tmp_path / "new" / f"p.{ending}"
    assert called(monkeypatch, f"run={run('env=point2d')}", "task=3", f"out={out}") == 0

    printed = capsys.readouterr().out
    assert f"{out}: emrld on point2d, goal=[" in printed
    if ending == "safetensors":
        read = bundle.read(out)
        assert read.content_sha256[:12] in printed
        assert read.provenance["export"]["task"] == 3
    else:
        assert onnx_file.runner(out.read_bytes())(np.zeros((4, 2)))[0].shape == (4, 2)


def test_the_command_in_a_process_of_its_own(run: Run, tmp_path: Path, command: Command) -> None:
    path, out = run("env=two_wheeled_drift"), tmp_path / "policy.safetensors"
    done = command("export", f"run={path}", f"out={out}")

    assert done.returncode == 0, done.stderr
    assert "residual_angular_velocity=-0.65" in done.stdout
    exporter = bundle.read(out).provenance["export"]["command"]
    assert exporter == f"python -m emrld_jax.export run={path} out={out}"
