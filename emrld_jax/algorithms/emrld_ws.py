"""EMRLD-WS: EMRLD after a warm start on the demonstrations alone (Rengarajan et al. 2022)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import on_policy_steps, trpo_learner
from emrld_jax.meta.inner import InnerStep, enhanced_loss
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.settings import Settings
from envs_jax import Env


def emrld_ws(env: Env, settings: Settings) -> MetaLearner:
    """A demonstrations-only step of weight 1, then EMRLD's steps.

    These use the warm-started policy's episodes. The meta-gradient goes through all steps.
    """
    adapt = settings.adapt
    warm_start = InnerStep(
        enhanced_loss(w_rl=0.0, w_bc=1.0),
        adapt.warm_start_rate,
        on_policy=False,
        first_order=adapt.first_order,
    )
    loss = enhanced_loss(settings.w_rl, settings.w_bc)
    return trpo_learner(env, settings, (warm_start, *on_policy_steps(loss, settings)))
