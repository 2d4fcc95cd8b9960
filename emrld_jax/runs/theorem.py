"""What `diagnostics=true` adds to a run's metrics: each iteration beside Theorem 3.2."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from emrld_jax.demos import replayed
from emrld_jax.meta.diagnostics import Estimation, Shown, diagnose
from emrld_jax.meta.outer import Metrics
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.setup import Setup, learner_with
from emrld_jax.sampling.rollouts import collector
from emrld_jax.settings import with_values
from emrld_jax.types import Params, Task

STREAM = 3  # folded into a run's key; training's own keys are its first three parts

# (parameters before [K], after [K], the runs' key data [K], iteration): metrics of each run
Diagnosis = Callable[[Params, Params, np.ndarray, int], list[dict[str, float]]]


def diagnosis(
    setups: Sequence[Setup], values: Mapping[str, np.ndarray], devices: Sequence[jax.Device]
) -> Diagnosis:
    """Measures iterations of runs; a number that is not finite is left out of its metrics.

    Args:
        setups: of the runs.
        values: [K] of each number that they differ in.
        devices: that train; must be one.

    Raises:
        ConfigError: there are several devices.
    """
    if len(devices) > 1:
        raise ConfigError(
            f"diagnostics=true is for one device, and these are {len(devices)}: give devices=1 "
            "processes=1, or diagnostics=false (num_seeds and vmap may be given)"
        )
    shared, part = setups[0], setups[0].demos.train
    shown = Shown(part.demos, replayed(shared.env, part.tasks, part.demos))
    measured = _measuring(shared)

    def diagnosed(
        old: Params, new: Params, keys: np.ndarray, iteration: int
    ) -> list[dict[str, float]]:
        told = measured(dict(values), old, new, keys, iteration, part.tasks, shown)
        columns = {name: column.tolist() for name, column in jax.device_get(told).items()}
        return [
            {name: column[k] for name, column in columns.items() if math.isfinite(column[k])}
            for k in range(len(keys))
        ]

    return diagnosed


def _measuring(shared: Setup) -> Callable[..., Metrics]:
    """What measures runs side by side, [K] of each metric; compiled.

    Called with values [K], parameters before and after [K], key data [K], the iteration, tasks and
    what is shown of them.
    """

    @jax.jit
    def measured(
        values: Mapping[str, Any],
        old: Params,
        new: Params,
        keys: jax.Array,
        i: int,
        tasks: Task,
        shown: Shown,
    ) -> Metrics:
        def one(values: Mapping[str, Any], old: Params, new: Params, key: jax.Array) -> Metrics:
            own = jax.random.fold_in(jax.random.fold_in(jax.random.wrap_key_data(key), STREAM), i)
            learner, settings = learner_with(shared, values), with_values(shared.config, values)
            adapt, env = settings.adapt, shared.env
            how = Estimation(adapt.discount, adapt.gae_lambda, env.horizon)
            collect = collector(
                env, learner.policy, adapt.num_episodes, adapt.discount, adapt.gae_lambda
            )
            return diagnose(learner, collect, how, old, new, own, tasks, shown)

        # at once, also on a CPU: a simulator that is called steps all runs in one call
        return jax.vmap(one)(values, old, new, keys)

    return measured
