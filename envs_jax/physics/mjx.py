"""MJX: MuJoCo's physics written in JAX, for accelerators."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import jax
import jax.numpy as jnp

from envs_jax.physics import Advanced

with redirect_stdout(StringIO()):  # it would tell of optional packages that nobody asked for
    from mujoco import mjx

LARGEST = 1e10  # what MuJoCo calls a number that has gone wrong


CHUNK = 200  # simulations at once on a CPU, where XLA (0.10.2) hangs in MJX with 1000


def in_flat_batches(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays that, however often it is vmapped, sees a single batch axis.

    On a CPU it sees at most CHUNK elements at a time. It cannot be differentiated.
    """

    def of_batch(*batch: Any) -> Any:
        if jax.default_backend() == "cpu" and batch[0].shape[0] > CHUNK:
            return jax.lax.map(lambda one: function(*one), batch, batch_size=CHUNK)
        return jax.vmap(function)(*batch)

    many = jax.custom_batching.custom_vmap(of_batch)
    single = jax.custom_batching.custom_vmap(function)

    def rows(size: int, batched: Any, arguments: Any) -> list[Any]:
        return [
            x if own else jnp.broadcast_to(x, (size, *x.shape))
            for x, own in zip(arguments, batched, strict=True)
        ]

    @single.def_vmap
    def _(size: int, batched: Any, *arguments: Any) -> Any:
        result = many(*rows(size, batched, arguments))
        return result, jax.tree.map(lambda _: True, result)

    @many.def_vmap
    def _(size: int, batched: Any, *arguments: Any) -> Any:
        flat = [x.reshape(-1, *x.shape[2:]) for x in rows(size, batched, arguments)]
        result = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), many(*flat))
        return result, jax.tree.map(lambda _: True, result)

    return single


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
        return in_flat_batches(self._advance)(body, control)

    def _advance(self, body: jax.Array, control: jax.Array) -> Advanced:
        nq, nv = self._nq, self._nv
        data = self._data.replace(
            qpos=body[:nq], qvel=body[nq : nq + nv], qacc_warmstart=body[nq + nv :], ctrl=control
        )
        # MJX relies on ranks being promoted, which callers may have forbidden; and an accelerator's
        # own products, of 10 bits, are no physics, unless they were asked for
        setting: str | None = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
        with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision(setting or "float32"):
            data, _ = jax.lax.scan(
                lambda data, _: (mjx.step(self._model, data), None), data, length=self._frame_skip
            )
        after = jnp.concatenate([data.qpos, data.qvel, data.qacc_warmstart])
        fine = jnp.all(jnp.abs(after) < LARGEST)  # false for NaN, too
        return Advanced(jnp.where(fine, after, body), 1.0 - fine)
