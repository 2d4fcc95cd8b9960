"""MuJoCo's engine in C, on all cores, called from a compiled program for a whole batch at once."""

from __future__ import annotations

from math import prod
from threading import Lock
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from envs_jax.physics import Advanced
from envs_jax.physics.models import silent_mujoco
from envs_jax.threads import usable_cores

BROKEN = [  # MuJoCo's warnings that a simulation is no longer one
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}"))
    for name in ("QPOS", "QVEL", "QACC", "CTRL")
]


class Engine:
    """Advances bodies with the engine in C.

    A call may block a thread of JAX's until another has copied its arguments, so JAX needs two:
    `envs_jax` sees to it when it is imported, which has to be before JAX is used.

    The results do not depend on the number of threads, nor on what is simulated beside.

    Args:
        model: a `mujoco.MjModel`.
        frame_skip: physics steps an environment step.
        threads: how many to use; None: one for each core that this process may use.
    """

    def __init__(self, model: Any, frame_skip: int, threads: int | None = None) -> None:
        self._nq, self._nv = model.nq, model.nv
        self._model, self._frame_skip = model, frame_skip
        self._threads = threads or usable_cores()
        self._batches: dict[int, Batch] = {}
        self._lock = Lock()  # devices of one process call at the same time; a batch serves one

    def advance(self, body: jax.Array, control: jax.Array) -> Advanced:
        """The body after `frame_skip` physics steps; vmapped, one call for the whole batch."""
        result = jax.ShapeDtypeStruct((body.shape[-1] + 1,), body.dtype)
        packed = jax.pure_callback(
            self._advance_all, result, body, control, vmap_method="broadcast_all"
        )
        return Advanced(packed[:-1], packed[-1])

    def _advance_all(self, bodies: Any, controls: Any) -> np.ndarray:
        """Bodies [.., B] and controls [.., nu] -> [.., B + 1]; NumPy only: JAX waits for this."""
        before = np.asarray(bodies)
        shape, before = before.shape[:-1], before.reshape(-1, before.shape[-1])
        after = np.empty((len(before), before.shape[1] + 1), before.dtype)
        with self._lock:
            batch = self._batch(prod(shape))
            broken = self._step(batch, before, np.asarray(controls).reshape(len(before), -1))
            self._read(batch, after[:, :-1])
        after[:, -1] = broken
        after[broken, :-1] = before[broken]
        return after.reshape(*shape, -1)

    def _batch(self, size: int) -> Batch:
        if size not in self._batches:
            self._batches[size] = Batch(self._model, size, min(self._threads, size))
        return self._batches[size]

    def _step(self, batch: Batch, bodies: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Advances a batch from the bodies [n, B]; returns which simulations broke down, [n]."""
        nq, nv = self._nq, self._nv
        batch.qpos[:] = bodies[:, :nq]
        batch.qvel[:] = bodies[:, nq : nq + nv]
        batch.qacc_warmstart[:] = bodies[:, nq + nv :]
        batch.ctrl[:] = controls
        batch.warning[:] = 0
        broken = np.zeros(len(bodies), bool)
        with silent_mujoco():
            try:
                batch.step(nstep=self._frame_skip)
            except SimulationError as error:
                broken[error.ids] = True
        return broken | batch.warning[:, BROKEN].any(axis=(1, 2))

    def _read(self, batch: Batch, bodies: np.ndarray) -> None:
        nq, nv = self._nq, self._nv
        bodies[:, :nq] = batch.qpos
        bodies[:, nq : nq + nv] = batch.qvel
        bodies[:, nq + nv :] = batch.qacc_warmstart
