"""The parts that all algorithms share, made from settings."""

from __future__ import annotations

from emrld_jax.meta.adaptation import InnerSteps
from emrld_jax.meta.inner import InnerLoss, InnerStep, demonstrations
from emrld_jax.meta.learner import MetaLearner, meta_learner
from emrld_jax.meta.outer import OuterLoss, OuterOptimizer
from emrld_jax.meta.trpo import trpo
from emrld_jax.policy import gaussian_policy
from emrld_jax.sampling.rollouts import collector
from emrld_jax.settings import Settings
from envs_jax import Env


def on_policy_steps(loss: InnerLoss, settings: Settings) -> InnerSteps:
    """`adapt.num_steps` inner steps on this loss, each on its own episodes."""
    adapt = settings.adapt
    step = InnerStep(loss, adapt.learning_rate, on_policy=True, first_order=adapt.first_order)
    return (step,) * adapt.num_steps


def demonstration_steps(settings: Settings) -> InnerSteps:
    """`adapt.num_steps` inner steps on the demonstrations alone; they collect no episodes."""
    adapt = settings.adapt
    step = InnerStep(demonstrations(), adapt.learning_rate, False, adapt.first_order)
    return (step,) * adapt.num_steps


def learner(
    env: Env,
    settings: Settings,
    inner_steps: InnerSteps,
    outer_loss: OuterLoss,
    optimizer: OuterOptimizer,
) -> MetaLearner:
    """A meta-learner with the settings' policy, which collects in the environment."""
    adapt, net = settings.adapt, settings.policy
    policy = gaussian_policy(
        env.observation_size,
        env.action_size,
        hidden_sizes=net.hidden_sizes,
        activation=net.activation,
        std=net.std,
        output_scale=net.output_scale,
        start_at_zero=net.start_at_zero,
        squash=net.squash,
        learn_std=net.learn_std,
    )
    return meta_learner(
        policy,
        inner_steps,
        collector(env, policy, adapt.num_episodes, adapt.discount, adapt.gae_lambda),
        outer_loss,
        optimizer,
        curvature_every=settings.meta.fisher_every,
    )


def trust_region(settings: Settings) -> OuterOptimizer:
    """TRPO as the settings say."""
    meta = settings.meta
    return trpo(
        max_kl=meta.max_kl,
        cg_iterations=meta.cg_iterations,
        damping=meta.damping,
        backtrack_ratio=meta.backtrack_ratio,
        max_backtracks=meta.max_backtracks,
    )
