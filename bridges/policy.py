"""The policy of a bundle in NumPy: what runs on a robot, where there is no JAX."""

from __future__ import annotations

from typing import Any

import numpy as np

from bridges.activations import ACTIVATIONS
from bridges.bundle import Bundle
from bridges.messages import BridgeError

LEAST_SQUARE = 1e-12  # of a length, so that nothing is divided by 0; as the environments have it


class Policy:
    """The Gaussian policy that a bundle's `policy` tensors make.

    It computes in float64: what it differs from the trained network's float32 by is then that
    network's own rounding, and none of NumPy's.

    Args:
        bundle: as `bridges.bundle.read` returns it.
    """

    def __init__(self, bundle: Bundle) -> None:
        numbers = {name: tensor.astype(np.float64) for name, tensor in bundle.tensors.items()}
        layers = range(len(bundle.policy.hidden_sizes) + 1)
        self._layers = [
            (numbers[f"policy/layer_{i}/kernel"], numbers[f"policy/layer_{i}/bias"]) for i in layers
        ]
        self._activation = ACTIVATIONS[bundle.policy.activation]
        self._squash = bundle.policy.squash
        self._std = np.exp(numbers["policy/log_std"])
        self._low, self._high = np.array(bundle.action.low), np.array(bundle.action.high)
        self._bounding = bundle.action.bounding
        self._names = tuple(bundle.observation.names)

    @property
    def std(self) -> np.ndarray:
        """The standard deviation of the actions, [A] in policy units."""
        return self._std.copy()

    def mean(self, obs: Any) -> np.ndarray:
        """The mean action at an observation, or at many. [.., O] -> [.., A], policy units.

        Raises:
            BridgeError: not O numbers, or one that is not finite.
        """
        x = np.asarray(obs, np.float64)
        if x.shape[-1:] != (len(self._names),):
            raise BridgeError(f"an observation must be ({', '.join(self._names)}), not {obs}")
        if not np.isfinite(x).all():
            raise BridgeError(f"an observation must be finite, not {obs}")
        if self._squash:
            x = np.arcsinh(x)
        for kernel, bias in self._layers[:-1]:
            x = self._activation(x @ kernel + bias)
        kernel, bias = self._layers[-1]
        action: np.ndarray = x @ kernel + bias
        return action

    def sample(self, obs: Any, generator: np.random.Generator) -> np.ndarray:
        """An action, or one at each observation. [.., O] -> [.., A], policy units.

        Raises:
            BridgeError: not O numbers, or one that is not finite.
        """
        mean = self.mean(obs)
        return mean + self._std * generator.standard_normal(mean.shape)

    def to_physical(self, action: Any) -> np.ndarray:
        """What is executed of an action in policy units, in physical ones, bounded.

        As the environment does it: each number within its bounds, or their length within the bound.
        [.., A] -> [.., A].
        """
        return bounded(np.asarray(action), self._low, self._high, self._bounding)


def bounded(action: np.ndarray, low: np.ndarray, high: np.ndarray, bounding: str) -> np.ndarray:
    """The physical action, [.., A], of one in policy units, bounded in the way of this name."""
    physical = low + 0.5 * (action + 1.0) * (high - low)
    if bounding == "box":
        return np.clip(physical, low, high)
    square = np.maximum(np.sum(physical**2, axis=-1, keepdims=True), LEAST_SQUARE)
    return physical * np.minimum(1.0, high[0] / np.sqrt(square))
