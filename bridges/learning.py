"""The algorithm that trained a bundle's policy, with all that it adapts with."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from bridges.bundle import Bundle
from bridges.environments import environment_of, task_of
from bridges.messages import BridgeError
from bridges.parameters import params_of
from emrld_jax import algorithms
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.settings import AdaptSettings, MetaSettings, PolicySettings, Settings
from emrld_jax.types import Demos, Params
from envs_jax import Env


class Learning(NamedTuple):
    """What `emrld_jax.meta.staged.adapt_with` takes, but for the episodes."""

    env: Env
    settings: Settings
    learner: MetaLearner
    params: Params  # the meta-parameters
    task: Any
    demos: Demos  # [N, ..]


def learning(bundle: Bundle) -> Learning:
    """Assembles what a bundle's policy was trained with.

    Raises:
        BridgeError: this version has no such environment, algorithm or settings.
    """
    env = environment_of(bundle)
    try:
        settings = _settings(bundle.settings)
        learner = algorithms.make(bundle.algorithm, env, settings)
    except (TypeError, KeyError, ValueError) as error:
        raise BridgeError(
            f"the bundle's algorithm cannot be assembled by this version: {error}"
        ) from error
    obs, action = (jnp.asarray(bundle.tensors[f"demos/{name}"]) for name in ("obs", "action"))
    demos = Demos(obs, action, jnp.ones(obs.shape[0]))
    return Learning(env, settings, learner, params_of(bundle, "meta"), task_of(bundle, env), demos)


def _settings(values: dict[str, Any]) -> Settings:
    sections = {"policy": PolicySettings, "adapt": AdaptSettings, "meta": MetaSettings}
    made = {name: kind(**values[name]) for name, kind in sections.items()}
    return Settings(**{**values, **made})
