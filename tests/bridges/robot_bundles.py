"""Bundles of policies simple enough to know what they do."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from bridges.bundle import Bundle, Network, Stage
from bridges.environments import described, described_task, zone
from bridges.learning import learning
from bridges.parameters import tensors_of
from emrld_jax import algorithms
from emrld_jax.meta.staged import adapt_with
from emrld_jax.settings import AdaptSettings, PolicySettings, Settings
from envs_jax import Env

HALF = float(np.log(0.5))


def constant(
    action: tuple[float, float],
    log_std: float = HALF,
    name: str = "two_wheeled",
    task: int = 0,
    **adapt: Any,
) -> Bundle:
    """Always the same mean action, in policy units; of two_wheeled's task 0 the goal is ahead."""
    policy = PolicySettings(hidden_sizes=[])
    settings = Settings(policy=policy, adapt=AdaptSettings(**adapt))
    params = {"layer_0": {"kernel": np.zeros((3, 2)), "bias": np.array(action)}}
    return _bundle(
        envs_jax.make(name), task, "emrld", settings, {"params": params}, np.full(2, log_std)
    )


def of_point2d() -> Bundle:
    """A policy that moves a point."""
    settings = Settings(policy=PolicySettings(hidden_sizes=[]))
    params = {"layer_0": {"kernel": np.zeros((2, 2)), "bias": np.zeros(2)}}
    env = envs_jax.make("point2d")
    return _bundle(env, 0, "emrld", settings, {"params": params}, np.full(2, HALF))


def that_breaks(x: float) -> Bundle:
    """Drives ahead as `constant` does, until its numbers overflow at this x (m)."""
    layers, most = 10, 3e38
    settings = Settings(policy=PolicySettings(hidden_sizes=[2] * layers, activation="relu"))
    first = np.zeros((3, 2))
    first[0] = 1.0
    params = {"layer_0": {"kernel": first, "bias": np.full(2, -x)}}
    for k in range(1, layers):
        params[f"layer_{k}"] = {"kernel": np.diag([most, most]), "bias": np.zeros(2)}
    last = np.array([[1.0, 0.0], [-1.0, 0.0]])  # infinity less infinity
    params[f"layer_{layers}"] = {"kernel": last, "bias": np.array([1.0, 0.0])}
    env = envs_jax.make("two_wheeled")
    return _bundle(env, 0, "emrld", settings, {"params": params}, np.full(2, -4.0))


def in_arena(arena: float, horizon: int = 100) -> Bundle:
    """Drives ahead in an arena of this half width (m)."""
    bundle = constant((1.0, 0.0), log_std=-4.0)
    assert bundle.zone is not None
    return replace(bundle, zone=bundle.zone._replace(arena=arena, horizon=horizon))


def collecting(algorithm: str, **adapt: Any) -> Bundle:
    """A small random network that collects its first episodes, with reward everywhere."""
    policy = PolicySettings(hidden_sizes=[8, 8], activation="tanh", std=0.5)
    settings = Settings(policy=policy, adapt=AdaptSettings(**adapt))
    env = envs_jax.make("two_wheeled", reward="dense", horizon=30)
    params = algorithms.make(algorithm, env, settings).init(jax.random.key(3)).params
    bundle = _bundle(env, 3, algorithm, settings, params, np.full(2, HALF))
    parts = learning(bundle)
    now = adapt_with(parts.learner, parts.params, parts.task, parts.demos, ()).params
    return replace(
        bundle, tensors={**bundle.tensors, **tensors_of(now, np.full(2, HALF), "policy")}
    )


def _bundle(
    env: Env, task: int, algorithm: str, settings: Settings, params: Any, log_std: np.ndarray
) -> Bundle:
    one = jax.tree.map(lambda x: x[task], env.train_tasks())
    environment, observation, action = described(env)
    generator = np.random.default_rng(0)
    shown = {
        "demos/obs": jnp.asarray(generator.uniform(-1, 1, (12, env.observation_size)), jnp.float32),
        "demos/action": jnp.asarray(generator.uniform(-1, 1, (12, 2)), jnp.float32),
    }
    net = settings.policy
    return Bundle(
        environment=environment,
        task=described_task(one),
        zone=zone(env, one),
        observation=observation,
        action=action,
        control_period=env.dt,
        policy=Network(list(net.hidden_sizes), net.activation, net.squash),
        algorithm=algorithm,
        settings=asdict(settings),
        seed=0,
        stage=Stage(0, False),
        provenance={"test": "made by hand"},
        tensors={
            **tensors_of(params, log_std, "policy"),
            **tensors_of(params, log_std, "meta"),
            **{name: np.asarray(value) for name, value in shown.items()},
        },
    )
