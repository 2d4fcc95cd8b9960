"""GMPS: the policy gradient adapts, demonstrations meta-learn (Mendonca et al. 2019)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps
from emrld_jax.meta.gradient import adam
from emrld_jax.meta.inner import policy_gradient
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import adapted_demonstrations
from emrld_jax.settings import Settings
from envs_jax import Env


def gmps(env: Env, settings: Settings) -> MetaLearner:
    """Each inner step descends on the policy gradient; Adam clones at the adapted parameters."""
    steps = on_policy_steps(policy_gradient(), settings)
    optimizer = adam(settings.meta.learning_rate)
    return learner(env, settings, steps, adapted_demonstrations(), optimizer)
