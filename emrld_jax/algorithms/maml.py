"""MAML: the policy gradient adapts, TRPO meta-learns; no demonstrations (Finn et al. 2017)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps, trust_region
from emrld_jax.meta.inner import policy_gradient
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import adapted_surrogate
from emrld_jax.settings import Settings
from envs_jax import Env


def maml(env: Env, settings: Settings) -> MetaLearner:
    """Each inner step descends on the policy gradient alone."""
    steps = on_policy_steps(policy_gradient(), settings)
    return learner(env, settings, steps, adapted_surrogate(), trust_region(settings))
