"""What the tests of runs share: a demonstration file and tiny runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import Command
from tests.runs.straight import write_demos

TINY = (
    "meta.iterations=3",
    "adapt.num_episodes=2",
    "policy.hidden_sizes=[8]",
    "env.horizon=20",
    "env.reward=dense",  # so that so few episodes move the parameters
    "evaluation_episodes=3",
    "checkpoint_every=1",
)
SHORT = "meta.cg_iterations=3"  # of TRPO; ten make rounding visible on so small a problem


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demonstration file for Point2D: three training tasks, two held-out ones."""
    return write_demos(tmp_path_factory.mktemp("demos") / "lines.npz")


@pytest.fixture(scope="session")
def whole_run(
    command: Command, demos: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """A tiny run that was never interrupted: its folder and what it printed."""
    runs = tmp_path_factory.mktemp("whole")
    done = command("train", "env=point2d", f"demos={demos}", f"runs={runs}", *TINY)
    assert done.returncode == 0, done.stderr
    return runs / "point2d" / "emrld-lines" / "seed0", done.stdout


@pytest.fixture(scope="session")
def even_demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four training tasks, which two and four devices can share."""
    return write_demos(tmp_path_factory.mktemp("even") / "lines.npz", num_train=4)


@pytest.fixture(scope="session")
def start(even_demos: Path) -> tuple[str, ...]:
    return ("env=point2d", f"demos={even_demos}", *TINY, SHORT)


@pytest.fixture(scope="session")
def alone(
    command: Command, start: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run of seed 0 on one device."""
    runs = tmp_path_factory.mktemp("alone")
    done = command("train", *start, f"runs={runs}")
    assert done.returncode == 0, done.stderr
    return runs / "point2d" / "emrld-lines" / "seed0"
