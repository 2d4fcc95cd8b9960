"""Checkpoints of the full state of a run, written by orbax: whole or not at all."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import numpy as np
import orbax.checkpoint as ocp

from emrld_jax.meta.learner import MetaState
from emrld_jax.runs.config import ConfigError

# what orbax raises for files that are missing, cut off or of another structure
_BROKEN: tuple[type[Exception], ...] = (
    *(FileNotFoundError, NotADirectoryError, IsADirectoryError, EOFError),
    *(KeyError, TypeError, ValueError),  # the last also of tensorstore and of JSON
)

logging.getLogger("absl").setLevel(logging.ERROR)  # orbax tells of each file it reads


class Progressed(NamedTuple):
    """All that the rest of a run depends on."""

    state: MetaState
    key: jax.Array  # data of the run's key; iteration i's key is folded from it
    iteration: int  # iterations done
    env_steps: int  # environment steps taken


class Checkpoints:
    """The newest two checkpoints of a run; `read_only` leaves a run alone that may be going on."""

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        self._folder, self._read_only = folder.absolute(), read_only
        if not read_only:
            self._folder.mkdir(parents=True, exist_ok=True)
        options = ocp.CheckpointManagerOptions(
            max_to_keep=2,
            create=False,
            enable_async_checkpointing=False,
            read_only=read_only,
            multiprocessing_options=_this_process_alone(),
        )
        self._manager = ocp.CheckpointManager(self._folder, options=options)

    def save(self, progressed: Progressed) -> None:
        """Writes a checkpoint, unless there is one of this iteration.

        Raises:
            OSError: it cannot be written; those that are there stay.
        """
        step = progressed.iteration
        if step in self._manager.all_steps():
            return
        try:
            saved = self._manager.save(step, args=ocp.args.StandardSave(_tree(progressed)))
        except ValueError as error:  # what tensorstore raises, for a full disk too
            reason = str(error).splitlines()[0][:200]
            raise OSError(
                f"checkpoint {step} of {self._folder} cannot be written: {reason}"
            ) from error
        if not saved:  # orbax only goes forward
            raise OSError(f"{self._folder} has a checkpoint of a later iteration than {step}")

    def drop_after(self, iteration: int) -> None:
        """Deletes the checkpoints of later iterations, which are going to be done again."""
        for step in self._manager.all_steps():
            if step > iteration:
                self._manager.delete(step)

    def restore(
        self, like: Progressed, note: Callable[[str], None], at_most: int | None = None
    ) -> Progressed | None:
        """The newest checkpoint that is whole; None if there is none.

        Args:
            like: a state of the same structure.
            at_most: iterations done that it may have; None for any.
            note: told of checkpoints that cannot be read; unless read-only, they are put aside once
                an older one has been read.

        Raises:
            ConfigError: there are checkpoints, but none can be read; they stay as they are.
        """
        broken: dict[int, str] = {}  # reasons
        for step in sorted(self._manager.all_steps(), reverse=True):
            if at_most is not None and step > at_most:
                continue
            try:
                args = ocp.args.StandardRestore(_tree(like))
                tree = self._manager.restore(step, args=args)
            except _BROKEN as error:
                broken[step] = (str(error).splitlines() or [""])[0][:100]
                continue
            for newer, reason in broken.items():
                note(f"checkpoint {newer} cannot be read ({reason}); taking the one before")
                if not self._read_only:
                    self._put_aside(newer)
            return Progressed(MetaState(tree["params"], tree["opt_state"]), *_rest(tree))
        if broken:
            reasons = "; ".join(f"{step}: {reason}" for step, reason in broken.items())
            raise ConfigError(f"{self._folder}: none of the checkpoints can be read ({reasons})")
        return None

    def _put_aside(self, step: int) -> None:
        """Renames a broken checkpoint, so that the run can write this step again."""
        source, aside = self._folder / str(step), self._folder / f"broken-{step}"
        while aside.exists():
            aside = aside.with_name(f"{aside.name}-again")
        source.rename(aside)
        self._manager.reload()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._manager.close()


_REST = Progressed._fields[1:]


def _tree(progressed: Progressed) -> dict[str, Any]:
    """The state under names, so that a checkpoint can be read without this package.

    Its arrays are NumPy's: a checkpoint does not depend on the devices that it was made on.
    """
    rest = dict(zip(_REST, progressed[1:], strict=True))
    tree = {"params": progressed.state.params, "opt_state": progressed.state.opt_state, **rest}
    return jax.tree.map(lambda leaf: leaf if isinstance(leaf, int) else np.asarray(leaf), tree)


def _this_process_alone() -> ocp.options.MultiprocessingOptions:
    """Orbax is not to wait for other processes: one of them writes all files."""
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    own = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )


def _rest(tree: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(tree[name] for name in _REST)
