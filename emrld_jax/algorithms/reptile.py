"""Reptile: the meta-parameters follow the adapted ones (Nichol et al. 2018)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps
from emrld_jax.meta.gradient import sgd
from emrld_jax.meta.inner import policy_gradient
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import distance_to_adapted
from emrld_jax.settings import Settings
from envs_jax import Env


def reptile(env: Env, settings: Settings) -> MetaLearner:
    """The policy gradient adapts; the meta-parameters go a part of the mean way there."""
    steps = on_policy_steps(policy_gradient(), settings)
    return learner(env, settings, steps, distance_to_adapted(), sgd(settings.meta.learning_rate))
