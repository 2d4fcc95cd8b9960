"""A policy's parameters as a bundle's tensors, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bridges.bundle import Bundle
from bridges.tensor_file import Tensors


def tensors_of(params: Mapping[str, Any], log_std: Any, part: str) -> Tensors:
    """The tensors of a policy that `emrld_jax.policy.gaussian_policy` made.

    Args:
        params: its parameters.
        log_std: the logarithm of its standard deviation, [A], whether it is a parameter or not.
        part: what comes before their names, "policy" or "meta".
    """
    named = {
        f"{part}/{layer}/{name}": np.asarray(value, np.float32)
        for layer, values in params["params"].items()
        for name, value in values.items()
    }
    return {**named, f"{part}/log_std": np.asarray(log_std, np.float32)}


def params_of(bundle: Bundle, part: str) -> dict[str, Any]:
    """The inverse of `tensors_of`: parameters that the bundle's algorithm works with."""
    layers: dict[str, dict[str, np.ndarray]] = {}
    for i in range(len(bundle.policy.hidden_sizes) + 1):
        place = f"{part}/layer_{i}"
        layers[f"layer_{i}"] = {
            name: bundle.tensors[f"{place}/{name}"] for name in ("kernel", "bias")
        }
    params: dict[str, Any] = {"params": layers}
    if bundle.settings["policy"]["learn_std"]:
        params["log_std"] = bundle.tensors[f"{part}/log_std"]
    return params
