"""Evaluation: its numbers against NumPy, its intervals against worked cases, its command."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax import algorithms
from emrld_jax.demos import load
from emrld_jax.runs.evaluate_run import evaluation_key
from emrld_jax.runs.evaluation import Evaluation, bootstrap_interval, evaluator, summarize
from emrld_jax.runs.iteration import streams
from emrld_jax.sampling.rollouts import collector
from emrld_jax.settings import AdaptSettings, PolicySettings, Settings
from envs_jax import make
from tests.conftest import Command, compiled

EPISODES = 4


def point2d_return(params: dict, goal: np.ndarray, horizon: int) -> float:
    """Dense return of the mean action of a policy with one tanh layer, step by step in NumPy."""
    first, last = params["params"]["layer_0"], params["params"]["layer_1"]
    position, total = np.zeros(2), 0.0
    for _ in range(horizon):
        hidden = np.tanh(position @ np.asarray(first["kernel"]) + np.asarray(first["bias"]))
        action = hidden @ np.asarray(last["kernel"]) + np.asarray(last["bias"])
        displacement = 0.1 * action
        position = position + displacement * min(1.0, 0.1 / np.linalg.norm(displacement))
        distance = float(np.linalg.norm(position - goal))
        total -= distance
        if distance <= 0.02:
            break
    return total


def test_returns_at_every_stage_are_those_of_numpy(demos: Path) -> None:
    env = make("point2d", reward="dense", horizon=15)
    adapt = AdaptSettings(num_steps=2, num_episodes=3, learning_rate=0.5)
    settings = Settings(policy=PolicySettings(hidden_sizes=[8]), adapt=adapt)
    learner = algorithms.make("emrld_ws", env, settings)
    train = load(demos, env).train
    params = jax.tree.map(lambda x: x + 0.1, learner.init(jax.random.key(1)).params)
    key = jax.random.key(2)
    evaluate = evaluator(env, learner, adapt, EPISODES, deterministic=True)
    evaluation = evaluate(params, key, train.tasks, train.demos)
    assert evaluation.returns.shape == (3, 3, EPISODES)

    collect = collector(env, learner.policy, 3, adapt.discount, adapt.gae_lambda)
    adapt_to = jax.jit(lambda p, k, task, demo: learner.adapt(p, k, task, demo, collect).path)
    # path: before, after the warm start (which is part of the first step), after each step
    for m, task_key in enumerate(jax.random.split(key, 3)):
        task, demo = jax.tree.map(lambda x, m=m: x[m], (train.tasks, train.demos))
        path = adapt_to(params, jax.random.split(task_key)[0], task, demo)
        for stage, stage_params in enumerate((path[0], path[-2], path[-1])):
            expected = point2d_return(stage_params, np.asarray(task.goal), env.horizon)
            np.testing.assert_allclose(evaluation.returns[m, stage], expected, rtol=1e-4)


def test_a_second_evaluation_compiles_nothing_again(demos: Path) -> None:
    env, adapt = make("point2d", horizon=5), AdaptSettings(num_episodes=2)
    learner = algorithms.make("maml", env, Settings(adapt=adapt))
    part, evaluate = load(demos, env).train, evaluator(env, learner, adapt, EPISODES)
    for seed in range(2):
        params = learner.init(jax.random.key(seed)).params
        evaluate(params, jax.random.key(seed), part.tasks, part.demos)
    assert compiled(evaluate) == 1


def test_an_evaluation_shares_no_key_with_training() -> None:
    key = jax.random.key(0)
    init_key, loop_key, final_key = streams(jax.random.key_data(key))
    used = [key, init_key, loop_key, final_key, *jax.random.split(loop_key, 200)]
    ours = [evaluation_key(0), *jax.random.split(evaluation_key(0), 200)]
    data = [tuple(np.asarray(jax.random.key_data(each)).tolist()) for each in used + ours]
    assert len(set(data)) == len(data)


def test_sampled_episodes_differ(demos: Path) -> None:
    env = make("point2d", reward="dense", horizon=15)
    adapt = AdaptSettings(num_episodes=2)
    learner = algorithms.make("maml", env, Settings(adapt=adapt))
    test = load(demos, env).test
    params = learner.init(jax.random.key(0)).params
    evaluate = evaluator(env, learner, adapt, EPISODES)
    returns = evaluate(params, jax.random.key(0), test.tasks, test.demos).returns
    assert bool(jnp.all(jnp.ptp(returns, axis=-1) > 0))


def test_interval_of_equal_values_is_a_point() -> None:
    assert bootstrap_interval(np.full((4, 5), 2.5), seed=0) == (2.5, 2.5)


def test_interval_of_two_tasks_spans_both() -> None:
    # a resample holds only task 0 (or only task 1) with probability 1/4 each, more than 2.5 %
    values = np.array([[0.0] * 10, [1.0] * 10])
    assert bootstrap_interval(values, seed=0) == (0.0, 1.0)


def test_interval_is_the_normal_one_for_many_values() -> None:
    # one task: only episodes vary, and the mean's standard error is sd / sqrt(E)
    values = np.random.default_rng(0).normal(3.0, 2.0, size=(1, 400))
    low, high = bootstrap_interval(values, seed=1)
    half = 1.96 * values.std() / np.sqrt(400)
    np.testing.assert_allclose([low, high], values.mean() + half * np.array([-1, 1]), atol=0.03)


def test_more_episodes_do_not_hide_that_tasks_differ() -> None:
    means = np.random.default_rng(0).normal(size=(30, 1))
    low, high = bootstrap_interval(np.repeat(means, 200, axis=1), seed=1)
    expected = 2 * 1.96 * means.std() / np.sqrt(30)
    assert high - low == pytest.approx(expected, rel=0.1)


def test_summary_means() -> None:
    returns = np.arange(12.0).reshape(2, 3, 2)
    empty = np.zeros((2, 3, 1, 1, 2))
    broken = returns == 4
    summary = summarize(
        Evaluation(returns, returns > 5, broken, empty, empty[..., 0], empty[..., 0]), seed=0
    )
    assert (summary["tasks"], summary["episodes"]) == (2, 2)
    assert [stage["return"] for stage in summary["stages"]] == [3.5, 5.5, 7.5]
    assert [stage["success"] for stage in summary["stages"]] == [0.5, 0.5, 0.5]
    assert [stage["diverged"] for stage in summary["stages"]] == [0.0, 0.0, 0.25]
    assert summary["stages"][0]["return_per_task"] == [0.5, 6.5]
    assert summary["stages"][2]["success_per_task"] == [0.0, 1.0]


def test_the_command_evaluates_a_run(command: Command, whole_run: tuple[Path, str]) -> None:
    folder, _ = whole_run
    arguments = (f"run={folder}", "tasks=test", "adapt.num_steps=2", "episodes=3")
    before = sorted((folder / "checkpoints").rglob("*"))
    done = command("evaluate", *arguments)
    assert done.returncode == 0, done.stderr
    target = folder / "evaluations" / "test-steps2-episodes3-seed0"
    assert str(target) in done.stdout
    pictures = {f"{n}.{s}" for n in ("adaptation", "trajectories") for s in ("png", "svg")}
    assert {f.name for f in target.iterdir()} == {"evaluation.json", "config.yaml", *pictures}
    results = json.loads((target / "evaluation.json").read_text())
    assert [stage["adaptation_steps"] for stage in results["stages"]] == [0, 1, 2]
    assert (results["tasks"], results["episodes"], results["iteration"]) == (2, 3, 3)
    assert results["configuration"]["adapt"]["num_episodes"] == 2  # the run's own
    assert sorted((folder / "checkpoints").rglob("*")) == before


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("tasks=tset", "did you mean 'test'"),
        ("episodes=0", "at least 1"),
        ("adapt.num_steps=0", "at least 1"),
        ("meta.max_kl=0.1", "there is no setting"),
        ("run=/nowhere", "no such run folder"),
    ],
)
def test_a_bad_argument_is_refused(
    command: Command, whole_run: tuple[Path, str], argument: str, said: str
) -> None:
    run = () if argument.startswith("run=") else (f"run={whole_run[0]}",)
    done = command("evaluate", *run, argument)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_the_example_of_the_documentation(
    whole_run: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """It restores, adapts and prints a displacement that Point2D allows."""
    page = Path(__file__).parents[2] / "docs" / "runs.md"
    code = page.read_text().split("```python\n")[1].split("```")[0]
    run = "runs/point2d/emrld-optimal/seed0"
    assert run in code
    exec(code.replace(run, str(whole_run[0])), {})
    displacement = [float(x) for x in capsys.readouterr().out.strip(" []\n").split()]
    assert 0 < np.linalg.norm(displacement) <= 0.1 + 1e-6
