"""EMRLD-WS: EMRLD after a warm start on the demonstrations alone (Rengarajan et al. 2022)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps, trust_region
from emrld_jax.meta.inner import InnerStep, demonstrations, enhanced_loss
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import adapted_surrogate
from emrld_jax.settings import Settings
from envs_jax import Env


def emrld_ws(env: Env, settings: Settings) -> MetaLearner:
    """A demonstrations-only step of weight 1, then EMRLD's steps.

    These use the warm-started policy's episodes. The meta-gradient goes through all steps.
    """
    adapt = settings.adapt
    warm_start = InnerStep(demonstrations(), adapt.warm_start_rate, False, adapt.first_order)
    steps = on_policy_steps(enhanced_loss(settings.w_rl, settings.w_bc), settings)
    return learner(env, settings, (warm_start, *steps), adapted_surrogate(), trust_region(settings))
