"""How work on a batch is laid out: what is fast depends on the device.

An accelerator wants all tasks in one large operation. A CPU is faster with one task after another:
the arrays of one task (2000 steps x 100 units are 0.8 MB) stay in its cache between operations,
those of all tasks pass through memory each time (docs/performance.md has the measurements).

Where several devices share the tasks, each has as many, so that a mean over devices of means over
tasks is the mean over all tasks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import jax

Function = TypeVar("Function", bound=Callable[..., Any])


def map_each(function: Callable[..., Any], *batches: Any) -> Any:
    """`function` of each element of the batches' leading axis, stacked; differentiable."""
    if _on_cpu():
        return jax.lax.map(lambda parts: function(*parts), batches)
    return jax.vmap(function)(*batches)


def one_at_a_time(function: Function) -> Function:
    """The function, on a CPU executed once for each element where it is vmapped.

    So a `cond` in it stays a choice. Its arguments are arrays; it cannot be differentiated.
    """
    if not _on_cpu():
        return function

    @wraps(function)
    def sequential(*arguments: Any) -> Any:
        # what the function has from around it may be vmapped as well, such as a learning rate
        converted, hoisted = jax.closure_convert(function, *arguments)
        return jax.custom_batching.sequential_vmap(converted)(*arguments, *hoisted)

    return cast(Function, sequential)


def mean_over_devices(x: Any, axis: str | None) -> Any:
    """The mean of a pytree over the devices along a mesh's axis; without one, x itself."""
    return x if axis is None else jax.lax.pmean(x, axis)


def max_over_devices(x: Any, axis: str | tuple[str, ...] | None) -> Any:
    """The largest values of a pytree over the devices along axes; without one, x itself."""
    return x if axis is None else jax.lax.pmax(x, axis)


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"
