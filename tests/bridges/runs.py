"""Run folders for tests, with a checkpoint of random parameters in place of a training."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from emrld_jax.runs.checkpoints import Checkpoints
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.starting import begin, folder_of, planned

SMALL = (
    "policy.hidden_sizes=[8]",
    "policy.start_at_zero=false",
    "policy.output_scale=1",
    "adapt.num_episodes=2",
    "adapt.learning_rate=0.1",
    "env.horizon=12",
    "env.reward=dense",  # so that so few episodes move the parameters
)


def make_run(runs: Path, *arguments: str) -> Path:
    """A run folder of these settings; its parameters have had 3 iterations, as it says."""
    plans = planned(train_config([*SMALL, f"runs={runs}", *arguments]))
    folder = folder_of(plans[0], Console(quiet=True))
    (start,) = begin(plans, [folder], Console(quiet=True))
    rng = np.random.default_rng(1)
    params = jax.tree.map(
        lambda x: x + 0.1 * rng.normal(size=x.shape).astype(np.float32), start.state.params
    )
    with Checkpoints(folder.checkpoints) as checkpoints:
        state = start.state._replace(params=params)
        checkpoints.save(start._replace(state=state, iteration=3))
    return folder.path
