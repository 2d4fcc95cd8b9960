"""How fast everything is: environments, adaptation, and where a meta-iteration's time goes.

`python -m benchmarks.throughput env=point2d` measures at the first parameters, when all episodes
last to the horizon; `run=RUN_DIR` at those of a run, when they end early.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from benchmarks.basics import matrix_rate, rollouts
from benchmarks.choice import Choice, chosen, origin
from benchmarks.meta_step import Bench
from benchmarks.records import named, write_record
from benchmarks.startup import start_up
from benchmarks.timing import Row, body, table
from emrld_jax.fields import setting
from emrld_jax.meta.learner import MetaState
from emrld_jax.runs import cli
from emrld_jax.runs.checkpoints import Checkpoints
from emrld_jax.runs.config import ConfigError, check_config
from emrld_jax.runs.iteration import initial
from emrld_jax.runs.machines import split_cpu
from emrld_jax.runs.saved import load_config
from emrld_jax.runs.setup import Setup, set_up
from envs_jax.base import REWARDS
from envs_jax.physics import BACKENDS


@dataclass
class ThroughputConfig(Choice):
    """All settings of the measurement."""

    reward: str = setting(
        "sparse", "dense: adaptation has to weigh every step from the start", choices=REWARDS
    )
    run: str | None = setting(None, "run folder whose parameters are taken; null: the first ones")
    num_seeds: list[int] = setting(
        [1], "seeds trained side by side in one program: each of these numbers", at_least=1
    )
    devices: int = setting(1, "devices that share them; a CPU is split into as many", at_least=1)
    backend: str | None = setting(
        None,
        "half_cheetah's physics; both: mujoco's, and beside it how fast mjx collects",
        choices=(*BACKENDS, "both"),
    )
    simulations: list[int] = setting(
        [], "also how fast as many of half_cheetah's simulations at once are", at_least=2
    )
    repetitions: int = setting(9, "of each measurement", at_least=2)


def _setup_and_state(config: ThroughputConfig) -> tuple[Setup, MetaState]:
    """What is measured, and where."""
    if config.run is None:
        arguments = [*chosen(config), f"env.reward={config.reward}"]
        if config.backend is not None:
            arguments.append(f"env.backend={_main_backend(config)}")
        setup = set_up(cli.train_config(arguments))
        return setup, initial(setup).state
    folder = Path(config.run)
    setup = set_up(load_config(folder / "config.yaml"))
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        restored = checkpoints.restore(initial(setup), print)
    if restored is None:
        raise SystemExit(f"{folder} has no checkpoint")
    return setup, restored.state


def _main_backend(config: ThroughputConfig) -> str | None:
    return "mujoco" if config.backend == "both" else config.backend


def _other_rollouts(bench: Bench, config: ThroughputConfig) -> list[Row]:
    """Rollouts with the other backend, and with other numbers of simulations at once."""
    env: Any = bench.setup.env
    backends = ("mujoco", "mjx") if config.backend == "both" else (config.backend,)
    own = [replace(env, backend=backend) if backend else env for backend in backends]
    tasks, number = bench.part.tasks, bench.tasks * bench.adapt.num_episodes
    wanted = [(other, tasks, number) for other in own[1:]]
    wanted += [(other, env.test_tasks(), n) for other in own for n in config.simulations]
    rows = []
    for other, tasks, number in wanted:
        episodes = number // jax.tree.leaves(tasks)[0].shape[0]
        policy, params = bench.setup.learner.policy, bench.state.params
        found = rollouts(other, policy, params, tasks, episodes, config.repetitions)
        words = f", {other.backend}, {number} simulations at once"
        rows += [row._replace(what=row.what + words) for row in found]
    return rows


def main() -> int:
    """Measures and writes the table."""
    values = cli.parse(sys.argv[1:], ThroughputConfig(), {})
    config = cli.updated(ThroughputConfig(), values)
    check_config(config)
    if config.run and config.backend:
        raise ConfigError("backend has no effect with run: a run has its own")
    if any(number % 2 for number in config.simulations):
        raise ConfigError(f"simulations={config.simulations}: even numbers, for two directions")
    if not config.num_seeds:
        raise ConfigError("num_seeds=[] is not allowed: name one number or more")
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured too
    if config.devices > 1:
        split_cpu(config.devices)
    bench = Bench(*_setup_and_state(config), config.repetitions)
    wide = max(bench.setup.config.policy.hidden_sizes)
    steps = bench.steps // bench.tasks
    peak = matrix_rate(bench.tasks, steps, wide, config.repetitions)
    rows: list[Row] = []
    complete = False
    try:
        for found in _measurements(bench, config, peak):
            if found:
                print(body(found), flush=True)  # the whole takes minutes
            rows += found
        complete = True
    finally:
        if rows:  # also what was measured before an interruption
            _write(bench, config, rows, complete)
    return 0


def _write(bench: Bench, config: ThroughputConfig, rows: list[Row], complete: bool) -> None:
    ran = bench.setup.config
    found = [row._asdict() for row in rows]
    record = {**origin("throughput"), "complete": complete, "rows": found}
    text = table(rows) if complete else f"Stopped before its end.\n\n{table(rows)}"
    where = "trained" if config.run else config.reward
    numbers = "-".join(map(str, config.num_seeds))
    seeds = f"-seeds{numbers}" * (config.num_seeds != [1])
    backend = f"-{config.backend}" if config.backend else ""
    write_record(named(f"throughput-{ran.env.name}-{where}{backend}{seeds}"), record, text)


def _measurements(bench: Bench, config: ThroughputConfig, peak: Row) -> Iterator[list[Row]]:
    """All rows of the table, as they are measured."""
    setup = bench.setup
    ran, policy = setup.config, setup.learner.policy
    yield [peak]
    number = bench.adapt.num_episodes
    yield rollouts(
        setup.env, policy, bench.state.params, bench.part.tasks, number, config.repetitions
    )
    yield _other_rollouts(bench, config)
    yield [bench.adaptations()]
    yield bench.iterations()
    yield bench.matrix_share(peak, f"1 of {ran.meta.fisher_every} steps")
    yield bench.matrix_share(peak, "every step", fisher_every=1)
    for num_seeds in config.num_seeds:
        yield bench.side_by_side(num_seeds, config.devices)
    yield _peak_memory()
    yield start_up([f"env={ran.env.name}", f"algo={ran.algo}", f"demos={ran.demos}"])


def _peak_memory() -> list[Row]:
    """Of the process, and of an accelerator."""
    of_process = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rows = [Row("peak memory of the process", "MiB", [of_process])]
    if counted := jax.devices()[0].memory_stats():  # a CPU counts none
        rows.append(Row("peak memory of the device", "MiB", [counted["peak_bytes_in_use"] / 2**20]))
    return rows


if __name__ == "__main__":
    cli.run_command(main)
