"""MJX: MuJoCo's physics written in JAX, for accelerators."""

from __future__ import annotations

import copy
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import jax
import jax.numpy as jnp

from envs_jax.physics import Advanced

with redirect_stdout(StringIO()):  # it would tell of optional packages that nobody asked for
    from mujoco import mjx

LARGEST = 1e10  # what MuJoCo calls a number that has gone wrong


class Mjx:
    """Advances bodies with MJX.

    Args:
        model: a `mujoco.MjModel`.
        frame_skip: physics steps an environment step.
        solver_iterations: of the contact solver, at the most; the model's own are for the engine.
        line_search_iterations: of each of them, at the most.
    """

    def __init__(
        self, model: Any, frame_skip: int, solver_iterations: int, line_search_iterations: int
    ) -> None:
        self._nq, self._nv = model.nq, model.nv
        self._frame_skip = frame_skip
        model = copy.copy(model)
        model.opt.iterations, model.opt.ls_iterations = solver_iterations, line_search_iterations
        # arrays made here must be constants whatever is being traced around
        with jax.ensure_compile_time_eval():
            self._model = mjx.put_model(model, impl="jax")
            self._data = mjx.make_data(model, impl="jax")

    def advance(self, body: jax.Array, control: jax.Array) -> Advanced:
        """The body after `frame_skip` physics steps."""
        nq, nv = self._nq, self._nv
        data = self._data.replace(
            qpos=body[:nq], qvel=body[nq : nq + nv], qacc_warmstart=body[nq + nv :], ctrl=control
        )
        with jax.numpy_rank_promotion("allow"):  # MJX relies on it; callers may have forbidden it
            data, _ = jax.lax.scan(
                lambda data, _: (mjx.step(self._model, data), None), data, length=self._frame_skip
            )
        after = jnp.concatenate([data.qpos, data.qvel, data.qacc_warmstart])
        fine = jnp.all(jnp.abs(after) < LARGEST)  # false for NaN, too
        return Advanced(jnp.where(fine, after, body), 1.0 - fine)
