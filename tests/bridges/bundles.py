"""Bundles for tests, made without JAX, and files that say what no bundle would."""

from __future__ import annotations

import hashlib
import json
from itertools import pairwise
from typing import Any

import numpy as np

from bridges.bundle import Action, Bundle, Environment, Network, Observation, Stage, Zone


def a_bundle(
    observations: int = 3,
    actions: int = 2,
    hidden_sizes: tuple[int, ...] = (8,),
    activation: str = "tanh",
    squash: bool = False,
    bounding: str = "box",
    seed: int = 0,
) -> Bundle:
    """A bundle with random weights; by default of a robot that drifts."""
    rng = np.random.default_rng(seed)
    sizes = (observations, *hidden_sizes, actions)
    tensors = {}
    for part in ("policy", "meta"):
        for i, (rows, columns) in enumerate(pairwise(sizes)):
            spread = np.sqrt(2 / (rows + columns))  # as networks begin
            tensors[f"{part}/layer_{i}/kernel"] = spread * rng.normal(size=(rows, columns))
            tensors[f"{part}/layer_{i}/bias"] = 0.1 * rng.normal(size=columns)
        tensors[f"{part}/log_std"] = np.full(actions, np.log(0.3))
    tensors["demos/obs"] = rng.normal(size=(5, observations))
    tensors["demos/action"] = rng.uniform(-1, 1, (5, actions))
    low = [-0.1, -0.1] if bounding == "norm" else [0.0, *[-1.5] * (actions - 1)]
    high = [0.1, 0.1] if bounding == "norm" else [0.15, *[1.5] * (actions - 1)]
    names = [f"seen_{i}" for i in range(observations)]
    settings: dict[str, Any] = {"w_rl": 0.2, "policy": {"learn_std": False}}
    drives = observations == 3 and actions == 2
    return Bundle(
        environment=Environment("two_wheeled_drift", {"reward": "sparse", "horizon": 100}),
        task={"residual_angular_velocity": -0.65},
        zone=Zone([2.0, 1.0], "sparse", 0.5, "square", 0.1, 2.5, 100),
        observation=Observation(
            ["x", "y", "theta"] if drives else names,
            ["m", "m", "rad"] if drives else ["1"] * observations,
        ),
        action=Action(
            ["linear_velocity", "angular_velocity"] if drives else [*map(str, range(actions))],
            ["m/s", "rad/s"] if drives else ["1"] * actions,
            low,
            high,
            bounding,
        ),
        control_period=0.5,
        policy=Network(list(hidden_sizes), activation, squash),
        algorithm="emrld",
        settings=settings,
        seed=7,
        stage=Stage(0, False),
        provenance={"by": "a test"},
        tensors={name: tensor.astype(np.float32) for name, tensor in tensors.items()},
    )


def content_hash(about: dict[str, Any], tensors: dict[str, np.ndarray]) -> str:
    """The hash, from the words of docs/bridge/bundles.md."""
    said = {name: value for name, value in about.items() if name != "content_sha256"}
    listed = [[name, "F32", list(tensors[name].shape)] for name in sorted(tensors)]
    text = json.dumps(
        {"about": said, "tensors": listed}, sort_keys=True, separators=(",", ":"), allow_nan=False
    )
    return hashlib.sha256(
        text.encode() + b"".join(tensors[name].astype("<f4").tobytes() for name in sorted(tensors))
    ).hexdigest()


def file_bytes(header: Any, body: bytes) -> bytes:
    """A safetensors file with this header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + body


def forged(about: dict[str, Any], tensors: dict[str, np.ndarray]) -> bytes:
    """A file of a whole bundle with a right hash, whatever it says."""
    about = {**about, "content_sha256": content_hash(about, tensors)}
    header: dict[str, Any] = {"__metadata__": {"emrld": json.dumps(about)}}
    end = 0
    for name, tensor in tensors.items():
        offsets = [end, end := end + 4 * tensor.size]
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": offsets}
    return file_bytes(header, b"".join(x.astype("<f4").tobytes() for x in tensors.values()))
