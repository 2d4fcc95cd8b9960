"""The bundles that adaptation makes of one another, and how they know each other."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any

import numpy as np

from bridges.bundle import Bundle, Stage
from bridges.recording import Recording, whole_episodes
from bridges.tensor_file import Tensors

STEPS = "adaptation"  # in a bundle's provenance: what each inner step has learned from


def steps(bundle: Bundle) -> list[dict[str, Any]]:
    """What the bundle's inner steps so far learned from, in order."""
    return list(bundle.provenance.get(STEPS, []))


def collectors(bundle: Bundle) -> list[str]:
    """Content hashes of the bundles that collected for each inner step so far, itself the last."""
    return [*(step["bundle"] for step in steps(bundle)), bundle.content_sha256]


def after_step(bundle: Bundle, recording: Recording, stage: Stage, tensors: Tensors) -> Bundle:
    """What an inner step makes of the bundle that collected for it.

    Args:
        bundle: that collected the recording.
        recording: what the step learned from.
        stage: how far adaptation has come with it.
        tensors: of the policy that acts now.
    """
    step = {
        "bundle": bundle.content_sha256,
        "recording": digest(recording),
        "episodes": len(whole_episodes(recording)),
        # not UTC: the Python of ROS 2 Humble has no such name
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),  # noqa: UP017
    }
    return replace(
        bundle,
        stage=stage,
        provenance={**bundle.provenance, STEPS: [*steps(bundle), step]},
        tensors={**bundle.tensors, **tensors},
    )


def is_after_step(made: Bundle, bundle: Bundle, recording: Recording) -> bool:
    """Whether a bundle is what an inner step made of another one and this recording."""
    last = steps(made)[-1:]
    return bool(last) and (last[0]["bundle"], last[0]["recording"]) == (
        bundle.content_sha256,
        digest(recording),
    )


def digest(recording: Recording) -> str:
    """A hash of what is learned from a recording."""
    parts = [
        part.tobytes()
        for episode in whole_episodes(recording)
        for step in episode.steps
        for part in (step.obs, step.action, np.array([step.reward, step.done, step.log_prob]))
    ]
    return hashlib.sha256(b"".join(parts)).hexdigest()
