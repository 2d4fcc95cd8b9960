"""Algorithms by name; each file assembles one from parts and does nothing else."""

from __future__ import annotations

from collections.abc import Callable

from emrld_jax.algorithms.emaml import emaml
from emrld_jax.algorithms.emrld import emrld
from emrld_jax.algorithms.emrld_ws import emrld_ws
from emrld_jax.algorithms.gmps import gmps
from emrld_jax.algorithms.maml import maml
from emrld_jax.algorithms.meta_bc import meta_bc
from emrld_jax.algorithms.promp import promp
from emrld_jax.algorithms.reptile import reptile
from emrld_jax.meta.learner import MetaLearner
from emrld_jax.settings import Settings
from envs_jax import Env

__all__ = ["make", "names", "starts_plain", "takes_demonstrations", "uses"]

_ALGORITHMS: dict[str, Callable[[Env, Settings], MetaLearner]] = {
    function.__name__: function
    for function in (emrld, emrld_ws, maml, meta_bc, gmps, promp, emaml, reptile)
}

_TRPO = (
    *("meta.max_kl", "meta.cg_iterations", "meta.damping", "meta.fisher_every"),
    *("meta.backtrack_ratio", "meta.max_backtracks"),
)
_PROMP = ("meta.gradient_steps", "meta.clip", "meta.kl_penalty")
_GRADIENT = ("meta.learning_rate", *_PROMP)
_WEIGHTS = ("w_rl", "w_bc")
_WARM_START = ("adapt.warm_start_rate",)
_EPISODES = ("adapt.discount", "adapt.gae_lambda")
_OUTER_DEMOS = ("outer_demos",)

# settings that an algorithm has no use for, by their full name
_UNUSED = {
    "emrld": (*_WARM_START, *_GRADIENT, *_OUTER_DEMOS),
    "emrld_ws": (*_GRADIENT, *_OUTER_DEMOS),
    "maml": (*_WEIGHTS, *_WARM_START, *_GRADIENT, *_OUTER_DEMOS),
    "meta_bc": (*_WEIGHTS, *_WARM_START, *_TRPO, *_PROMP, *_EPISODES),
    "gmps": (*_WEIGHTS, *_WARM_START, *_TRPO, *_PROMP),
    "promp": (*_WEIGHTS, *_WARM_START, *_TRPO, *_OUTER_DEMOS),
    "emaml": (*_WEIGHTS, *_WARM_START, *_GRADIENT, *_OUTER_DEMOS),
    "reptile": (*_WEIGHTS, *_WARM_START, *_TRPO, *_PROMP, *_OUTER_DEMOS, "adapt.first_order"),
}
_WITHOUT_DEMONSTRATIONS = ("maml", "promp", "emaml", "reptile")


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_ALGORITHMS)


def uses(name: str, setting: str) -> bool:
    """Whether this algorithm's results depend on the setting of this full name."""
    return setting not in _UNUSED.get(name, ())


def takes_demonstrations(name: str) -> bool:
    """Whether this algorithm's results depend on the demonstrations."""
    return name not in _WITHOUT_DEMONSTRATIONS


def starts_plain(name: str) -> bool:
    """Whether the first episodes of its meta-iterations are those of the meta-policy as it is.

    Others collect none before their adaptation, or begin with a warm start.
    """
    return name not in ("emrld_ws", "meta_bc")


def make(name: str, env: Env, settings: Settings) -> MetaLearner:
    """The algorithm of this name, for an environment.

    Raises:
        ValueError: an unknown name.
    """
    if name not in _ALGORITHMS:
        raise ValueError(f"algorithm {name!r} is unknown (there are: {', '.join(names())})")
    return _ALGORITHMS[name](env, settings)
