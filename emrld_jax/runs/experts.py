"""The training of an expert, kept on disk while it goes on, so that a stopped one can go on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from emrld_jax.demos import DemoError
from emrld_jax.demos.making import Standing
from emrld_jax.meta.learner import MetaState
from emrld_jax.runs.checkpoints import Checkpoints, Progressed
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.files import write_json
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.progress import tell
from emrld_jax.runs.provenance import software
from emrld_jax.runs.signals import StopSignals

EVERY = 5  # iterations between checkpoints


class KeptTraining:
    """A training, while it goes on."""

    def __init__(
        self, began: dict[str, Any], checkpoints: Checkpoints, stop: StopSignals, console: Console
    ) -> None:
        self.began = began  # settings, and the code that it began with
        self._checkpoints, self._stop, self._console = checkpoints, stop, console

    def restore(self, start: Standing) -> Standing:
        """Where the training goes on: its newest checkpoint, or the start.

        Raises:
            ConfigError: there are checkpoints, but none can be read.
        """
        note = lambda text: tell(self._console, f"note: {text}")  # noqa: E731
        found = self._checkpoints.restore(self._progressed(start), note)
        if found is None:
            return start
        tell(self._console, f"continuing a training after iteration {found.iteration}")
        return Standing(found.state.params, found.iteration)

    def keep(self, standing: Standing) -> None:
        """Saves now and then, and where a signal asks to stop.

        Raises:
            SystemExit: one has, with its exit code.
            OSError: a checkpoint cannot be written.
        """
        stopped = self._stop.received is not None
        if stopped or standing.iteration % EVERY == 0:
            self._checkpoints.save(self._progressed(standing))
        if stopped:
            tell(self._console, "stopped; the same command goes on where it was")
            raise SystemExit(self._stop.exit_code)

    def _progressed(self, standing: Standing) -> Progressed:
        """An expert's state is all that it learns; of its keys the seed is kept, steps are none."""
        key = jax.random.key_data(jax.random.key(self.began["settings"]["seed"]))
        return Progressed(MetaState(standing.state, ()), key, standing.iteration, 0)


@contextmanager
def kept_training(
    out: Path, settings: Mapping[str, Any], console: Console
) -> Iterator[KeptTraining]:
    """A training for a file of demonstrations, new or one that was stopped.

    What is kept lies beside the file. It is removed once the file is there, and if an expert's
    demonstrations are refused. Ctrl-C and SIGTERM are answered after an iteration.

    Args:
        out: the file.
        settings: all that decides what is trained, as JSON values; `seed` is one.
        console: where it is told what goes on.

    Raises:
        ConfigError: a training of other settings, or one that goes on, is there.
    """
    folder = RunFolder(out.with_name(f"{out.name}.training"))
    folder.path.mkdir(parents=True, exist_ok=True)
    with folder.locked():
        began = _begun(folder.path / "training.json", settings, console)
        try:
            with Checkpoints(folder.checkpoints) as checkpoints, StopSignals() as stop:
                yield KeptTraining(began, checkpoints, stop, console)
        except DemoError:
            shutil.rmtree(folder.path)
            raise
        shutil.rmtree(folder.path)


def _begun(path: Path, settings: Mapping[str, Any], console: Console) -> dict[str, Any]:
    """How the training began, which may be now; checked, if it was before."""
    now: dict[str, Any] = {"settings": dict(settings), **software()}
    if not path.is_file():
        write_json(path, now)
        return now
    try:
        began: dict[str, Any] = json.loads(path.read_text())
        pairs = [(name, began["settings"][name], value) for name, value in settings.items()]
        same_code = all(began[what] == now[what] for what in ("code", "packages"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} cannot be read ({error}): delete its folder") from error
    for name, before, value in pairs:
        if before != value:
            raise ConfigError(
                f"{path.parent} holds a stopped training with {name}={before}, not {value}: give "
                "the same settings to go on with it, delete it, or write elsewhere (out=PATH)"
            )
    if not same_code:
        tell(console, "note: not the same code or packages as when it began; results may differ")
    return began
