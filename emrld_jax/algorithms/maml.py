"""MAML: the policy gradient adapts, TRPO meta-learns; no demonstrations (Finn et al. 2017)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import on_policy_steps, trpo_learner
from emrld_jax.meta.inner import enhanced_loss
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.settings import Settings
from envs_jax import Env


def maml(env: Env, settings: Settings) -> MetaLearner:
    """Each inner step descends on the policy gradient alone."""
    return trpo_learner(env, settings, on_policy_steps(enhanced_loss(w_rl=1.0, w_bc=0.0), settings))
