"""Adaptation in stages: that which collects by itself, cut where episodes are missing."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

import envs_jax
from emrld_jax import algorithms
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.staged import adapt_with
from emrld_jax.policy import log_prob, sample
from emrld_jax.settings import AdaptSettings, PolicySettings, Settings
from emrld_jax.types import Collect, Params, Rollout, Task
from tests.meta.problems import random_demos, random_rollout

ENV = envs_jax.make("point2d", horizon=8)
TASK = jax.tree.map(lambda x: x[0], ENV.train_tasks())
# of algorithms with so many inner steps, the parameters on the way that wait for episodes
WAITING = {"emrld": (1, [0]), "emrld_ws": (2, [1, 2]), "meta_bc": (2, [])}


def learner_and_params(name: str) -> tuple[MetaLearner, Params]:
    adapt = AdaptSettings(
        num_steps=WAITING[name][0], num_episodes=4, learning_rate=0.1, warm_start_rate=0.1
    )
    settings = Settings(policy=PolicySettings(hidden_sizes=[8]), adapt=adapt)
    learner = algorithms.make(name, ENV, settings)
    return learner, learner.init(jax.random.key(0)).params


def acting(learner: MetaLearner) -> Collect:
    """Collects what the policy does at random observations, for random advantages."""

    def collect(params: Params, key: jax.Array, task: Task) -> Rollout:
        rollout = random_rollout(0)
        gaussian = learner.policy.apply(params, rollout.trajectory.obs)
        action = sample(gaussian, jax.random.normal(key, gaussian.mean.shape))
        density = log_prob(gaussian, action)
        return rollout._replace(
            trajectory=rollout.trajectory._replace(action=action, log_prob=density)
        )

    return collect


def assert_close(result: Any, expected: Any) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), result, expected)


def differ(a: Any, b: Any) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return any(not np.allclose(x, y, atol=1e-4) for x, y in pairs)


@pytest.mark.parametrize("name", WAITING)
def test_every_stage_is_on_the_way_of_the_whole_adaptation(name: str) -> None:
    (learner, params), demos = learner_and_params(name), random_demos(0)
    whole = learner.adapt(params, jax.random.key(5), TASK, demos, acting(learner))
    rollouts = [rollout for rollout in whole.rollouts if rollout is not None]
    assert len(rollouts) == len(WAITING[name][1])
    assert all(differ(*pair) for pair in zip(whole.path[:-1], whole.path[1:], strict=True))

    for used, place in enumerate(WAITING[name][1]):
        staged = adapt_with(learner, params, TASK, demos, rollouts[:used])
        assert (staged.adapted, staged.used) == (False, used)
        assert_close(staged.params, whole.path[place])
    staged = adapt_with(learner, params, TASK, demos, rollouts)
    assert (staged.adapted, staged.used) == (True, len(rollouts))
    assert_close(staged.params, whole.params)


@pytest.mark.parametrize(("name", "taken"), [("emrld", 1), ("meta_bc", 0)])
def test_episodes_that_no_step_takes_are_refused(name: str, taken: int) -> None:
    (learner, params), demos = learner_and_params(name), random_demos(0)
    with pytest.raises(ValueError, match=f"of {taken} steps, not of 3"):
        adapt_with(learner, params, TASK, demos, [random_rollout(0)] * 3)
