"""EMRLD: demonstrations and the policy gradient adapt, TRPO learns (Rengarajan et al. 2022)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps, trust_region
from emrld_jax.meta.inner import enhanced_loss
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import adapted_surrogate
from emrld_jax.settings import Settings
from envs_jax import Env


def emrld(env: Env, settings: Settings) -> MetaLearner:
    """Each inner step descends on w_rl * policy gradient + w_bc * demonstrations."""
    steps = on_policy_steps(enhanced_loss(settings.w_rl, settings.w_bc), settings)
    return learner(env, settings, steps, adapted_surrogate(), trust_region(settings))
