"""Times a bundle's policy as a robot runs it: a process without JAX, on one core."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bridges import bundle
from bridges.policy import Policy


def main() -> None:
    """Prints microseconds of each call, by what was called. Arguments: a bundle, how many calls."""
    path, calls = sys.argv[1], int(sys.argv[2])
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    policy, generator = Policy(bundle.read(path)), np.random.default_rng(0)
    size = len(bundle.read(path).observation.names)
    seen = generator.uniform(-2, 2, (calls, size)).tolist()
    acting: dict[str, Callable[[Any], Any]] = {
        "mean action": lambda obs: policy.to_physical(policy.mean(obs)),
        "sampled action": lambda obs: policy.to_physical(policy.sample(obs, generator)),
    }
    print(json.dumps({name: _times(act, seen) for name, act in acting.items()}))
    if "jax" in sys.modules:
        raise SystemExit("the policy brought JAX along")


def _times(act: Callable[[Any], Any], seen: list[Any]) -> list[float]:
    for obs in seen[:100]:
        act(obs)
    times = []
    for obs in seen:
        began = time.perf_counter()
        act(obs)
        times.append(1e6 * (time.perf_counter() - began))
    return times


if __name__ == "__main__":
    main()
