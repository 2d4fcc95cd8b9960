"""How long training takes from the command to its first iteration."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from benchmarks.timing import Row


def start_up(chosen: Sequence[str]) -> list[Row]:
    """From the command to the end of the first iteration, with an empty cache and with its own."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/compiled",
            # this process has most of an accelerator's memory: take of the rest what is needed
            "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        }
        return [
            Row(
                f"start to first iteration, {what}",
                "s",
                [_first_iteration(chosen, folder, environment)],
            )
            for what in ("nothing compiled before", "compiled before")
        ]


def _first_iteration(chosen: Sequence[str], folder: str, environment: dict[str, str]) -> float:
    command = [sys.executable, "-m", "emrld_jax.train", *chosen, f"runs={folder}/runs"]
    began = time.perf_counter()
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("iteration 1/"):
                seconds_taken = time.perf_counter() - began
                process.kill()
                return seconds_taken
    raise SystemExit(f"{' '.join(command)} ended before its first iteration")
