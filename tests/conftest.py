"""What all tests share. It configures JAX before any test module imports it."""

from __future__ import annotations

import os
from pathlib import Path

# Set in the environment as well, so that commands which a test starts run on the CPU too. Two
# threads: the arrays are small, and more threads only fight over the cores of a shared machine.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")

import jax
import pytest

jax.config.update("jax_platforms", "cpu")
# A shape that broadcasts by accident is an error, not a wrong number.
jax.config.update("jax_numpy_rank_promotion", "raise")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def paper_demos() -> Path:
    """The folder of the paper's published trajectories, which are not a part of the project."""
    folder = ROOT.parent / "shared" / "data" / "paper_demos"
    if not folder.is_dir():
        pytest.skip("the paper's published demonstrations are not on this machine")
    return folder
