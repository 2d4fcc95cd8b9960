"""The hidden units' functions by name, as the trained network has them, in NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

SQRT_2_OVER_PI = float(np.sqrt(2 / np.pi))
GELU_CUBIC = 0.044715  # of the tanh form of GELU, which is the one that is trained with


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


def _silu(x: np.ndarray) -> np.ndarray:
    """x / (1 + exp(-x)), in a form that cannot overflow."""
    return 0.5 * x * (1.0 + np.tanh(0.5 * x))


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))


def _gelu(x: np.ndarray) -> np.ndarray:
    inner = SQRT_2_OVER_PI * (x + GELU_CUBIC * x * x * x)
    return 0.5 * x * (1.0 + np.tanh(inner))


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": _relu,
    "silu": _silu,
    "elu": _elu,
    "gelu": _gelu,
}
