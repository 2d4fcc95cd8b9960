"""Learning curves compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from emrld_jax.runs.metrics import read_metrics

NAMES = ("adapt/return_0", "adapt/return_1")


def assert_same_curve(ours: Path, theirs: Path, later: float = 1e-5) -> None:
    """Up to rounding; `later` is the tolerance after the first iteration."""
    own_records, their_records = (read_metrics(run / "metrics.jsonl") for run in (ours, theirs))
    for number, (own, expected) in enumerate(zip(own_records, their_records, strict=True)):
        for name in NAMES:
            rtol = later if number else 1e-5
            np.testing.assert_allclose(own[name], expected[name], rtol=rtol, err_msg=name)
    assert_same_step(own_records[0], their_records[0])


def assert_same_step(ours: dict[str, float], theirs: dict[str, float]) -> None:
    """A first meta-step, up to rounding."""
    for name in ("outer/gradient_norm", "outer/params_norm", "outer/kl"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-4, err_msg=name)


def assert_other_curve(ours: Path, theirs: Path) -> None:
    first, second = (read_metrics(folder / "metrics.jsonl")[1] for folder in (ours, theirs))
    assert abs(first[NAMES[1]] / second[NAMES[1]] - 1) > 1e-4
