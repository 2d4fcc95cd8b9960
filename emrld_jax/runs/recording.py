"""What a run writes while it goes on: metrics, checkpoints, and a note if nothing is rewarded."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console

from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.metrics import MetricsLog, Record
from emrld_jax.runs.progress import tell

PATIENCE = 5  # iterations without a meta-gradient before the user is told
NO_REWARD = (
    f"note: no reward after adaptation in {PATIENCE} iterations, so there is no meta-gradient and "
    "nothing is learned. Another seed may find the first one; so may other demonstrations, or what "
    "lets them move the first policy more: a larger adapt.learning_rate or policy.output_scale, a "
    "smaller policy.std. docs/tuning.md tells what helped where."
)


class Recording:
    """Keeps one run's files up to date; at the end, however it comes, the last state is saved."""

    def __init__(
        self, folder: RunFolder, progressed: Progressed, checkpoint_every: int, console: Console
    ) -> None:
        self._folder, self._last, self._every = folder, progressed, checkpoint_every
        self._console, self._unrewarded = console, 0  # iterations in a row

    def add(self, progressed: Progressed, metrics: dict[str, float], seconds: float) -> Record:
        """Writes what one more iteration brought."""
        record = {
            "iteration": progressed.iteration - 1,
            **metrics,
            "sampling/env_steps": progressed.env_steps,
            "time/iteration_s": seconds,
        }
        self._log.write(record)
        self._last = progressed
        self._unrewarded = 0 if record["outer/gradient_norm"] else self._unrewarded + 1
        if self._unrewarded == PATIENCE:
            tell(self._console, f"{self._folder.path}: {NO_REWARD}")
        if progressed.iteration % self._every == 0:
            self._checkpoints.save(progressed)
        return record

    def __enter__(self) -> Self:
        folder, start = self._folder, self._last.iteration
        self._checkpoints = Checkpoints(folder.checkpoints)
        self._checkpoints.save(self._last)  # so that iterations never are without a checkpoint
        self._log = MetricsLog(folder.metrics, folder.tensorboard, start)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._log.__exit__(kind, error, traceback)
        self._checkpoints.save(self._last)
        self._checkpoints.__exit__(kind, error, traceback)
