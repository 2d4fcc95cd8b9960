"""What the tests of runs share: a demonstration file, tiny runs, and a compilation cache."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.runs.straight import write_demos

ROOT = Path(__file__).parents[2]
TINY = (
    "meta.iterations=3",
    "adapt.num_episodes=2",
    "policy.hidden_sizes=[8]",
    "env.horizon=20",
    "env.reward=dense",  # so that so few episodes move the parameters
    "evaluation_episodes=3",
    "checkpoint_every=1",
)

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables of a subprocess; compiled programs are shared between them."""
    return {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        "COLUMNS": "200",
    }


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demonstration file for Point2D: three training tasks, two held-out ones."""
    return write_demos(tmp_path_factory.mktemp("demos") / "lines.npz")


@pytest.fixture(scope="session")
def command(environment: dict[str, str]) -> Command:
    """Runs `python -m emrld_jax.<name> arguments` to its end."""

    def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", f"emrld_jax.{name}", *arguments],
            check=False,
            env=environment,
            capture_output=True,
            text=True,
            timeout=240,
        )

    return run


@pytest.fixture(scope="session")
def whole_run(
    command: Command, demos: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """A tiny run that was never interrupted: its folder and what it printed."""
    runs = tmp_path_factory.mktemp("whole")
    done = command("train", "env=point2d", f"demos={demos}", f"runs={runs}", *TINY)
    assert done.returncode == 0, done.stderr
    return runs / "point2d" / "emrld-lines" / "seed0", done.stdout
