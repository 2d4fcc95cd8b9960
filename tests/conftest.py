"""What all tests share. It configures JAX before any test module imports it."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Set in the environment as well, so that commands which a test starts run on the CPU too. Two
# threads: the arrays are small, and more threads only fight over the cores of a shared machine.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")
# Most of the time goes into compiling programs that run once: without most optimizations, and
# with XLA's older code for fused operations, which is compiled in less than half the time (and
# is gone from JAX 0.11, which ends the process at a flag that it does not know).
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
if importlib.metadata.version("jax").startswith("0.10."):
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {flags}"

import jax
import pytest

from tests.forking import Server

jax.config.update("jax_platforms", "cpu")
# A shape that broadcasts by accident is an error, not a wrong number.
jax.config.update("jax_numpy_rank_promotion", "raise")

ROOT = Path(__file__).resolve().parents[1]
LONG = ("runs", "study", "algorithms", "test_examples.py")  # start many processes, or compile much


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes long begins first, so that the test processes end at about the same time."""
    items.sort(key=lambda item: item.path.relative_to(ROOT / "tests").parts[0] not in LONG)


def compiled(jitted: Any) -> int:
    """How many versions of a jitted function there are."""
    return int(jitted._cache_size())


Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def paper_demos() -> Path:
    """The folder of the paper's published trajectories, which are not a part of the project."""
    folder = ROOT.parent / "shared" / "data" / "paper_demos"
    if not folder.is_dir():
        pytest.skip("the paper's published demonstrations are not on this machine")
    return folder


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables of a subprocess; compiled programs are shared between them."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # that of all test processes
    return {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        "COLUMNS": "200",
    }


@pytest.fixture(scope="session")
def command(environment: dict[str, str]) -> Iterator[Command]:
    """Runs what `python -m emrld_jax.<name> arguments` does to its end, in a process of its own."""
    server = Server(environment)
    yield lambda name, *arguments: server.run(f"emrld_jax.{name}", arguments)
    server.close()
