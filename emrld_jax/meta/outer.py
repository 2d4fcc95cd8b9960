"""What the meta-parameters are to lower, and what an optimizer of it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from emrld_jax.policy import Policy
from emrld_jax.types import Demos, Experience, Params

Metrics = dict[str, jax.Array]
Average = Callable[[Any], Any]  # a pytree of means over a device's own tasks -> over all tasks


class Objective(NamedTuple):
    """A loss of a model's outputs, and how far outputs are from the old ones.

    Keeping the outputs in sight lets an optimizer linearize the model once, and use the curvature
    that the divergence has in them (Gauss-Newton).

    Where several devices share the tasks, all but `average` is of a device's own ones. An optimizer
    averages the loss, the divergence and their derivatives in the parameters before it uses them.
    """

    outputs: Callable[[Params], Any]
    loss: Callable[[Any, Any], jax.Array]  # (new outputs, old outputs) -> []
    divergence: Callable[[Any, Any], jax.Array]  # (new, old) -> [], least where they are equal
    average: Average = lambda own: own


class OuterOptimizer(NamedTuple):
    """Something that improves parameters on an objective, as pure functions."""

    init: Callable[[Params], Any]  # (params) -> opt_state
    # (objective, curvature, params, opt_state) -> (params, opt_state, metrics), where `curvature`
    # is the same objective, perhaps on a sample of the data, for optimizers that use second
    # derivatives
    update: Callable[[Objective, Objective, Params, Any], tuple[Params, Any, Metrics]]


class OuterLoss(NamedTuple):
    """What the meta-parameters are to lower, by what adaptation makes of them.

    The outputs are one task's; the loss and the divergence see those of all tasks, [M, ..], with
    the experience that they were made on, and the demonstrations that are the outer loss's.
    """

    # (policy, path, experience, demos), the path as in `adaptation.readapt`
    outputs: Callable[[Policy, tuple[Params, ...], Experience, Demos], Any]
    # (new outputs, old outputs, experience, demos, average) -> []
    loss: Callable[[Any, Any, Experience, Demos, Average], jax.Array]
    divergence: Callable[[Any, Any, Experience, Demos], jax.Array]
    # whether it looks at the steps before adaptation that adaptation itself has no use for
    idle_steps: bool = False
