"""What a run works with, made from its configuration: demonstrations, environment, algorithm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from emrld_jax import algorithms
from emrld_jax.demos import DemoFile, load, resolve
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.runs.config import (
    ConfigError,
    TrainConfig,
    algorithm_settings,
    default_w_rl,
    make_env,
)
from envs_jax import Env


class Setup(NamedTuple):
    """What a run works with."""

    config: TrainConfig  # with nothing left open
    demos_path: Path
    demos: DemoFile
    env: Env
    learner: MetaLearner


def set_up(config: TrainConfig) -> Setup:
    """Loads the demonstrations and assembles the algorithm.

    Raises:
        ConfigError, DemoError: settings or demonstrations are refused.
    """
    try:
        env = make_env(config.env)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    path = resolve(config.demos, config.env.name)
    demos = load(path, env)
    if config.demos not in QUALITIES:
        config = replace(config, demos=str(path.absolute()))  # valid from any working directory
    if config.w_rl is None:
        config = replace(config, w_rl=default_w_rl(demos.quality))
    learner = algorithms.make(config.algo, env, algorithm_settings(config))
    return Setup(config, path, demos, env, learner)
