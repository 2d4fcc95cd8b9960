"""How many threads JAX has on a CPU."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """How many cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def at_least(threads: int) -> None:
    """Gives JAX so many threads, if it would have fewer: one for each core that may be used.

    Where some threads wait for what others do, all wait forever if there are too few of them. It
    has no effect once JAX has been used, or where the variable NPROC is set already.
    """
    if usable_cores() < threads:
        os.environ.setdefault("NPROC", str(threads))
