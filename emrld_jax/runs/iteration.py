"""Meta-iterations of runs: functions of where they stand, so that a resumed run is the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np

from emrld_jax.meta.learner import MetaState
from emrld_jax.meta.side_by_side import make_mesh, replicate, share_tasks, side_by_side
from emrld_jax.runs.checkpoints import Progressed
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.setup import Setup, learner_with
from emrld_jax.runs.theorem import diagnosis
from emrld_jax.runs.variants import differences


class DivergenceError(RuntimeError):
    """Training made a number that is not finite, in the runs with the indices `runs`."""

    def __init__(self, message: str, runs: Sequence[int]) -> None:
        super().__init__(message)
        self.runs = frozenset(runs)


def streams(key_data: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A run's keys: of the first parameters, the iterations (folded in), the final evaluation."""
    init_key, loop_key, evaluation_key = jax.random.split(jax.random.wrap_key_data(key_data), 3)
    return init_key, loop_key, evaluation_key


def initial(setup: Setup) -> Progressed:
    """A run before its first iteration."""
    key_data = jax.random.key_data(jax.random.key(setup.config.seed))
    return Progressed(setup.learner.init(streams(key_data)[0]), key_data, 0, 0)


class Standing:
    """Where runs stand that have done as many iterations; a state of each, [K], is on devices."""

    def __init__(
        self, states: MetaState, keys: np.ndarray, iteration: int, env_steps: Sequence[int]
    ) -> None:
        self.states, self.keys = states, keys
        self.iteration, self.env_steps = iteration, tuple(env_steps)

    def run(self, k: int) -> Progressed:
        """Where the k-th run stands, on the host."""
        state = jax.tree.map(lambda leaf: leaf[k], self._fetched)
        return Progressed(state, self.keys[k], self.iteration, self.env_steps[k])

    @cached_property
    def _fetched(self) -> MetaState:
        """All states in one transfer."""
        return jax.device_get(self.states)


class Together:
    """Runs that advance together, in one program on a mesh of devices."""

    def __init__(self, setups: Sequence[Setup], devices: Sequence[jax.Device]) -> None:
        """Assembles the program.

        Args:
            setups: of the runs, which may differ in seeds and in numbers of the algorithm.
            devices: that share the work.

        Raises:
            ConfigError: the devices cannot share the work, or not with `diagnostics`.
        """
        shared, part = setups[0], setups[0].demos.train
        tasks = part.demos.mask.shape[0]
        try:
            mesh = make_mesh(devices, len(setups), tasks)
        except ValueError as error:
            raise ConfigError(f"devices and processes: {error}") from error
        values = differences([setup.config for setup in setups])
        self._mesh, self._values = mesh, replicate(values, mesh)
        self._data = share_tasks((part.tasks, part.demos, shared.outer_demos), mesh)
        self._episodes = tasks * shared.config.adapt.num_episodes
        self._learners = side_by_side(lambda own: learner_with(shared, own).halves, mesh)
        wanted = shared.config.diagnostics
        self._diagnosis = diagnosis(setups, values, devices) if wanted else None

    def begin(self, runs: Sequence[Progressed]) -> Standing:
        """Runs, each where it stands, put on the devices. They have done as many iterations."""
        states = jax.tree.map(lambda *leaves: np.stack(leaves), *(run.state for run in runs))
        keys = np.stack([run.key for run in runs])
        env_steps = [run.env_steps for run in runs]
        return Standing(replicate(states, self._mesh), keys, runs[0].iteration, env_steps)

    def iterate(self, standing: Standing) -> tuple[Standing, list[dict[str, float]]]:
        """Where the runs stand after one more meta-iteration, and the metrics of each.

        Raises:
            DivergenceError: a metric or a parameter is not finite.
        """
        i = standing.iteration
        states, arrays = self._learners.update(*self._arguments(standing))
        metrics = _by_run(jax.device_get(arrays))
        _check_finite(i, metrics)
        if self._diagnosis is not None:
            found = self._diagnosis(standing.states.params, states.params, standing.keys, i)
            metrics = [{**own, **more} for own, more in zip(metrics, found, strict=True)]
        before = zip(standing.env_steps, metrics, strict=True)
        env_steps = [steps + self._steps(own) for steps, own in before]
        return Standing(states, standing.keys, i + 1, env_steps), metrics

    @property
    def shape(self) -> dict[str, int]:
        """How many devices share the learners, and how many the tasks of each."""
        return dict(self._mesh.shape)

    def compiled(self, standing: Standing) -> list[jax.stages.Compiled]:
        """The programs of the next meta-iteration, for who wants to know what they need."""
        return self._learners.compiled(*self._arguments(standing))

    def _arguments(self, standing: Standing) -> tuple[Any, ...]:
        keys = _iteration_keys(replicate(standing.keys, self._mesh), standing.iteration)
        return standing.states, keys, self._values, *self._data

    def _steps(self, metrics: dict[str, float]) -> int:
        """Environment steps of an iteration."""
        lengths = (value for name, value in metrics.items() if name.startswith("adapt/length_"))
        return sum(round(length * self._episodes) for length in lengths)


def _by_run(columns: dict[str, np.ndarray]) -> list[dict[str, float]]:
    """Metrics of each run, from a column [K] of each metric."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


@jax.jit
def _iteration_keys(key_data: jax.Array, i: int) -> jax.Array:
    """Keys of the runs' i-th iteration, [K]."""
    return jax.vmap(lambda own: jax.random.fold_in(streams(own)[1], i))(key_data)


def _check_finite(i: int, metrics: Sequence[dict[str, float]]) -> None:
    wrong = [[name for name, x in own.items() if not math.isfinite(x)] for own in metrics]
    runs = [k for k, names in enumerate(wrong) if names]
    if runs:
        names = sorted({name for own in wrong for name in own})
        raise DivergenceError(
            f"iteration {i + 1} made {', '.join(names)} infinite or NaN; the state before it is "
            "saved. A smaller adapt.learning_rate or meta.max_kl may help, in a new run.",
            runs,
        )
