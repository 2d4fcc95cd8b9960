"""The bundle: a trained policy, all that its robot must know, and what adapting it needs.

One file for one task, in the safetensors format (docs/bridge/bundles.md has its layout). NumPy is
all that this module needs.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from bridges.bundle_checks import check_about, check_tensors
from bridges.files import write_bytes
from bridges.messages import BridgeError
from bridges.tensor_file import Tensors, from_bytes, parse_json, tensor_bytes, to_bytes

FORMAT = "emrld-policy"
VERSION = 1
KEY = "emrld"  # of the file's metadata, under which a bundle's JSON is
MAX_BYTES = 256 * 2**20  # of a file


class Environment(NamedTuple):
    """What the policy was trained in."""

    name: str
    parameters: dict[str, Any]  # envs_jax.make(name, **parameters) makes it


class Observation(NamedTuple):
    """What the policy sees, O numbers."""

    names: list[str]
    units: list[str]


class Action(NamedTuple):
    """What the policy does, A numbers."""

    names: list[str]
    units: list[str]  # of the physical action
    low: list[float]  # in these units; policy action -1
    high: list[float]  # policy action +1
    bounding: str  # "box": each number within low and high; "norm": the length within high


class Zone(NamedTuple):
    """Where a task in the plane pays, and where its episodes end."""

    goal: list[float]  # [2], m
    reward: str  # "sparse" or "dense"
    reward_radius: float  # m around the goal
    success: str  # "square" or "disc" around the goal
    success_size: float  # m, half the square's width or the disc's radius
    arena: float | None  # m: an episode ends where |x| or |y| exceeds it; None: nowhere
    horizon: int  # steps of an episode


class Network(NamedTuple):
    """The network that gives the mean action."""

    hidden_sizes: list[int]
    activation: str
    squash: bool  # it sees arcsinh of the observation


class Stage(NamedTuple):
    """How far adaptation to the task has come."""

    recordings: int  # inner steps whose episodes it has used
    adapted: bool  # it is done; otherwise `policy` is what collects the next episodes


@dataclass(frozen=True, eq=False)
class Bundle:
    """A policy for one task.

    Attributes:
        environment: what it was trained in.
        task: the task's numbers by name, such as {"residual_angular_velocity": -0.65} (rad a
            control period) or {"goal": [2.0, 0.0]} (m).
        zone: where the task pays; None if it is not in the plane.
        observation: what the policy sees.
        action: what it does.
        control_period: s between two actions.
        policy: the network.
        algorithm: that trained it, and adapts it.
        settings: the algorithm's, whole, as nested mappings (`emrld_jax.settings.Settings`).
        seed: of the training run.
        stage: how far adaptation has come.
        provenance: where all of this comes from, as JSON values.
        tensors: float32, by name: `policy/layer_0/kernel` [O, H], `policy/layer_0/bias` [H], ..,
            `policy/log_std` [A] of what acts now; the same under `meta/` of what adaptation starts
            from; `demos/obs` [N, O] and `demos/action` [N, A] (policy units), the demonstration.
    """

    environment: Environment
    task: dict[str, Any]
    zone: Zone | None
    observation: Observation
    action: Action
    control_period: float
    policy: Network
    algorithm: str
    settings: dict[str, Any]
    seed: int
    stage: Stage
    provenance: dict[str, Any]
    tensors: Tensors

    @property
    def content_sha256(self) -> str:
        """The hash of all that the bundle says and holds; equal bundles have the same."""
        return _content_hash(_about(self), self.tensors)


def about_text(bundle: Bundle) -> str:
    """All that a bundle says besides its tensors, as JSON with the content's hash."""
    about = _about(bundle)
    return _canonical({**about, "content_sha256": _content_hash(about, bundle.tensors)})


def read(path: str | Path) -> Bundle:
    """Reads a bundle.

    Raises:
        BridgeError: there is no such file, or it is refused; says which file and why.
    """
    path = Path(path)
    if path.is_dir():
        raise BridgeError(
            f"{path} is a folder; a bundle is a file. Of a training run it is made by: python -m "
            f"emrld_jax.export run={path} out=policy.safetensors"
        )
    if not path.is_file():
        raise BridgeError(f"{path}: there is no such file")
    with path.open("rb") as file:
        if (size := os.fstat(file.fileno()).st_size) > MAX_BYTES:
            raise BridgeError(f"{path} has {size} bytes; at most {MAX_BYTES} are allowed")
        data = file.read(MAX_BYTES)
    try:
        return decode(data)
    except BridgeError as error:
        raise BridgeError(f"{path} is refused: {error}") from error


def write(path: str | Path, bundle: Bundle) -> None:
    """Writes a bundle, all of it or nothing, in place of what is there; makes its folder.

    Raises:
        BridgeError: `read` would refuse it.
        OSError: it cannot be written.
    """
    write_bytes(Path(path), encode(bundle))


def encode(bundle: Bundle) -> bytes:
    """The bytes of a bundle's file.

    Raises:
        BridgeError: `decode` would refuse them.
    """
    data = to_bytes({KEY: about_text(bundle)}, bundle.tensors)
    decode(data)
    return data


def decode(data: bytes) -> Bundle:
    """The bundle that a file's bytes hold.

    Raises:
        BridgeError: they are refused; says why.
    """
    metadata, tensors = from_bytes(data)
    if metadata.keys() != {KEY}:
        raise BridgeError(f"it is no {FORMAT} bundle: its metadata must hold {KEY!r} and no more")
    about = parse_json(metadata[KEY], f"its metadata {KEY!r}")
    _check_version(about)
    if about.pop("content_sha256", None) != _content_hash(about, tensors):
        raise BridgeError("it was damaged or changed: its content is not what its hash says")
    about = {name: value for name, value in about.items() if name not in _FORMAT}
    check_about(about)
    check_tensors(about, tensors)
    return Bundle(**{name: _typed(name, value) for name, value in about.items()}, tensors=tensors)


_FORMAT = {"format": FORMAT, "version": VERSION}
_SECTIONS: dict[str, Any] = {
    "environment": Environment,
    "zone": Zone,
    "observation": Observation,
    "action": Action,
    "policy": Network,
    "stage": Stage,
}


def _check_version(about: dict[str, Any]) -> None:
    if about.get("format") != FORMAT:
        raise BridgeError(f"it is no bundle: its format must be {FORMAT!r}")
    version = about.get("version")
    if type(version) is not int or version != VERSION:
        raise BridgeError(
            f"it has version {version!r} of the format; this program reads version {VERSION}"
        )


def _typed(name: str, value: Any) -> Any:
    return _SECTIONS[name](**value) if name in _SECTIONS and value is not None else value


def _about(bundle: Bundle) -> dict[str, Any]:
    """What a bundle says besides its tensors, as JSON values."""
    values = {item.name: getattr(bundle, item.name) for item in fields(bundle)}
    del values["tensors"]
    sections = {
        name: value._asdict() if name in _SECTIONS and value is not None else value
        for name, value in values.items()
    }
    return {**_FORMAT, **sections}


def _content_hash(about: dict[str, Any], tensors: Tensors) -> str:
    """SHA-256 of what a bundle says and of its tensors' names, shapes and numbers."""
    shapes = [[name, "F32", list(tensors[name].shape)] for name in sorted(tensors)]
    digest = hashlib.sha256(_canonical({"about": about, "tensors": shapes}).encode())
    for name in sorted(tensors):
        digest.update(tensor_bytes(tensors[name]))
    return digest.hexdigest()


def _canonical(value: Any) -> str:
    """One text for equal JSON values."""
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise BridgeError(f"it says what JSON cannot ({error})") from error
