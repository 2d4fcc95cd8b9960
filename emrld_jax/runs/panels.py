"""What pictures of episodes share."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from emrld_jax.demos import DemoSet

BEFORE, AFTER = "#8c8c8c", "#1f5fa8"


class Panel(NamedTuple):
    """Some episodes of each of M tasks."""

    title: str
    demos: DemoSet
    obs: Any  # [M, P, T, O]
    mask: Any  # [M, P, T]


def save(figure: Figure, path: Path) -> None:
    """Writes a picture as .png and .svg."""
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=150)
