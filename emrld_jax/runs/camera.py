"""Pictures of a MuJoCo model, rendered in software: no display is needed."""

from __future__ import annotations

import os
import sys
import weakref
from contextlib import AbstractContextManager
from ctypes.util import find_library
from typing import Any

import numpy as np

from emrld_jax.runs.config import ConfigError
from envs_jax.physics.models import load_model

# what MuJoCo can render with where there is no display: library, Debian's package of it
SOFTWARE = {"osmesa": ("OSMesa", "libosmesa6"), "egl": ("EGL", "libegl1")}


class Camera(AbstractContextManager):
    """Takes pictures of a model of `envs_jax` in any position; `close` frees what renders.

    Args:
        model: the model's name.
        width, height: px.
    """

    def __init__(self, model: str, width: int, height: int) -> None:
        import mujoco  # noqa: PLC0415

        self._model = load_model(model)
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)
        # also at the interpreter's exit, while that can still be done
        self._free = weakref.finalize(self, self._renderer.close)

    def __exit__(self, *_: object) -> None:
        self.close()

    def picture(self, positions: Any) -> np.ndarray:
        """The model with these joint positions [nq], followed: [height, width, 3] uint8."""
        import mujoco  # noqa: PLC0415

        self._data.qpos[:] = positions
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, camera="track")
        return self._renderer.render()

    def close(self) -> None:
        """Frees what renders; may be called twice."""
        self._free()


def choose_renderer() -> bool:
    """Chooses what to render with, unless MUJOCO_GL does; False: there is nothing.

    It has to be called before anything imports MuJoCo, which reads MUJOCO_GL only then. Afterwards
    it chooses nothing.
    """
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ or "mujoco" in sys.modules:
        return True
    for name, (library, _) in SOFTWARE.items():
        if find_library(library):
            os.environ["MUJOCO_GL"] = name
            return True
    return False


def check_camera(model: str, purpose: str) -> None:
    """Renders once, after `choose_renderer`.

    Args:
        model: the name of a model of `envs_jax`.
        purpose: what asks for pictures, such as "video=true".

    Raises:
        ConfigError: a library is missing; names it.
    """
    packages = " or ".join(package for _, package in SOFTWARE.values())
    advice = (
        f"{purpose} needs a library that renders without a display: install {packages} "
        "(apt-get install ..), or set MUJOCO_GL=glfw where there is a display"
    )
    if not choose_renderer():
        raise ConfigError(advice)
    try:
        with Camera(model, 32, 32) as camera:
            camera.picture(0.0)
    except Exception as error:  # of many kinds: a missing driver, an unknown MUJOCO_GL, ..
        if (told := os.environ.get("MUJOCO_GL")) is None:
            raise ConfigError(
                f"{purpose} fails: {error}. MuJoCo was imported before it was known that pictures "
                "are wanted; set MUJOCO_GL=osmesa, egl or glfw before the program starts"
            ) from error
        raise ConfigError(f"{advice}; MUJOCO_GL={told} fails: {error}") from error
