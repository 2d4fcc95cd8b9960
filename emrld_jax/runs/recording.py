"""What a run writes while it goes on: metrics, checkpoints, and a note if nothing is rewarded."""

from __future__ import annotations

from contextlib import ExitStack
from types import TracebackType
from typing import Self

from rich.console import Console

from emrld_jax.runs.checkpoints import Checkpoints
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.iteration import Standing
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
        self, folder: RunFolder, k: int, standing: Standing, checkpoint_every: int, console: Console
    ) -> None:
        """Of the k-th of the runs that stand there."""
        self._folder, self._k, self._last = folder, k, standing
        self._every, self._console = checkpoint_every, console
        self._unrewarded = 0  # iterations in a row

    def add(self, standing: Standing, metrics: dict[str, float], seconds: float) -> Record:
        """Writes what one more iteration brought."""
        record = {
            "iteration": standing.iteration - 1,
            **metrics,
            "sampling/env_steps": standing.env_steps[self._k],
            "time/iteration_s": seconds,
        }
        self._log.write(record)
        self._last = standing
        self._unrewarded = 0 if record["outer/gradient_norm"] else self._unrewarded + 1
        if self._unrewarded == PATIENCE:
            tell(self._console, f"{self._folder.path}: {NO_REWARD}")
        if standing.iteration % self._every == 0:
            self._save()
        return record

    def _save(self) -> None:
        self._log.sync()  # a run whose metrics are behind its checkpoint could not be resumed
        self._checkpoints.save(self._last.run(self._k))

    def __enter__(self) -> Self:
        folder, start = self._folder, self._last.iteration
        with ExitStack() as stack:
            self._checkpoints = stack.enter_context(Checkpoints(folder.checkpoints))
            self._checkpoints.save(self._last.run(self._k))  # iterations never are without one
            self._log = stack.enter_context(MetricsLog(folder.metrics, folder.tensorboard, start))
            self._open = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._open:
            self._save()
