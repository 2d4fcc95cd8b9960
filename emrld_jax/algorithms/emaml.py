"""E-MAML: MAML that learns what to collect, too (Stadie et al. 2018)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps, trust_region
from emrld_jax.meta.inner import policy_gradient
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import exploring_surrogate
from emrld_jax.settings import Settings
from envs_jax import Env


def emaml(env: Env, settings: Settings) -> MetaLearner:
    """The policy gradient adapts; TRPO's surrogate credits what was collected before it."""
    steps = on_policy_steps(policy_gradient(), settings)
    return learner(env, settings, steps, exploring_surrogate(), trust_region(settings))
