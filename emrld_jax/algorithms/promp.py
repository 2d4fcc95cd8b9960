"""ProMP: proximal meta-policy search (Rothfuss et al. 2019)."""

from __future__ import annotations

from emrld_jax.algorithms.parts import learner, on_policy_steps
from emrld_jax.meta.gradient import adam
from emrld_jax.meta.inner import likelihood_ratio
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.meta.outer_losses import clipped_surrogate
from emrld_jax.settings import Settings
from envs_jax import Env


def promp(env: Env, settings: Settings) -> MetaLearner:
    """Likelihood ratios adapt; steps of Adam on a clipped surrogate with a KL penalty learn."""
    meta = settings.meta
    steps = on_policy_steps(likelihood_ratio(), settings)
    optimizer = adam(meta.learning_rate, meta.gradient_steps)
    return learner(env, settings, steps, clipped_surrogate(meta.clip, meta.kl_penalty), optimizer)
