"""What products of matrices in less than float32 do to a meta-iteration, on this device.

`python -m benchmarks.precision` computes the parts of a meta-iteration on the same episodes in
float64, and how far from that they are in float32 and with the device's own default. On a CPU both
are the same.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.choice import Choice, chosen, origin
from benchmarks.records import named, write_record
from benchmarks.timing import Row, seconds, table
from emrld_jax.fields import setting
from emrld_jax.meta.learner import Halves, MetaState, Sizes, bucket_sizes
from emrld_jax.meta.trpo import fisher_product
from emrld_jax.runs import cli
from emrld_jax.runs.config import check_config
from emrld_jax.runs.iteration import initial
from emrld_jax.runs.setup import Setup, set_up

DAMPING = 1e-5


@dataclass
class PrecisionConfig(Choice):
    """All settings of the comparison."""

    repetitions: int = setting(9, "of each measurement", at_least=2)


def parts(halves: Halves, demos: Any, sizes: Sizes, state: MetaState, experience: Any) -> Any:
    """Outer gradient [P], a product of it with the Fisher matrix [P], and what a step improves.

    The step itself tells little: conjugate gradient magnifies any rounding, where the divergence
    hardly changes.
    """
    flat, unravel = ravel_pytree(state.params)
    objective = halves.objective(experience, demos, None, sizes, None, 1)

    def loss(x: jax.Array, old: Any) -> jax.Array:
        return objective.loss(objective.outputs(unravel(x)), old)

    gradient = jax.grad(loss)(flat, objective.outputs(state.params))
    product = fisher_product(objective, flat, unravel, DAMPING)(gradient)
    _, metrics = halves.improve(state, experience, demos, None, sizes, None)
    return {
        "the outer loss's gradient": gradient,
        "a Fisher-vector product of it": product,
        "what the meta-step improves the loss by": metrics["outer/improvement"],
    }


def distance(found: jax.Array, exact: jax.Array) -> float:
    """The relative error of a vector or number."""
    own, wanted = (np.asarray(x, dtype=np.float64) for x in (found, exact))
    return float(np.linalg.norm(own - wanted) / np.linalg.norm(wanted))


def compare(setup: Setup, repetitions: int) -> list[Row]:
    """Errors against float64, and times, of each precision."""
    halves, demos = setup.learner.halves, setup.demos.train
    state = initial(setup).state
    keys = jax.random.split(jax.random.key(0), demos.demos.mask.shape[0])
    gather = jax.jit(halves.gather, static_argnums=4)
    experience, needed, _ = gather(state.params, keys, demos.tasks, demos.demos, None)
    sizes = bucket_sizes(experience, needed)
    compute = jax.jit(partial(parts, halves, demos.demos, sizes))
    with jax.enable_x64(True):
        doubled = jax.tree.map(partial(_as, jnp.float64), (state, experience))
        exact = jax.device_get(compute(*doubled))
    rows = []
    for precision in ("float32", "default"):
        with jax.default_matmul_precision(precision):
            found = jax.device_get(compute(state, experience))
            times = seconds(lambda: compute(state, experience), repetitions)
        rows += [
            Row(f"{precision}: error of {what}", "", [distance(found[what], exact[what])])
            for what in exact
        ]
        rows.append(Row(f"{precision}: time of all three", "ms", [float(1e3 * t) for t in times]))
    return rows


def _as(dtype: Any, x: jax.Array) -> jax.Array:
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x


def main() -> int:
    """Compares and writes the table."""
    config = cli.updated(PrecisionConfig(), cli.parse(sys.argv[1:], PrecisionConfig(), {}))
    check_config(config)
    setup = set_up(cli.train_config(chosen(config)))
    rows = compare(setup, config.repetitions)
    record = {**origin("precision"), "rows": [row._asdict() for row in rows]}
    write_record(named(f"precision-{config.env}"), record, table(rows))
    return 0


if __name__ == "__main__":
    cli.run_command(main)
