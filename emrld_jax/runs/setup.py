"""What a run works with, made from its configuration: demonstrations, environment, algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from emrld_jax import algorithms
from emrld_jax.demos import DemoError, DemoFile, check_same_tasks, load, resolve
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.runs.config import (
    ConfigError,
    EnvSettings,
    TrainConfig,
    algorithm_settings,
    default_w_rl,
    make_env,
)
from emrld_jax.settings import with_values
from emrld_jax.types import Demos, OuterDemos
from envs_jax import Env
from envs_jax.half_cheetah import HalfCheetah
from envs_jax.physics import resolve_backend


class Setup(NamedTuple):
    """What a run works with."""

    config: TrainConfig  # with nothing left open
    demos_path: Path
    demos: DemoFile
    env: Env
    learner: MetaLearner
    outer_path: Path | None  # of the outer loss's own demonstrations; None: it has none
    outer_demos: OuterDemos  # those of the training tasks, [M, ..]


def set_up(config: TrainConfig) -> Setup:
    """Loads the demonstrations and assembles the algorithm.

    Raises:
        ConfigError, DemoError: settings or demonstrations are refused.
    """
    try:
        config = replace(config, env=_resolved(config.env))
        env = make_env(config.env)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    path = resolve(config.demos, config.env.name)
    demos = load(path, env)
    config = replace(config, demos=_from_anywhere(config.demos, path))
    if config.w_rl is None:
        config = replace(config, w_rl=default_w_rl(demos.quality))
    outer_path, outer_demos = None, None
    if config.outer_demos is not None:
        outer_path = resolve(config.outer_demos, config.env.name, "outer_demos")
        outer_demos = _outer(outer_path, env, demos)
        config = replace(config, outer_demos=_from_anywhere(config.outer_demos, outer_path))
    learner = _learner(config, env, {})
    return Setup(config, path, demos, env, learner, outer_path, outer_demos)


def _from_anywhere(demos: str, path: Path) -> str:
    """What names these demonstrations from any working directory."""
    return demos if demos in QUALITIES else str(path.absolute())


def _outer(path: Path, env: Env, demos: DemoFile) -> Demos:
    """The outer loss's own demonstrations, of the tasks that the others are of."""
    file = load(path, env)
    try:
        check_same_tasks(file, demos, "demos")
    except DemoError as error:
        raise DemoError(f"outer_demos={path}: {error}") from error
    return file.train.demos


def _resolved(settings: EnvSettings) -> EnvSettings:
    """With the physics that this machine chooses, if any: a run goes on with what it began with."""
    env = make_env(settings)
    if not isinstance(env, HalfCheetah):
        return settings
    return replace(
        settings,
        backend=resolve_backend(env.backend),
        mjx_iterations=env.mjx_iterations,
        mjx_line_search=env.mjx_line_search,
    )


def with_config(setup: Setup, config: TrainConfig) -> Setup:
    """The same work with other numbers of the algorithm, or another seed."""
    return setup._replace(config=config, learner=_learner(config, setup.env, {}))


def learner_with(setup: Setup, values: Mapping[str, Any]) -> MetaLearner:
    """The algorithm with these numbers, by full name, in place of its own; they may be traced."""
    return _learner(setup.config, setup.env, values)


def _learner(config: TrainConfig, env: Env, values: Mapping[str, Any]) -> MetaLearner:
    return algorithms.make(config.algo, env, with_values(algorithm_settings(config), values))
