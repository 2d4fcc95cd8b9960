"""The runs of one program: their own configurations, and the numbers that they differ in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from emrld_jax.runs.config import (
    VARIED,
    DistributedSettings,
    TrainConfig,
    algorithm_settings,
)
from emrld_jax.runs.usage import leaves
from emrld_jax.settings import value, with_values


class Variant(NamedTuple):
    """One of the runs that a command trains."""

    label: str  # the numbers that tell it from others of its seed, such as w_rl=0.4; may be empty
    config: TrainConfig  # as if it was the only one


def variants(config: TrainConfig) -> list[Variant]:
    """A run for each combination of the values of `vmap`, and each seed."""
    seeds = range(config.seed, config.seed + config.num_seeds)
    made = []
    for combination in product(*config.vmap.values()):
        values = dict(zip(config.vmap, combination, strict=True))
        label = ",".join(f"{name}={number:g}" for name, number in values.items())
        for seed in seeds:
            made.append(Variant(label, with_values(alone(config), {**values, "seed": seed})))
    return made


def alone(config: TrainConfig) -> TrainConfig:
    """What is kept of a configuration with a run: nothing of its neighbors, or where it ran."""
    return replace(
        config,
        num_seeds=1,
        vmap={},
        resume=None,
        devices="1",
        processes=1,
        distributed=DistributedSettings(),
    )


def other_setting(first: TrainConfig, second: TrainConfig) -> str | None:
    """The first setting that two runs of one program may not differ in, but do."""
    free = {*VARIED, "seed", "runs"}
    names = [name for name in leaves(first) if name not in free]
    return next((name for name in names if value(first, name) != value(second, name)), None)


def differences(configs: Sequence[TrainConfig]) -> dict[str, np.ndarray]:
    """Values [K] of the numbers that the runs differ in."""
    own = [algorithm_settings(config) for config in configs]
    values = {name: [value(settings, name) for settings in own] for name in VARIED}
    return {
        name: np.array(column, np.float32)
        for name, column in values.items()
        if len(set(column)) > 1
    }
