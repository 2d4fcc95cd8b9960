"""The meta-learner's loop, on episodes that are written down instead of simulated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emrld_jax.meta import learner as learner_module
from emrld_jax.meta.inner import InnerStep, enhanced_loss
from emrld_jax.meta.learner import BUCKETS, MetaLearner, bucket, meta_learner
from emrld_jax.meta.outer_losses import adapted_surrogate
from emrld_jax.meta.trpo import trpo
from emrld_jax.policy import Policy, gaussian_policy
from emrld_jax.types import Gaussian, Params, Rollout, Trajectory
from tests.meta.problems import random_demos, stacked

EPISODES, HORIZON = 4, 10


def canned(lengths: tuple[int, ...], seed: int = 0) -> Rollout:
    """Episodes of these lengths, [E, T, ..]: rewards 1 a step, those of even number successful."""
    rng = np.random.default_rng(seed)
    shape = (len(lengths), HORIZON)
    mask = (np.arange(HORIZON) < np.array(lengths)[:, None]).astype(np.float32)
    last = np.arange(HORIZON) == np.array(lengths)[:, None] - 1
    success = last & (np.arange(len(lengths)) % 2 == 0)[:, None]
    obs, action = (jnp.asarray(rng.normal(size=(*shape, 2)), jnp.float32) for _ in range(2))
    advantage = jnp.asarray(rng.normal(size=shape) * mask, jnp.float32)
    zero = np.zeros(shape)
    fields = (np.ones(shape), last, success, last, mask, zero)
    numbers = [jnp.asarray(x, jnp.float32) for x in fields]
    return Rollout(Trajectory(obs, action, *numbers), advantage)


@pytest.mark.parametrize(
    ("needed", "size"),
    [(1, 5), (5, 5), (6, 10), (15, 15), (16, 20), (21, 30), (31, 40), (40, 40)],
)
def test_the_bucket_is_the_smallest_that_holds_what_is_needed(
    needed: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_module, "BUCKETS", (0.125, 0.25, 0.375, 0.5, 0.75, 1.0))
    assert bucket(EPISODES * HORIZON, needed) == size


@pytest.mark.parametrize("total", [1, 3, 7])
def test_all_steps_fit_whatever_the_size(total: int) -> None:
    assert bucket(total, total) == total


def test_what_is_needed_is_that_of_the_longest_task() -> None:
    """Of outer episodes all steps that exist, of inner ones those that have an advantage."""
    sets = stacked([canned((1, 0, 0, 0)), canned((10, 4, 2, 0))])
    idle = sets._replace(advantage=sets.advantage.at[:, 0].set(0.0))  # each first episode

    def collect(params: Params, key: jax.Array, task: jax.Array) -> Rollout:
        return jax.tree.map(lambda x: x[task], idle)

    meta = learner(small_policy(), collect)
    demos = stacked([random_demos(m) for m in range(2)])
    keys, params = jax.random.split(jax.random.key(1)), meta.init(jax.random.key(0)).params
    gathered = jax.jit(meta.halves.gather, static_argnums=4)(
        params, keys, jnp.array([0, 1]), demos, None
    )
    assert int(gathered.needed.inner[0]) == 4 + 2
    assert int(gathered.needed.outer) == 10 + 4 + 2


def test_buckets_rise_to_all_steps() -> None:
    assert list(BUCKETS) == sorted(set(BUCKETS))
    assert BUCKETS[-1] == 1.0


def learner(
    policy: Policy, collect: Callable[[Params, jax.Array, Any], Rollout], on_policy: bool = True
) -> MetaLearner:
    step = InnerStep(enhanced_loss(0.5, 1.0), 0.1, on_policy, first_order=False)
    return meta_learner(
        policy,
        (step,),
        collect,
        adapted_surrogate(),
        trpo(),
    )


def small_policy() -> Policy:
    return gaussian_policy(2, 2, hidden_sizes=(8,))


def test_metrics_are_means_over_tasks_and_episodes() -> None:
    """The task is which of two sets of episodes is collected."""
    sets = stacked([canned((10, 4, 2, 8)), canned((1, 1, 1, 1)), canned((9, 9, 9, 1))])

    def collect(params: Params, key: jax.Array, task: jax.Array) -> Rollout:
        return jax.tree.map(lambda x: x[task], sets)

    demos = stacked([random_demos(m) for m in range(2)])
    meta = learner(small_policy(), collect)
    state, key = meta.init(jax.random.key(0)), jax.random.key(1)
    _, metrics = meta.update(state, key, jnp.array([0, 1]), demos)
    for stage in (0, 1):
        np.testing.assert_allclose(metrics[f"adapt/return_{stage}"], (24 + 4) / 8)
        np.testing.assert_allclose(metrics[f"adapt/length_{stage}"], (24 + 4) / 8)
        np.testing.assert_allclose(metrics[f"adapt/success_{stage}"], 0.5)
        np.testing.assert_allclose(metrics[f"adapt/diverged_{stage}"], 1.0)  # all, says `canned`
    assert "adapt/return_2" not in metrics


def test_a_step_without_episodes_has_no_stage_of_its_own() -> None:
    demos = stacked([random_demos(0)])
    meta = learner(small_policy(), lambda params, key, task: canned((3, 3)), on_policy=False)
    state = meta.init(jax.random.key(0))
    _, metrics = meta.update(state, jax.random.key(1), jnp.zeros(1), demos)
    stages = {name for name in metrics if name.startswith("adapt/return")}
    assert stages == {"adapt/return_0"}


def test_outer_episodes_are_the_adapted_policys_and_keys_are_never_reused() -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def record(weights: np.ndarray, key_data: np.ndarray) -> None:
        seen.append((np.asarray(weights), np.asarray(key_data)))

    def collect(params: Params, key: jax.Array, task: jax.Array) -> Rollout:
        weights = params["params"]["layer_0"]["kernel"]
        jax.debug.callback(record, weights, jax.random.key_data(key), ordered=False)
        return canned((3, 5, 10, 1))

    demos = stacked([random_demos(m) for m in range(3)])
    meta = learner(small_policy(), collect)
    state, task = meta.init(jax.random.key(0)), jnp.zeros(())
    own = jax.tree.map(lambda x: x[1], demos)
    adapted = meta.adapt(state.params, jax.random.key(5), task, own, collect)
    jax.effects_barrier()
    seen.clear()
    meta.update(state, jax.random.key(1), jnp.zeros(3), demos)
    jax.effects_barrier()

    start = np.asarray(state.params["params"]["layer_0"]["kernel"])
    assert len(seen) == 6  # three tasks, before and after the adaptation
    assert sum(np.array_equal(weights, start) for weights, _ in seen) == 3
    end = np.asarray(adapted.params["params"]["layer_0"]["kernel"])
    assert sum(np.allclose(weights, end, atol=1e-6) for weights, _ in seen) == 1
    assert len({tuple(key_data.tolist()) for _, key_data in seen}) == 6


def test_a_second_update_traces_nothing_again() -> None:
    policy, traces = small_policy(), []

    def counting(params: Params, obs: jax.Array) -> Gaussian:
        traces.append(obs.shape)
        return policy.apply(params, obs)

    demos = stacked([random_demos(m) for m in range(2)])
    meta = learner(Policy(policy.init, counting), lambda params, key, task: canned((10, 4, 2, 8)))
    state = meta.init(jax.random.key(0))
    state, _ = meta.update(state, jax.random.key(1), jnp.zeros(2), demos)
    number = len(traces)
    assert number > 0
    meta.update(state, jax.random.key(2), jnp.ones(2), demos)
    assert len(traces) == number
