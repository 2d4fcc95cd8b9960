"""Meta-BC: demonstrations adapt and meta-learn (meta-imitation learning, Finn et al. 2017b)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import demonstration_steps, learner
from emrld_jax.meta.gradient import adam
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import adapted_demonstrations
from emrld_jax.settings import Settings
from envs_jax import Env


def meta_bc(env: Env, settings: Settings) -> MetaLearner:
    """Each inner step clones the demonstration; so does Adam, at the adapted parameters.

    No episode is learned from: those that are collected show how well adapted policies do.
    """
    steps = demonstration_steps(settings)
    optimizer = adam(settings.meta.learning_rate)
    return learner(env, settings, steps, adapted_demonstrations(), optimizer)
