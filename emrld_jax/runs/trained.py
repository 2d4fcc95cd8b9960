"""What a run has learned so far: the parameters of its newest checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from emrld_jax.runs.checkpoints import Checkpoints
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.iteration import initial
from emrld_jax.runs.saved import load_config
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.types import Params


class Trained(NamedTuple):
    """A run, finished or not, as it stands."""

    setup: Setup  # its environment, demonstrations and algorithm, as it was configured
    params: Params  # the meta-parameters
    iteration: int  # meta-iterations that they have had


def load_trained(run: str | Path, note: Callable[[str], None] = print) -> Trained:
    """Reads a run folder, such as runs/point2d/emrld-optimal/seed0, and changes nothing in it.

    Args:
        run: the folder.
        note: told of checkpoints that cannot be read; the one before is then taken.

    Raises:
        ConfigError, DemoError: it is no run folder, has no checkpoint yet, or its demonstrations
            are refused.
    """
    folder = RunFolder(Path(run))
    setup = set_up(load_config(folder.config))
    return Trained(setup, *newest(setup, folder, note))


def newest(setup: Setup, folder: RunFolder, note: Callable[[str], None]) -> tuple[Params, int]:
    """The parameters of the run's newest checkpoint and the iterations they have had.

    Raises:
        ConfigError: there is none yet, or none can be read.
    """
    if not folder.checkpoints.is_dir():  # orbax would make it
        raise ConfigError(f"{folder.path} has no checkpoint yet")
    with Checkpoints(folder.checkpoints, read_only=True) as checkpoints:
        restored = checkpoints.restore(initial(setup), note)
    if restored is None:
        raise ConfigError(f"{folder.path} has no checkpoint yet")
    return restored.state.params, restored.iteration
