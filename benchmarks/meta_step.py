"""Where the time of a meta-iteration goes."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np

from benchmarks.flops import matrix_flops
from benchmarks.timing import Row, duration, rate, seconds
from emrld_jax import algorithms
from emrld_jax.meta.learner import MetaLearner, MetaState, bucket_sizes
from emrld_jax.runs.config import ConfigError, algorithm_settings
from emrld_jax.runs.iteration import Together, initial
from emrld_jax.runs.setup import Setup, with_config
from emrld_jax.sampling.rollouts import collector


class Bench:
    """What is measured, at one set of parameters."""

    def __init__(self, setup: Setup, state: MetaState, repetitions: int) -> None:
        self.setup, self.state = setup, state
        self.key = jax.random.key(0)
        self.part, self.repetitions = setup.demos.train, repetitions
        self.adapt = self.setup.config.adapt
        self.tasks = self.part.demos.mask.shape[0]
        self.steps = self.tasks * self.adapt.num_episodes * self.setup.env.horizon

    def learner(self, **meta: Any) -> MetaLearner:
        """The algorithm, with other settings of the meta-step."""
        settings = algorithm_settings(self.setup.config)
        settings = replace(settings, meta=replace(settings.meta, **meta))
        return algorithms.make(self.setup.config.algo, self.setup.env, settings)

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

        keys = jax.random.split(self.key, self.tasks)
        times = seconds(lambda: all_tasks(keys, self.part.tasks, self.part.demos), self.repetitions)
        return rate("adaptations, with their episodes", "1/s", self.tasks, times)

    def iterations(self) -> list[Row]:
        """A meta-iteration and its parts: programs that leave out a part tell what it takes."""
        meta = self.setup.config.meta
        whole, metrics, first = self._iteration()
        few, _, _ = self._iteration(cg_iterations=max(1, meta.cg_iterations // 2))
        left_out = meta.cg_iterations - max(1, meta.cg_iterations // 2)
        product = (np.median(whole) - np.median(few)) / max(left_out, 1)
        tries = int(metrics["outer/line_search_tries"])
        one = self._objective()
        collecting = seconds(lambda: self.gather(*self._arguments()), self.repetitions)
        gradient, trial = (seconds(partial(f, self.state.params), self.repetitions) for f in one)
        return [
            Row("compiling, and one meta-iteration", "ms", [1e3 * first]),
            duration("one meta-iteration", whole),
            rate("meta-iterations", "1/s", 1, whole),
            duration("  collecting and adapting, twice", collecting),
            duration("  the loss and its gradient", gradient),
            duration(f"  one of {meta.cg_iterations} Fisher-vector products", np.array([product])),
            duration(f"  one of {tries} tries of the line search", trial),
        ]

    def _objective(self) -> tuple[Any, Any]:
        """The outer loss with its gradient, and without, as compiled functions of parameters."""
        halves, demos = self.setup.learner.halves, self.part.demos
        experience, needed, _ = self.gather(*self._arguments())
        sizes = bucket_sizes(experience, needed)

        def loss(params: Any, experience: Any, old: Any) -> jax.Array:
            objective = halves.objective(experience, demos, None, sizes, None, 1)
            return objective.loss(objective.outputs(params), old)

        def outputs(params: Any, experience: Any) -> Any:
            return halves.objective(experience, demos, None, sizes, None, 1).outputs(params)

        old = jax.jit(outputs)(self.state.params, experience)
        gradient, value = jax.jit(jax.value_and_grad(loss)), jax.jit(loss)
        return (
            lambda params: gradient(params, experience, old),
            lambda params: value(params, experience, old),
        )

    def matrix_share(self, peak: Row, what: str, **meta: Any) -> list[Row]:
        """A meta-step's time, and the FLOPs of the matrix products in its program and their rate.

        The rate counts all of the meta-step's time, whatever it is spent on.
        """
        learner = self.learner(**meta)
        experience, needed, _ = self.gather(*self._arguments())
        sizes = bucket_sizes(experience, needed)
        demos = self.part.demos

        def improve(state: MetaState, experience: Any) -> Any:
            return learner.halves.improve(state, experience, demos, None, sizes, None)

        program = jax.jit(improve)
        times = seconds(lambda: program(self.state, experience), self.repetitions)
        _, metrics = program(self.state, experience)
        trips = [self.setup.config.meta.cg_iterations, int(metrics["outer/line_search_tries"])]
        flops = matrix_flops(improve, self.state, experience, trips=trips)
        reached = rate("  matrix products", "GFLOP/s", 1e-9 * flops, times)
        share = np.median(reached.values) / np.median(peak.values)
        return [
            duration(f"meta-step, products on {what}", times),
            Row("  FLOPs of its matrix products", "GFLOP", [1e-9 * flops]),
            reached._replace(what=f"  their rate, {what}"),
            Row(f"  of the rate of batched products, {what}", "%", [100 * float(share)]),
        ]

    def side_by_side(self, num_seeds: int, devices: int) -> list[Row]:
        """Meta-iterations of seeds in one program, all at the same parameters."""
        configs = [replace(self.setup.config, seed=seed) for seed in range(num_seeds)]
        setups = [with_config(self.setup, config) for config in configs]
        if len(jax.devices()) < devices:
            raise ConfigError(f"devices={devices}: there are {len(jax.devices())}")
        together = Together(setups, jax.devices()[:devices])
        own = [initial(setup)._replace(state=self.state) for setup in setups]
        standing = together.begin(own)
        times = seconds(lambda: together.iterate(standing)[0].states, self.repetitions)
        what = f"{num_seeds} seed(s) on {devices} device(s)"
        return [
            duration(f"one meta-iteration of {what}", times),
            duration("  for each seed", times / num_seeds),
            rate("  environment steps, all included", "million/s", self._both(num_seeds), times),
        ]

    def _both(self, num_seeds: int) -> float:
        """Millions of environment steps before and after adaptation."""
        return 2e-6 * self.steps * num_seeds

    @cached_property
    def gather(self) -> Any:
        """The first half of a meta-iteration, compiled."""
        gather = self.setup.learner.halves.gather

        def of_tasks(params: Any, key: jax.Array, tasks: Any, demos: Any) -> Any:
            return gather(params, jax.random.split(key, self.tasks), tasks, demos, None)

        return jax.jit(of_tasks)

    def _arguments(self) -> tuple[Any, ...]:
        return self.state.params, self.key, self.part.tasks, self.part.demos

    def _iteration(self, **meta: Any) -> tuple[np.ndarray, dict[str, Any], float]:
        """Times of an update, its metrics, and the time of the first, which compiles."""
        update = self.learner(**meta).update
        arguments = (self.state, self.key, self.part.tasks, self.part.demos)
        began = time.perf_counter()
        _, metrics = jax.block_until_ready(update(*arguments))
        first = time.perf_counter() - began
        return seconds(lambda: update(*arguments), self.repetitions), metrics, first
