"""How work on a batch of tasks is laid out: what is fast depends on the device.

An accelerator wants all tasks in one large operation. A CPU is faster with one task after another:
the arrays of one task (2000 steps x 100 units are 0.8 MB) stay in its cache between operations,
those of all tasks pass through memory each time (docs/performance.md has the measurements).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax

Function = TypeVar("Function", bound=Callable[..., Any])


def map_tasks(function: Callable[..., Any], *batches: Any) -> Any:
    """`function` of each task's part of the batches, stacked; differentiable. Leading [M]."""
    if _on_cpu():
        return jax.lax.map(lambda parts: function(*parts), batches)
    return jax.vmap(function)(*batches)


def one_at_a_time(function: Function) -> Function:
    """The function, on a CPU executed once for each element where it is vmapped.

    So a `cond` in it stays a choice. Its arguments are arrays; it cannot be differentiated.
    """
    return jax.custom_batching.sequential_vmap(function) if _on_cpu() else function


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"
