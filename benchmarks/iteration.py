"""What one meta-iteration takes, and where it goes.

`python -m benchmarks.iteration` times EMRLD with an environment's shipped defaults at its first
parameters, when episodes last to the horizon, and prints a table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from emrld_jax import algorithms
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.config import algorithm_settings
from emrld_jax.runs.provenance import machine, software
from emrld_jax.runs.setup import set_up
from emrld_jax.sampling.rollouts import collector
from envs_jax import names


def seconds(call: Callable[[], Any], repeats: int) -> np.ndarray:
    """Wall-clock times of a call, after one that compiles and one that warms up."""
    times = []
    for _ in range(repeats + 2):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return np.array(times[2:])


def measure(env_name: str, repeats: int) -> dict[str, np.ndarray]:
    """Seconds of a meta-iteration and its parts.

    A Fisher-vector product costs what one more conjugate-gradient iteration does.
    """
    setup = set_up(train_config([f"env={env_name}"]))
    config, env, demos = setup.config, setup.env, setup.demos.train
    base = algorithm_settings(config)
    count = base.meta.cg_iterations  # Fisher-vector products a meta-iteration
    key = jax.random.key(0)

    def iteration(products: int, fisher_every: int) -> np.ndarray:
        meta = replace(base.meta, cg_iterations=products, fisher_every=fisher_every)
        learner = algorithms.make(config.algo, env, replace(base, meta=meta))
        state = learner.init(key)
        return seconds(lambda: learner.update(state, key, demos.tasks, demos.demos), repeats)

    learner = algorithms.make(config.algo, env, base)
    adapt = config.adapt
    collect = collector(env, learner.policy, adapt.num_episodes, adapt.discount, adapt.gae_lambda)
    params = learner.init(key).params
    keys = jax.random.split(key, demos.demos.mask.shape[0])
    collect_all = jax.jit(jax.vmap(collect, in_axes=(None, 0, 0)))
    whole, one = (iteration(products, base.meta.fisher_every) for products in (count, 1))
    product = (np.median(whole) - np.median(one)) / (count - 1)
    collecting = 2 * seconds(lambda: collect_all(params, keys, demos.tasks), repeats)
    rest = np.median(whole) - np.median(collecting) - count * product
    return {
        "one meta-iteration": whole,
        "collecting episodes, before and after adaptation": collecting,
        f"{count} Fisher-vector products on every {base.meta.fisher_every}th step": np.array(
            [count * product]
        ),
        "gradient, adaptation, line search": np.array([rest]),
        "one meta-iteration, Fisher-vector products on every step": iteration(count, 1),
    }


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.iteration", description=__doc__)
    parser.add_argument("--env", default="point2d", choices=names())
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    times = measure(options.env, options.repeats)
    print("| part | median, ms | range, ms |\n|---|---|---|")
    for part, values in times.items():
        span = f"{1e3 * values.min():.0f} to {1e3 * values.max():.0f}" if len(values) > 1 else ""
        print(f"| {part} | {1e3 * np.median(values):.0f} | {span} |")
    print(f"\n{machine()}\n{software()}")


if __name__ == "__main__":
    main()
