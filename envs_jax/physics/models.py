"""MuJoCo models that Gymnasium ships, compiled from where it is installed."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = ("mujoco", "gymnasium")  # whose versions decide what is compiled
EXTRA = "mujoco"  # of this project, which brings them

# What the models were that our demonstrations and results were made with: see `fingerprint`.
RECORDED = {
    "half_cheetah": {
        "opt.timestep": "312b95ee",
        "opt.gravity": "a6065b41",
        "opt.integrator": "5feceb66",
        "opt.solver": "d4735e3a",
        "opt.cone": "5feceb66",
        "opt.iterations": "ad573668",
        "opt.tolerance": "9b1121f5",
        "qpos0": "b07fb9f9",
        "body_pos": "f3f2fb43",
        "body_ipos": "38ab042c",
        "body_iquat": "4d1cb414",
        "body_mass": "ac31d688",
        "body_inertia": "50f43904",
        "jnt_type": "2e4300dc",
        "jnt_axis": "5180777c",
        "jnt_pos": "fb85b007",
        "jnt_range": "e3e760de",
        "jnt_stiffness": "9001f26a",
        "jnt_solref": "fcd52fe0",
        "jnt_solimp": "4427198a",
        "dof_damping": "d0487506",
        "dof_armature": "307c1183",
        "geom_type": "cfbe2041",
        "geom_size": "099a0395",
        "geom_pos": "46d9345e",
        "geom_quat": "9e615aa1",
        "geom_friction": "fe35b3b2",
        "geom_solref": "fcd52fe0",
        "geom_solimp": "32624d47",
        "geom_contype": "89b07c07",
        "geom_conaffinity": "a06c059f",
        "actuator_gear": "04f6221d",
        "actuator_ctrlrange": "7a85b3d6",
    }
}

# what decides how a model moves
OPTIONS = ("timestep", "gravity", "integrator", "solver", "cone", "iterations", "tolerance")
FIELDS = (
    *("qpos0", "body_pos", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    *("jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_stiffness", "jnt_solref", "jnt_solimp"),
    *("dof_damping", "dof_armature", "geom_type", "geom_size", "geom_pos", "geom_quat"),
    *("geom_friction", "geom_solref", "geom_solimp", "geom_contype", "geom_conaffinity"),
    *("actuator_gear", "actuator_ctrlrange"),
)


class MissingPackageError(ImportError):
    """A package is not installed; the message names the extra that brings it."""


class ModelChangedWarning(UserWarning):
    """A compiled model is not the one that this project's results were made with."""


def check_installed(packages: Sequence[str]) -> None:
    """Looks for packages that physics needs, without importing them.

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
    if changed := [key for key in recorded if recorded[key] != found[key]]:
        versions = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
        warnings.warn(
            f"{name}: the model that {versions} compile differs in {', '.join(changed)} from the "
            "one that this project's demonstrations and results were made with",
            ModelChangedWarning,
            stacklevel=2,
        )
    return model


def fingerprint(model: Any) -> dict[str, str]:
    """A short hash of each array that decides how a model moves, to six significant digits."""
    arrays = {f"opt.{name}": getattr(model.opt, name) for name in OPTIONS}
    arrays |= {name: getattr(model, name) for name in FIELDS}
    return {name: _hash(np.asarray(array)) for name, array in arrays.items()}


def _hash(array: np.ndarray) -> str:
    text = ",".join(f"{0.0 if abs(x) < 1e-12 else x:.6g}" for x in array.astype(float).ravel())
    return hashlib.sha256(text.encode()).hexdigest()[:8]


@contextmanager
def silent_mujoco() -> Iterator[None]:
    """Without MuJoCo's warnings, which it would also write into a file where we are."""
    import mujoco  # noqa: PLC0415

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:  # its parent is missing
        return False


def _assets() -> Path:
    """Gymnasium's folder of models; it need not be imported for that."""
    spec = find_spec("gymnasium")
    assert spec is not None  # it is installed
    return Path(str(spec.origin)).parent / "envs" / "mujoco" / "assets"
