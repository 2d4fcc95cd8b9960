"""What a benchmark of speed measures, and where its numbers come from."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from typing import Any

from emrld_jax import algorithms
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.fields import setting
from emrld_jax.runs.provenance import machine, software
from envs_jax import names


@dataclass
class Choice:
    """The settings that benchmarks of speed share."""

    env: str = setting("point2d", "the environment", choices=names())
    algo: str = setting("emrld", "the algorithm", choices=algorithms.names())
    demos: str = setting("optimal", "the shipped demonstrations", choices=QUALITIES)


def chosen(choice: Choice) -> list[str]:
    """The choice as arguments of `emrld_jax.train`."""
    return [f"env={choice.env}", f"algo={choice.algo}", f"demos={choice.demos}"]


def origin(module: str) -> dict[str, Any]:
    """The command, code, packages and machine of this process, as JSON values."""
    command = shlex.join(["python", "-m", f"benchmarks.{module}", *sys.argv[1:]])
    return {"command": command, **software(), "machine": machine()}
