"""Counts the floating-point operations of matrix products in a function, from its jaxpr."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import jax


def matrix_flops(function: Callable[..., Any], *arguments: Any, trips: Sequence[int] = ()) -> int:
    """Multiplications and additions in the matrix products that a call makes.

    Args:
        function: what is called; it may be compiled.
        arguments: of the call; only shapes matter.
        trips: how often each while loop goes round, in the order in which they stand.
    """
    left = list(trips)
    count = _count(jax.make_jaxpr(function)(*arguments).jaxpr, left)
    if left:
        raise ValueError(f"{len(left)} trip counts too many")
    return count


def _count(jaxpr: Any, trips: list[int]) -> int:
    return sum(_of_equation(equation, trips) for equation in jaxpr.eqns)


def _of_equation(equation: Any, trips: list[int]) -> int:
    name, parameters = equation.primitive.name, equation.params
    if name == "dot_general":
        return _of_product(equation)
    if name == "while":
        times = trips.pop(0)
        body = _count(parameters["body_jaxpr"].jaxpr, trips)
        return times * body + (times + 1) * _count(parameters["cond_jaxpr"].jaxpr, trips)
    inside = sum(_count(getattr(j, "jaxpr", j), trips) for j in _jaxprs(parameters))
    return inside * (parameters["length"] if name == "scan" else 1)


def _of_product(equation: Any) -> int:
    (contracted, _), _ = equation.params["dimension_numbers"]
    left = equation.invars[0].aval.shape
    return 2 * prod(equation.outvars[0].aval.shape) * prod(left[i] for i in contracted)


def _jaxprs(parameters: dict[str, Any]) -> list[Any]:
    """What a call, a scan or another composition contains."""
    values = [x for v in parameters.values() for x in (v if isinstance(v, tuple | list) else (v,))]
    return [x for x in values if hasattr(x, "eqns") or hasattr(x, "jaxpr")]
