"""From recordings to an adapted bundle, by the very adaptation that simulation has.

This is the one part of the robot's loop that needs JAX; a recording is a folder that can be copied.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bridges.bundle import Bundle, Stage
from bridges.driving import log_prob
from bridges.episodes import Episode
from bridges.learning import Learning, learning
from bridges.messages import BridgeError
from bridges.parameters import tensors_of
from bridges.policy import Policy
from bridges.recording import Recording, whole_episodes
from bridges.stages import after_step, collectors
from emrld_jax.meta.staged import adapt_with
from emrld_jax.sampling.advantages import advantages
from emrld_jax.types import Rollout, Trajectory

TOLERANCE = 1e-3  # of log-densities: what rounding in float32 may do


class AdaptError(BridgeError):
    """Adaptation is refused; the message says why."""


def adapted(bundle: Bundle, recordings: Sequence[Recording]) -> Bundle:
    """The bundle after the inner steps that these recordings are of.

    Args:
        bundle: whose policy collected the last recording.
        recordings: one for each inner step that collects, in order.

    Returns:
        The adapted bundle; or, if more inner steps collect, the bundle of the policy that collects
        for the next one.

    Raises:
        BridgeError: the bundle is adapted already, the recordings are not of it, or have no
            episode to learn from.
    """
    if bundle.stage.adapted:
        raise AdaptError("the bundle is adapted already: mode=execute drives it")
    needed = collectors(bundle)
    if len(recordings) != len(needed):
        raise AdaptError(
            f"{len(recordings)} recordings are given; the bundle needs {len(needed)}, one for each "
            "inner step so far, in order"
        )
    for number, (recording, collector) in enumerate(zip(recordings, needed, strict=True)):
        _check(number, recording, bundle, collector)
    _check_densities(bundle, recordings[-1])
    parts = learning(bundle)
    rollouts = [rollout(parts, recording) for recording in recordings]
    staged = adapt_with(parts.learner, parts.params, parts.task, parts.demos, rollouts)
    obs = jnp.zeros(len(bundle.observation.names))
    log_std = parts.learner.policy.apply(staged.params, obs).log_std
    tensors = tensors_of(staged.params, log_std, "policy")
    return after_step(bundle, recordings[-1], Stage(staged.used, staged.adapted), tensors)


def rollout(parts: Learning, recording: Recording) -> Rollout:
    """The recording's whole episodes, as a simulation's collector returns them, [E, T, ..]."""
    each = [_padded(episode, recording.header.horizon) for episode in whole_episodes(recording)]
    trajectory = Trajectory(*(jnp.stack(values) for values in zip(*each, strict=True)))
    adapt = parts.settings.adapt
    return Rollout(trajectory, advantages(trajectory, adapt.discount, adapt.gae_lambda))


def _padded(episode: Episode, horizon: int) -> Trajectory:
    """One episode, [T, ..]; steps after its end are zero, and masked out."""
    steps, number = episode.steps, len(episode.steps)

    def padded(values: Any) -> jax.Array:
        rows = np.asarray(values, np.float32)
        return jnp.asarray(np.pad(rows, [(0, horizon - number)] + [(0, 0)] * (rows.ndim - 1)))

    return Trajectory(
        obs=padded([step.obs for step in steps]),
        action=padded([step.action for step in steps]),
        reward=padded([step.reward for step in steps]),
        done=padded([step.done for step in steps]),
        success=padded([step.success for step in steps]),
        diverged=padded(np.zeros(number)),
        mask=padded(np.ones(number)),
        log_prob=padded([step.log_prob for step in steps]),
    )


def _check(number: int, recording: Recording, bundle: Bundle, collector: str) -> None:
    header, name = recording.header, f"recording {number}"
    if header.bundle != collector:
        raise AdaptError(
            f"{name} was collected by another bundle ({header.bundle[:12]}, expected "
            f"{collector[:12]})"
        )
    if header.dry_run:
        raise AdaptError(f"{name} is of a dry run: the robot did not do what the policy said")
    if not header.noise:
        raise AdaptError(f"{name} was driven without the policy's noise, so nothing can be learned")
    period = (header.control_period, bundle.control_period)
    zone = bundle.zone
    if period[0] != period[1] or zone is None or header.horizon != zone.horizon:
        raise AdaptError(f"{name} has another control period or horizon than the bundle")
    if not whole_episodes(recording):
        raise AdaptError(
            f"{name} has no whole episode, one that ended in success, outside the arena or at the "
            "horizon; collect at least one"
        )


def _check_densities(bundle: Bundle, recording: Recording) -> None:
    """Refuses actions that the bundle's policy did not sample."""
    policy = Policy(bundle)
    for number, episode in enumerate(recording.episodes):
        for t, step in enumerate(episode.steps):
            own = log_prob(policy, step.obs, step.action)
            if not abs(own - step.log_prob) <= TOLERANCE * max(1.0, abs(own)):
                raise AdaptError(
                    f"step {t} of episode {number} was not sampled by the bundle's policy: its "
                    f"log-density is {own:.4f}, recorded is {step.log_prob:.4f}"
                )
