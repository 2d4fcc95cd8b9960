"""On one core, too, a callback's arguments are copied while it waits for them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# JAX copies what it is given on another thread if it is of more than 100 kB and not aligned, and
# what has to wait for something else is computed on another thread, from where it calls back.
WAITS = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax
import jax.numpy as jnp
import numpy as np
import envs_jax  # for MuJoCo's engine is called back
unaligned = np.zeros(4_000_001, np.uint8)[1:].view(np.float32)

def called(x):
    return np.asarray(jax.device_put(unaligned))[:3] + x

@jax.jit
def before(matrix):
    for _ in range(20):
        matrix = matrix @ matrix
    return matrix

@jax.jit
def program(x, matrix):
    return jax.pure_callback(called, jax.ShapeDtypeStruct((3,), x.dtype), x + matrix[0, :3])

for _ in range(3):
    print(program(jnp.ones(3), before(jnp.zeros((700, 700)))))
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be bound here")
def test_a_callback_on_one_core_gets_its_arguments() -> None:
    given = {k: v for k, v in os.environ.items() if k != "NPROC"}
    done = subprocess.run(
        [sys.executable, "-c", WAITS],
        env={**given, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[1. 1. 1.]\n" * 3
