"""How fast and how exact policies are in NumPy: `python -m benchmarks.bridge_policy`.

Of untrained networks of the environments' default sizes, and of a run's policy with `run=RUN_DIR`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from benchmarks.choice import origin
from benchmarks.records import write_record
from benchmarks.timing import Row, table
from bridges import bundle
from bridges.exporting import Exported, bundled, export
from bridges.policy import Policy
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import check_config
from emrld_jax.runs.setup import set_up

ENVIRONMENTS = ("point2d", "two_wheeled_drift", "half_cheetah")
OBSERVATIONS = 10_000
PERCENTILES = (50, 99)
IMPORT = "import time; began = time.perf_counter(); import {}; print(time.perf_counter() - began)"


@dataclass
class BridgePolicyConfig:
    """All settings of this benchmark."""

    run: str | None = setting(None, "run folder whose policy is measured too")
    calls: int = setting(20_000, "actions that are timed", at_least=100)
    repetitions: int = setting(10, "imports that are timed", at_least=1)


def main() -> int:
    """Measures and writes the table."""
    config = cli.updated(BridgePolicyConfig(), cli.parse(sys.argv[1:], BridgePolicyConfig(), {}))
    check_config(config)
    rows = [importing(module, config.repetitions) for module in ("numpy", "bridges.policy")]
    for name, exported in _policies(config):
        rows += [*acting(name, exported.bundle, config.calls), *differences(name, exported)]
    record = {**origin("bridge_policy"), "rows": [row._asdict() for row in rows]}
    write_record("bridge_policy", record, table(rows))
    return 0


def _policies(config: BridgePolicyConfig) -> Iterator[tuple[str, Exported]]:
    for name in ENVIRONMENTS:
        yield f"{name}, untrained", untrained(name)
    if config.run:
        yield config.run, export(config.run)


def untrained(name: str) -> Exported:
    """A network of an environment's default size, with random weights and biases."""
    setup, rng = set_up(cli.train_config([f"env={name}"])), np.random.default_rng(0)
    params = jax.tree.map(
        lambda x: x + 0.1 * rng.normal(size=x.shape).astype(np.float32),
        setup.learner.init(jax.random.key(0)).params,
    )
    return bundled(setup, params, setup.demos.test, 0, {})


def importing(module: str, repetitions: int) -> Row:
    """How long a new process imports a module; the first import, which may read the disk, apart."""
    command = [sys.executable, "-c", IMPORT.format(module)]
    times = [
        float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        for _ in range(repetitions + 1)
    ]
    return Row(f"import {module}", "s", times[1:])


def acting(name: str, made: bundle.Bundle, calls: int) -> list[Row]:
    """How long an action takes: observation to bounded physical action, on one core."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.safetensors"
        bundle.write(path, made)
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.acting", str(path), str(calls)],
            check=True,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
    return [
        Row(f"{name}: {what}, {percentile} % within", "us", [float(np.percentile(t, percentile))])
        for what, t in json.loads(done.stdout).items()
        for percentile in PERCENTILES
    ]


def differences(name: str, exported: Exported) -> list[Row]:
    """How far mean actions are from JAX's float32, and JAX's own from each other."""
    shown = exported.bundle.tensors["demos/obs"]
    low, high = shown.min(axis=0), shown.max(axis=0)
    span, rng = high - low + 0.1, np.random.default_rng(1)
    obs = rng.uniform(low - span, high + span, (OBSERVATIONS, low.size)).astype(np.float32)
    batch, executed = exported.act(obs)
    alone = np.concatenate([exported.act(one[None])[0] for one in obs])
    policy = Policy(exported.bundle)
    exact = policy.mean(obs)
    pairs = {
        "NumPy from JAX, one at a time": (exact, alone),
        "NumPy from JAX, all at once": (exact, batch),
        "NumPy from JAX, of what is executed": (policy.to_physical(exact), executed),
        "JAX from JAX, one at a time from all at once": (alone, batch),
    }
    rows = [
        Row(f"{name}: {words}, largest", "1e-6", [float(1e6 * np.max(np.abs(a - b)))])
        for words, (a, b) in pairs.items()
    ]
    return [*rows, Row(f"{name}: largest mean action", "1", [float(np.max(np.abs(exact)))])]


if __name__ == "__main__":
    cli.run_command(main)
