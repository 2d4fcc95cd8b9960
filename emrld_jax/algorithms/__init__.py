"""Algorithms by name; each file assembles one from parts and does nothing else."""

from __future__ import annotations

from collections.abc import Callable

from emrld_jax.algorithms.emrld import emrld
from emrld_jax.algorithms.emrld_ws import emrld_ws
from emrld_jax.algorithms.maml import maml
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.settings import Settings
from envs_jax import Env

__all__ = ["make", "names", "uses"]

_ALGORITHMS: dict[str, Callable[[Env, Settings], MetaLearner]] = {
    function.__name__: function for function in (emrld, emrld_ws, maml)
}

# settings that an algorithm has no use for, by their full name
_UNUSED = {
    "emrld": ("adapt.warm_start_rate",),
    "emrld_ws": (),
    "maml": ("w_rl", "w_bc", "adapt.warm_start_rate"),
}


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_ALGORITHMS)


def uses(name: str, setting: str) -> bool:
    """Whether this algorithm's results depend on the setting of this full name."""
    return setting not in _UNUSED[name]


def make(name: str, env: Env, settings: Settings) -> MetaLearner:
    """The algorithm of this name, for an environment.

    Raises:
        ValueError: an unknown name.
    """
    if name not in _ALGORITHMS:
        raise ValueError(f"algorithm {name!r} is unknown (there are: {', '.join(names())})")
    return _ALGORITHMS[name](env, settings)
