"""One meta-iteration of runs: a function of where they stand, so that a resumed run is the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emrld_jax.meta.learner import MetaState
from emrld_jax.runs.checkpoints import Progressed
from emrld_jax.runs.setup import Setup


class DivergenceError(RuntimeError):
    """Training made a number that is not finite."""


def streams(key_data: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A run's keys: of the first parameters, the iterations (folded in), the final evaluation."""
    init_key, loop_key, evaluation_key = jax.random.split(jax.random.wrap_key_data(key_data), 3)
    return init_key, loop_key, evaluation_key


def initial(setup: Setup) -> Progressed:
    """A run before its first iteration."""
    key_data = jax.random.key_data(jax.random.key(setup.config.seed))
    return Progressed(setup.learner.init(streams(key_data)[0]), key_data, 0, 0)


def iterate(setup: Setup, runs: Sequence[Progressed]) -> list[tuple[Progressed, dict[str, float]]]:
    """Where runs of different seeds stand after one more meta-iteration, and its metrics.

    Args:
        setup: what the runs share.
        runs: with as many iterations done each.

    Raises:
        DivergenceError: a metric or a parameter is not finite.
    """
    part = setup.demos.train
    keys = [jax.random.fold_in(streams(run.key)[1], run.iteration) for run in runs]
    if len(runs) == 1:
        only = setup.learner.update(runs[0].state, keys[0], part.tasks, part.demos)
        return [_after(setup, runs[0], *only)]
    states = jax.tree.map(lambda *leaves: np.stack(leaves), *(run.state for run in runs))
    together = setup.learner.update_all(states, jnp.stack(keys), part.tasks, part.demos)
    together = jax.device_get(together)  # one transfer, then cheap slices
    own = (jax.tree.map(lambda x, k=k: x[k], together) for k in range(len(runs)))
    return [_after(setup, run, *results) for run, results in zip(runs, own, strict=True)]


def _after(
    setup: Setup, run: Progressed, state: MetaState, arrays: dict[str, Any]
) -> tuple[Progressed, dict[str, float]]:
    metrics = {name: float(value) for name, value in jax.device_get(arrays).items()}
    _check_finite(run.iteration, metrics, state.params)
    episodes = setup.demos.train.demos.mask.shape[0] * setup.config.adapt.num_episodes
    lengths = (value for name, value in metrics.items() if name.startswith("adapt/length_"))
    env_steps = run.env_steps + sum(round(length * episodes) for length in lengths)
    return Progressed(state, run.key, run.iteration + 1, env_steps), metrics


def _check_finite(i: int, metrics: dict[str, float], params: Any) -> None:
    wrong = [name for name, value in metrics.items() if not math.isfinite(value)]
    if not all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(params)):
        wrong.append("a parameter")
    if wrong:
        raise DivergenceError(
            f"iteration {i + 1} made {', '.join(wrong)} infinite or NaN; the state before it is "
            "saved. A smaller adapt.learning_rate or meta.max_kl may help, in a new run."
        )
