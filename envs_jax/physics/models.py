"""MuJoCo models that Gymnasium ships, compiled from where it is installed."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

PACKAGES = ("mujoco", "gymnasium")  # whose versions decide what is compiled
EXTRA = "mujoco"  # of this project, which brings them

# Arrays of a model that decide how it moves, and those among them that do not: how it looks,
# what belongs to users, where things lie in other arrays.
PHYSICAL = ("actuator_", "body_", "dof_", "geom_", "jnt_", "qpos")
OTHER = ("user", "group", "rgba", "matid", "castshadow", "plugin", "adr", "bvhnum", "dataid")
# `fingerprint` of the models that our demonstrations and results were made with
RECORDED: dict[str, dict[str, str]] = json.loads(
    (Path(__file__).parent / "recorded_models.json").read_text()
)

_handler_lock = RLock()


class MissingPackageError(ImportError):
    """A package is not installed; the message names the extra that brings it."""


class ModelChangedWarning(UserWarning):
    """A compiled model is not the one that this project's results were made with."""


def check_installed(packages: Sequence[str]) -> None:
    """Looks for packages, or modules right in one, without importing them.

    Raises:
        MissingPackageError: one is not there.
    """
    for package in packages:
        if not _is_installed(package):
            raise MissingPackageError(
                f"{package} is not installed: pip install 'emrld-jax[{EXTRA}]'"
            )


def load_model(name: str) -> Any:
    """A model of Gymnasium's, compiled: a `mujoco.MjModel`.

    Warns:
        ModelChangedWarning: it is not the one that this project's results were made with.

    Raises:
        MissingPackageError: MuJoCo or Gymnasium is not installed.
    """
    check_installed(PACKAGES)
    import mujoco  # noqa: PLC0415

    with silent_mujoco():
        model = mujoco.MjModel.from_xml_path(str(_assets() / f"{name}.xml"))
    found, recorded = fingerprint(model), RECORDED[name]
    if changed := [key for key in recorded if recorded[key] != found.get(key)]:
        versions = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
        warnings.warn(
            f"{name}: the model that {versions} compile differs in {', '.join(changed)} from the "
            "one that this project's demonstrations and results were made with",
            ModelChangedWarning,
            stacklevel=2,
        )
    return model


def fingerprint(model: Any) -> dict[str, str]:
    """A short hash of each array that decides how a model moves, to six significant digits.

    Arrays without an element are left out.
    """
    arrays = {f"opt.{name}": getattr(model.opt, name) for name in _public(model.opt)}
    arrays |= {
        name: getattr(model, name)
        for name in _public(model)
        if name.startswith(PHYSICAL) and not name.endswith(OTHER)
    }
    return {
        name: _hash(np.asarray(value))
        for name, value in arrays.items()
        if not callable(value) and np.size(value)
    }


def _public(owner: Any) -> list[str]:
    return [name for name in dir(owner) if not name.startswith("_")]


def _hash(array: np.ndarray) -> str:
    text = ",".join(f"{0.0 if abs(x) < 1e-12 else x:.6g}" for x in array.astype(float).ravel())
    return hashlib.sha256(text.encode()).hexdigest()[:8]


@contextmanager
def silent_mujoco() -> Iterator[None]:
    """Without MuJoCo's warnings, which it would also write into a file where we are.

    What takes them belongs to the whole process, so this is for one thread at a time.
    """
    import mujoco  # noqa: PLC0415

    with _handler_lock:
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: None)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)


def _is_installed(package: str) -> bool:
    """Whether there is a package, or a module right in one; imports neither."""
    parent, _, module = package.partition(".")
    spec = find_spec(parent)
    if spec is None or not module:
        return spec is not None
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    return any((f / module).is_dir() or (f / f"{module}.py").is_file() for f in folders)


def _assets() -> Path:
    """Gymnasium's folder of models; it need not be imported for that."""
    spec = find_spec("gymnasium")
    assert spec is not None  # it is installed
    return Path(str(spec.origin)).parent / "envs" / "mujoco" / "assets"
