"""How fast everything is: environments, adaptation, and where a meta-iteration's time goes.

`python -m benchmarks.throughput env=point2d` measures at the first parameters, when all episodes
last to the horizon; `run=RUN_DIR` at those of a run, when they end early.
"""

from __future__ import annotations

import resource
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.flops import matrix_flops
from benchmarks.records import write_record
from emrld_jax import algorithms
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.meta.learner import MetaLearner, MetaState, bucket_sizes
from emrld_jax.runs import cli
from emrld_jax.runs.checkpoints import Checkpoints
from emrld_jax.runs.config import algorithm_settings, check_config, load_config
from emrld_jax.runs.iteration import initial
from emrld_jax.runs.provenance import machine, software
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.sampling.rollouts import collector, episode
from emrld_jax.settings import setting
from envs_jax import Env, State, names
from envs_jax.base import REWARDS

KEY = jax.random.key(0)


@dataclass
class ThroughputConfig:
    """All settings of the measurement."""

    env: str = setting("point2d", "the environment", choices=names())
    algo: str = setting("emrld", "the algorithm", choices=algorithms.names())
    demos: str = setting("optimal", "the shipped demonstrations", choices=QUALITIES)
    reward: str = setting(
        "sparse", "dense: adaptation has to weigh every step from the start", choices=REWARDS
    )
    run: str | None = setting(None, "run folder whose parameters are taken; null: the first ones")
    repetitions: int = setting(9, "of each measurement", at_least=2)


class Row(NamedTuple):
    """A measurement: what, in which unit, and a value a repetition."""

    what: str
    unit: str
    values: list[float]


def seconds(call: Callable[[], Any], repetitions: int) -> np.ndarray:
    """Wall-clock times of a call, after one that compiles and one that warms up."""
    times = []
    for _ in range(repetitions + 2):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return np.array(times[2:])


def rate(what: str, unit: str, amount: float, times: np.ndarray) -> Row:
    return Row(what, unit, [float(amount / t) for t in times])


def duration(what: str, times: np.ndarray) -> Row:
    return Row(what, "ms", [float(1e3 * t) for t in times])


class Bench:
    """What is measured, at one set of parameters."""

    def __init__(self, config: ThroughputConfig) -> None:
        self.setup, self.state = _setup_and_state(config)
        self.part, self.repetitions = self.setup.demos.train, config.repetitions
        self.adapt = self.setup.config.adapt
        self.tasks = self.part.demos.mask.shape[0]
        self.steps = self.tasks * self.adapt.num_episodes * self.setup.env.horizon

    def learner(self, **meta: Any) -> MetaLearner:
        """The algorithm, with other settings of the meta-step."""
        settings = algorithm_settings(self.setup.config)
        settings = replace(settings, meta=replace(settings.meta, **meta))
        return algorithms.make(self.setup.config.algo, self.setup.env, settings)

    def matrix_rate(self) -> Row:
        """A product of the hidden layer's shape, over as many steps as an iteration has."""
        wide = max(self.setup.config.policy.hidden_sizes)
        a, b = jnp.ones((self.steps, wide)), jnp.ones((wide, wide))
        times = seconds(lambda: _product(a, b), 4 * self.repetitions)
        return rate("matrix product of these shapes", "GFLOP/s", 2e-9 * a.size * wide, times)

    def rollouts(self) -> list[Row]:
        """Environment steps a second, episodes of full length."""
        env, policy = self.setup.env, self.setup.learner.policy
        keys = jax.random.split(KEY, (self.tasks, self.adapt.num_episodes))

        @jax.jit
        def physics(keys: jax.Array) -> Any:
            return jax.vmap(lambda task, own: jax.vmap(lambda k: _random_walk(env, k, task))(own))(
                self.part.tasks, keys
            )

        @jax.jit
        def acting(keys: jax.Array) -> Any:
            one = lambda k, task: episode(env, policy, self.state.params, k, task)  # noqa: E731
            return jax.vmap(lambda task, own: jax.vmap(lambda k: one(k, task))(own))(
                self.part.tasks, keys
            )

        return [
            rate(f"environment steps, {what}", "million/s", 1e-6 * self.steps, times)
            for what, times in (
                ("random actions", seconds(lambda: physics(keys), self.repetitions)),
                ("with the policy", seconds(lambda: acting(keys), self.repetitions)),
            )
        ]

    def adaptations(self) -> Row:
        """Tasks adapted to, with the collecting of episodes."""
        learner, adapt = self.setup.learner, self.adapt
        collect = collector(
            self.setup.env, learner.policy, adapt.num_episodes, adapt.discount, adapt.gae_lambda
        )

        @jax.jit
        @jax.vmap
        def all_tasks(key: jax.Array, task: Any, demos: Any) -> Any:
            return learner.adapt(self.state.params, key, task, demos, collect).params

        keys = jax.random.split(KEY, self.tasks)
        times = seconds(lambda: all_tasks(keys, self.part.tasks, self.part.demos), self.repetitions)
        return rate("adaptations, with their episodes", "1/s", self.tasks, times)

    def iterations(self) -> list[Row]:
        """A meta-iteration, and its parts by what it takes with more or fewer of them."""
        meta = self.setup.config.meta
        whole, metrics, first = self._iteration()
        few, _, _ = self._iteration(cg_iterations=1)
        exact, _, _ = self._iteration(fisher_every=1)
        product = (np.median(whole) - np.median(few)) / (meta.cg_iterations - 1)
        tries = int(metrics["outer/line_search_tries"])
        gather = jax.jit(self.setup.learner.programs.gather)
        collecting = seconds(lambda: gather(*self._arguments()), self.repetitions)
        rest = np.median(whole) - np.median(collecting) - meta.cg_iterations * product
        return [
            Row("compiling, and one meta-iteration", "ms", [1e3 * first]),
            duration("one meta-iteration", whole),
            duration("  collecting and adapting, twice", collecting),
            duration(f"  one of {meta.cg_iterations} Fisher-vector products", np.array([product])),
            duration(f"  the rest: gradient, {tries} tries of the line search", np.array([rest])),
            duration("one meta-iteration, products on every step", exact),
        ]

    def matrix_share(self, peak: Row) -> list[Row]:
        """FLOPs of the matrix products in a meta-step's program, and their rate."""
        learner = self.setup.learner
        experience, _ = jax.jit(learner.programs.gather)(*self._arguments())
        sizes = bucket_sizes(experience)
        _, metrics = learner.update(self.state, KEY, self.part.tasks, self.part.demos)
        trips = [self.setup.config.meta.cg_iterations, int(metrics["outer/line_search_tries"])]

        def improve(state: MetaState, experience: Any) -> Any:
            return learner.programs.improve(state, experience, self.part.demos, sizes)

        flops = matrix_flops(improve, self.state, experience, trips=trips)
        program = jax.jit(improve)
        times = seconds(lambda: program(self.state, experience), self.repetitions)
        reached = rate("matrix products of the meta-step", "GFLOP/s", 1e-9 * flops, times)
        share = np.median(reached.values) / np.median(peak.values)
        return [
            Row("FLOPs of the meta-step's matrix products", "GFLOP", [1e-9 * flops]),
            reached,
            Row("  of the rate above", "%", [100 * float(share)]),
        ]

    def _arguments(self) -> tuple[Any, ...]:
        return self.state.params, KEY, self.part.tasks, self.part.demos

    def _iteration(self, **meta: Any) -> tuple[np.ndarray, dict[str, Any], float]:
        """Times of an update, its metrics, and the time of the first, which compiles."""
        update = self.learner(**meta).update
        arguments = (self.state, KEY, self.part.tasks, self.part.demos)
        began = time.perf_counter()
        _, metrics = jax.block_until_ready(update(*arguments))
        first = time.perf_counter() - began
        return seconds(lambda: update(*arguments), self.repetitions), metrics, first


@jax.jit
def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return a @ b


def _random_walk(env: Env, key: jax.Array, task: Any) -> jax.Array:
    """The reward of an episode of random actions; the environment's steps and nothing else."""
    actions = jax.random.normal(key, (env.horizon, env.action_size))

    def step(state: State, action: jax.Array) -> tuple[State, jax.Array]:
        state = env.step(state, action)
        return state, state.reward

    return jnp.sum(jax.lax.scan(step, env.reset(key, task), actions)[1])


def _setup_and_state(config: ThroughputConfig) -> tuple[Setup, MetaState]:
    """What is measured, and where."""
    if config.run is None:
        chosen = [f"env={config.env}", f"algo={config.algo}", f"demos={config.demos}"]
        chosen += [f"env.reward={config.reward}"]
        setup = set_up(cli.train_config(chosen))
        return setup, initial(setup).state
    folder = Path(config.run)
    setup = set_up(load_config(folder / "config.yaml"))
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        restored = checkpoints.restore(initial(setup), print)
    if restored is None:
        raise SystemExit(f"{folder} has no checkpoint")
    return setup, restored.state


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    lines = ["| what | median | range | |", "|---|---|---|---|"]
    for row in rows:
        span = f"{min(row.values):.4g} to {max(row.values):.4g}" if len(row.values) > 1 else ""
        lines.append(f"| {row.what} | {np.median(row.values):.4g} | {span} | {row.unit} |")
    return "\n".join(lines)


def main() -> int:
    """Measures and writes the table."""
    values = cli.parse(sys.argv[1:], ThroughputConfig(), {})
    config = cli.updated(ThroughputConfig(), values)
    check_config(config)
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured too
    bench = Bench(config)
    peak = bench.matrix_rate()
    rows = [
        peak,
        *bench.rollouts(),
        bench.adaptations(),
        *bench.iterations(),
        *bench.matrix_share(peak),
        Row("peak memory of the process", "MiB", [_peak_memory()]),
    ]
    record = {
        "command": shlex.join(["python", "-m", "benchmarks.throughput", *sys.argv[1:]]),
        **software(),
        "machine": machine(),
        "rows": [row._asdict() for row in rows],
    }
    where = "trained" if config.run else config.reward
    write_record(f"throughput-{bench.setup.config.env.name}-{where}", record, table(rows))
    return 0


def _peak_memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    cli.run_command(main)
