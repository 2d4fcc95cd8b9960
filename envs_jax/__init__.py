"""Environments as pure functions in JAX: `make` one by name, batch it with `jax.vmap`."""

from __future__ import annotations

from dataclasses import fields
from difflib import get_close_matches
from typing import Any

from envs_jax.base import Env, State
from envs_jax.brax_like import Tasks, from_brax
from envs_jax.half_cheetah import HalfCheetah
from envs_jax.point2d import Point2D
from envs_jax.threads import at_least
from envs_jax.two_wheeled import TwoWheeled
from envs_jax.two_wheeled_drift import TwoWheeledDrift

at_least(2)  # physics.engine says why; only before JAX is used can it be said

__all__ = ["Env", "State", "Tasks", "from_brax", "make", "names"]

_ENVIRONMENTS: dict[str, type] = {
    cls.name: cls for cls in (Point2D, TwoWheeled, TwoWheeledDrift, HalfCheetah)
}


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_ENVIRONMENTS)


def make(name: str, **parameters: Any) -> Env:
    """The environment of this name.

    Args:
        name: one of `names()`.
        **parameters: the environment's fields, such as `reward="dense"` or `horizon=50`.

    Raises:
        ValueError: an unknown name or parameter, or an impossible value.
    """
    if name not in _ENVIRONMENTS:
        raise ValueError(f"environment {name!r} is unknown{_hint(name, names())}")
    cls = _ENVIRONMENTS[name]
    allowed = tuple(field.name for field in fields(cls))
    for parameter in parameters:
        if parameter not in allowed:
            raise ValueError(f"{name} has no parameter {parameter!r}{_hint(parameter, allowed)}")
    return cls(**parameters)


def _hint(wrong: str, allowed: tuple[str, ...]) -> str:
    close = get_close_matches(wrong, allowed, n=1)
    meant = f"; did you mean {close[0]!r}?" if close else ""
    return f"{meant} (there are: {', '.join(allowed)})"
