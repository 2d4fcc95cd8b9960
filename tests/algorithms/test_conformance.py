"""What every algorithm keeps, over `algorithms.names()`; and identities between algorithms.

In float64, so that rounding cannot hide a difference or make one; the first test is in float32.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from emrld_jax import algorithms
from emrld_jax.algorithms import parts
from emrld_jax.meta import learner as learner_module
from emrld_jax.meta.learner import MetaLearner, MetaState, bucket
from emrld_jax.meta.side_by_side import make_mesh, side_by_side
from emrld_jax.policy import Policy
from emrld_jax.sampling.rollouts import collector
from emrld_jax.settings import AdaptSettings, MetaSettings, PolicySettings, Settings
from emrld_jax.types import Collect, Demos, Params, Rollout
from envs_jax import Env
from envs_jax.goals import GoalTask
from tests.meta.problems import random_demos, stacked

ALL = pytest.mark.parametrize("name", algorithms.names())
ENV = envs_jax.make("point2d", reward="dense", horizon=8, goal_radius=0.15)
# NumPy arrays, which JAX takes in the precision that a test asks for.
FAR = GoalTask(2.0 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]))  # type: ignore[arg-type]
NEAR = GoalTask(FAR.goal / 16)  # often reached in the first step
DEMOS = jax.tree.map(np.asarray, stacked([random_demos(m) for m in range(3)]))
OTHERS = jax.tree.map(np.asarray, stacked([random_demos(9 - m, 5, 5 - m) for m in range(3)]))
ORDER = np.array([2, 0, 1])
KEY = jax.random.key(7)


class Seeded(NamedTuple):
    """A task that brings its own random numbers, so that they stay with it."""

    task: GoalTask
    seed: jax.Array


SEEDED = Seeded(FAR, np.arange(3))  # type: ignore[arg-type]


def seeded_collector(env: Env, policy: Policy, *arguments: Any) -> Collect:
    collect = collector(env, policy, *arguments)

    def of_task(params: Params, key: jax.Array, task: Seeded) -> Rollout:
        return collect(params, jax.random.key(task.seed), task.task)

    return of_task


@cache
def learner(
    name: str,
    *,
    w_rl: float = 0.2,
    w_bc: float = 1.0,
    learning_rate: float = 0.1,
    warm_start_rate: float = 0.1,
    seeded: bool = False,
) -> MetaLearner:
    """A small learner; kept, so that it compiles once for all tests."""
    settings = Settings(
        w_rl=w_rl,
        w_bc=w_bc,
        policy=PolicySettings(hidden_sizes=[8]),
        adapt=AdaptSettings(
            num_episodes=4, learning_rate=learning_rate, warm_start_rate=warm_start_rate
        ),
        # At the default damping and 10 iterations, conjugate gradient on so small a problem loses
        # its orthogonality and makes rounding visible, in float64 too.
        meta=MetaSettings(fisher_every=2, damping=0.1, cg_iterations=5),
    )
    with pytest.MonkeyPatch.context() as patch:
        if seeded:
            patch.setattr(parts, "collector", seeded_collector)
        return algorithms.make(name, ENV, settings)


@pytest.fixture(autouse=True)
def _float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def start(name: str) -> MetaState:
    state = learner(name).init(jax.random.key(0))
    return jax.tree.map(jnp.float64, state)


def assert_equal(result: Any, expected: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, result, expected)


def assert_close(result: Any, expected: Any) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), result, expected)


def differ(a: Any, b: Any) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return any(not np.allclose(x, y, atol=1e-4) for x, y in pairs)


@ALL
def test_an_update_learns_something_and_reports_finite_numbers(name: str) -> None:
    with jax.enable_x64(False):
        fresh = learner.__wrapped__(name)  # not one with constants in float64
        before = fresh.init(jax.random.key(0))
        state, metrics = fresh.update(before, KEY, FAR, DEMOS)
    assert differ(state.params, before.params)
    for leaf in jax.tree.leaves((state.params, metrics)):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()


@ALL
def test_metrics_are_named_by_phase(name: str) -> None:
    _, metrics = learner(name).update(start(name), KEY, FAR, DEMOS)
    assert {metric.split("/")[0] for metric in metrics} == {"adapt", "outer"}
    stages = {metric.removeprefix("adapt/return_") for metric in metrics if "return_" in metric}
    assert stages == {str(k) for k in range(len(stages))}
    for what in ("success", "length", "diverged"):
        assert {f"adapt/{what}_{stage}" for stage in stages} <= metrics.keys()
    assert "outer/loss" in metrics
    assert all(value.shape == () for value in metrics.values())


@ALL
def test_the_same_key_gives_the_same_update_and_another_one_another(name: str) -> None:
    first, again, other = (
        learner(name).update(start(name), key, FAR, DEMOS) for key in (KEY, KEY, jax.random.key(8))
    )
    assert_equal(again, first)
    assert differ(other, first)


@ALL
def test_learners_side_by_side_do_what_each_does_alone(name: str) -> None:
    """They differ in their parameters, their keys and a number of their algorithm."""
    one, keys = learner(name), jax.random.split(KEY, 2)
    states = [jax.tree.map(jnp.float64, one.init(jax.random.key(seed))) for seed in range(2)]
    mesh = make_mesh(jax.devices()[:1], learners=2, tasks=3)
    both = side_by_side(lambda v: learner.__wrapped__(name, **v).halves, mesh)
    outer = OTHERS if algorithms.uses(name, "outer_demos") else None

    def together(rates: tuple[float, float]) -> list[Any]:
        values = {"learning_rate": np.array(rates)}
        found, metrics = both.update(stacked(states), keys, values, NEAR, DEMOS, outer)
        return [jax.tree.map(lambda x, k=k: x[k], (found.params, metrics)) for k in range(2)]

    for k, rates in enumerate([(0.1, 0.05), (0.05, 0.1)]):
        own, own_metrics = one.update(states[k], keys[k], NEAR, DEMOS, outer)  # its rate is 0.1
        found = together(rates)
        assert differ(own.params, states[k].params)
        assert_close(found[k], (own.params, own_metrics))
        assert differ(found[1 - k], together((0.1, 0.1))[1 - k])


@ALL
def test_a_second_update_compiles_nothing(name: str, caplog: pytest.LogCaptureFixture) -> None:
    update, state = learner(name).update, start(name)
    caplog.set_level(logging.WARNING, "jax")
    with jax.log_compiles(True):
        jax.jit(lambda x: x + 1)(jnp.ones(3))  # so that we know what would be seen
        assert "Compiling" in caplog.text
        state, _ = update(state, KEY, FAR, DEMOS)
        caplog.clear()
        update(state, jax.random.key(9), FAR, DEMOS)
    assert not [line for line in caplog.messages if "tracing" in line or "Compiling" in line]


@ALL
def test_all_products_are_asked_for_in_full_precision(name: str) -> None:
    """Or in what JAX's own setting says."""
    own = learner(name)

    def asked(wanted: str) -> bool:
        def iteration(state: MetaState) -> Any:
            keys = jax.random.split(KEY, 3)
            experience, _, _ = own.halves.gather(state.params, keys, FAR, DEMOS, None)
            sizes = jax.tree.map(lambda _: 32, experience, is_leaf=lambda x: isinstance(x, Rollout))
            return own.halves.improve(state, experience, DEMOS, None, sizes, None)

        text = str(jax.make_jaxpr(iteration)(start(name)))
        products = text.count("dot_general[")
        return products > 10 and products == text.count(f"precision=({wanted}, {wanted})")

    assert asked("Precision.HIGHEST")
    with jax.default_matmul_precision("default"):
        assert asked("Precision.DEFAULT")


@ALL
def test_leaving_out_what_comes_after_ends_changes_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []

    def spied(total: int, needed: int) -> int:
        sizes.append(bucket(total, needed))
        return sizes[-1]

    monkeypatch.setattr(learner_module, "bucket", spied)
    packed, metrics = learner(name).update(start(name), KEY, NEAR, DEMOS)
    if name != "meta_bc":  # which learns from no episode
        assert 3 < min(sizes) < 32  # of 4 episodes of 8 steps
    monkeypatch.setattr(learner_module, "BUCKETS", (1.0,))
    whole, whole_metrics = learner(name).update(start(name), KEY, NEAR, DEMOS)
    assert sizes[-1] == 32
    assert differ(whole.params, start(name).params)
    assert_close(packed.params, whole.params)
    assert_close(metrics, whole_metrics)


@ALL
def test_padding_of_demonstrations_changes_nothing(name: str) -> None:
    exists = DEMOS.mask[..., None] > 0
    assert not exists.all()
    changed = DEMOS._replace(
        obs=jnp.where(exists, DEMOS.obs, 30.0), action=jnp.where(exists, DEMOS.action, -30.0)
    )
    expected = learner(name).update(start(name), KEY, FAR, DEMOS)
    assert_equal(learner(name).update(start(name), KEY, FAR, changed), expected)


@ALL
def test_the_order_of_the_tasks_does_not_matter(name: str) -> None:
    meta = learner(name, seeded=True)
    tasks, demos = jax.tree.map(lambda x: x[ORDER], (SEEDED, DEMOS))
    expected, metrics = meta.update(start(name), KEY, SEEDED, DEMOS)
    result, permuted_metrics = meta.update(start(name), KEY, tasks, demos)
    assert_close(result.params, expected.params)
    assert_close(permuted_metrics, metrics)
    mixed, mixed_metrics = meta.update(start(name), KEY, tasks, DEMOS)
    # With a task's demonstrations at another task, the result is another one, if they count at all.
    counts = differ((mixed.params, mixed_metrics), (expected.params, metrics))
    assert counts == algorithms.takes_demonstrations(name)


@pytest.mark.parametrize("name", ["maml", "meta_bc", "gmps"])
def test_the_outer_loss_sees_its_own_demonstrations_if_any(name: str) -> None:
    expected = learner(name).update(start(name), KEY, FAR, DEMOS)
    assert_close(learner(name).update(start(name), KEY, FAR, DEMOS, DEMOS), expected)
    other, metrics = learner(name).update(start(name), KEY, FAR, DEMOS, OTHERS)
    assert metrics["adapt/return_0"] == expected[1]["adapt/return_0"]
    assert differ(other.params, expected[0].params) == algorithms.uses(name, "outer_demos")


@ALL
def test_tasks_adapt_independently(name: str) -> None:
    """In another order, with their keys and demonstrations, each comes out the same."""
    meta, params, keys = learner(name), start(name).params, jax.random.split(KEY, 3)
    collect = collector(ENV, meta.policy, 4, 0.95, 1.0)

    @jax.jit
    @jax.vmap
    def adapt(key: jax.Array, task: GoalTask, demos: Demos) -> Params:
        return meta.adapt(params, key, task, demos, collect).params

    adapted = adapt(keys, FAR, DEMOS)
    permuted = adapt(*jax.tree.map(lambda x: x[ORDER], (keys, FAR, DEMOS)))
    assert_close(permuted, jax.tree.map(lambda x: x[ORDER], adapted))
    assert differ(permuted, adapted)


def test_emrld_without_demonstrations_is_maml_bit_for_bit() -> None:
    plain, maml = learner("emrld", w_rl=1.0, w_bc=0.0), learner("maml")
    result = plain.update(start("maml"), KEY, FAR, DEMOS)
    expected = maml.update(start("maml"), KEY, FAR, DEMOS)
    assert_equal(result, expected)
    enhanced, _ = learner("emrld").update(start("maml"), KEY, FAR, DEMOS)
    assert differ(enhanced.params, expected[0].params)


def test_a_warm_start_of_rate_zero_adapts_as_emrld_does_on_the_same_episodes() -> None:
    emrld, warm = learner("emrld"), learner("emrld_ws", warm_start_rate=0.0)
    params = start("emrld").params
    task, demos = jax.tree.map(lambda x: x[0], (FAR, DEMOS))
    collect = collector(ENV, warm.policy, 4, 0.95, 1.0)
    adapted = warm.adapt(params, KEY, task, demos, collect)
    assert_equal(adapted.path[1], params)
    assert adapted.rollouts[0] is None
    stored = adapted.rollouts[1]
    assert stored is not None
    again = emrld.adapt(params, KEY, task, demos, lambda params, key, task: stored)
    assert_equal(again.params, adapted.params)
    assert differ(learner("emrld_ws").adapt(params, KEY, task, demos, collect).path[1], params)


def test_a_warm_start_of_rate_zero_learns_as_emrld_does() -> None:
    warm = learner("emrld_ws", warm_start_rate=0.0, seeded=True)
    result, _ = warm.update(start("emrld"), KEY, SEEDED, DEMOS)
    expected, _ = learner("emrld", seeded=True).update(start("emrld"), KEY, SEEDED, DEMOS)
    assert_close(result.params, expected.params)


def test_an_unknown_name_is_refused_with_a_hint() -> None:
    with pytest.raises(ValueError, match=r"'mamll' is unknown \(there are: .*maml"):
        algorithms.make("mamll", ENV, Settings())
