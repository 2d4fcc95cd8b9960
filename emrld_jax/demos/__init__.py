"""Demonstrations: the file format, replay, and where files are found."""

from __future__ import annotations

from emrld_jax.demos.archive import DemoError
from emrld_jax.demos.format import (
    DemoFile,
    DemoSet,
    check_same_tasks,
    check_tasks,
    empty,
    load,
    provenance,
    save,
)
from emrld_jax.demos.replay import replay, replayed
from emrld_jax.demos.shipped import resolve

__all__ = [
    "DemoError",
    "DemoFile",
    "DemoSet",
    "check_same_tasks",
    "check_tasks",
    "empty",
    "load",
    "provenance",
    "replay",
    "replayed",
    "resolve",
    "save",
]
