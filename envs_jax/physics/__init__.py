"""MuJoCo's physics as a pure function of arrays, by MJX or by MuJoCo's engine in C.

Both advance a packed body, [nq + 2 nv]: positions, velocities, and the accelerations that the
contact solver starts from. (One array, since XLA's CPU runtime costs per array of a loop.)
"""

from __future__ import annotations

import os
import platform
import warnings
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from envs_jax.physics.models import check_installed, load_model

BACKENDS = ("auto", "mujoco", "mjx")
PACKAGES = {  # that a backend needs, found before anything is imported
    "mujoco": ("mujoco", "mujoco.batch", "gymnasium"),
    "mjx": ("mujoco", "mujoco.mjx", "gymnasium"),
}


# values of the environment's MUJOCO_GL that MuJoCo can be imported with, besides those of a system
RENDERERS = (
    *("", "glfw", "on", "off", "true", "false", "1", "0", "enable", "enabled", "disable"),
    "disabled",
)
SYSTEM_RENDERERS = {"Linux": ("egl", "osmesa", "glx"), "Windows": ("wgl",), "Darwin": ("cgl",)}


class SlowBackendWarning(UserWarning):
    """A backend works here, but another one is many times as fast."""


class Advanced(NamedTuple):
    """A body some physics steps later."""

    body: jax.Array  # [nq + 2 nv]
    diverged: jax.Array  # [], 1 where the simulation broke down; the body is then as it was before


class Physics(Protocol):
    """What advances one body; batch it with `jax.vmap`."""

    def advance(self, body: jax.Array, control: jax.Array) -> Advanced:
        """The body after all physics steps of one environment step under a control [nu]."""
        ...


class Choice(NamedTuple):
    """Which physics: hashable, so that equal choices share one."""

    model: str  # a name that `load_model` takes
    frame_skip: int  # physics steps an environment step
    backend: str  # of BACKENDS
    mjx_iterations: int  # of its contact solver, at the most
    mjx_line_search: int  # of each of them, at the most


def check_backend(backend: str) -> None:
    """Refuses a backend that there is not, or not here.

    Raises:
        ValueError: it is unknown, or MUJOCO_GL has a value that MuJoCo refuses.
        MissingPackageError: a package is not installed.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend={backend!r} is unknown; choose one of: {', '.join(BACKENDS)}")
    check_installed(PACKAGES.get(backend, PACKAGES["mujoco"]))  # auto may choose too early here
    own = SYSTEM_RENDERERS.get(platform.system(), ())
    if (renderer := os.environ.get("MUJOCO_GL", "").lower().strip()) not in (*own, *RENDERERS):
        raise ValueError(
            f"MUJOCO_GL={renderer} in the environment keeps MuJoCo from being imported: unset it, "
            f"or choose one of {', '.join((*own, 'glfw', 'disabled'))}"
        )


def resolve_backend(backend: str) -> str:
    """The backend that `auto` stands for: the engine in C on a CPU, MJX on an accelerator."""
    if backend != "auto":
        return backend
    return "mujoco" if jax.default_backend() == "cpu" else "mjx"


def make_physics(choice: Choice) -> Physics:
    """The chosen physics; equal choices share one.

    Warns:
        SlowBackendWarning: MJX on a CPU.

    Raises:
        MissingPackageError: a package is not installed.
    """
    backend = resolve_backend(choice.backend)
    check_backend(backend)
    if backend == "mujoco":  # which has no use for MJX's numbers
        choice = choice._replace(mjx_iterations=0, mjx_line_search=0)
    return _made(choice._replace(backend=backend))


@lru_cache(maxsize=16)
def _made(choice: Choice) -> Physics:
    model = load_model(choice.model)
    if choice.backend == "mujoco":
        from envs_jax.physics.engine import Engine  # noqa: PLC0415

        return Engine(model, choice.frame_skip)
    from envs_jax.physics.mjx import Mjx  # noqa: PLC0415

    if jax.default_backend() == "cpu":
        warnings.warn(
            "backend=mjx on a CPU is about ten times as slow as backend=mujoco, the engine in C",
            SlowBackendWarning,
            stacklevel=3,
        )
    return Mjx(model, choice.frame_skip, choice.mjx_iterations, choice.mjx_line_search)


def pack(qpos: Any, qvel: Any) -> jax.Array:
    """A body with these positions [nq] and velocities [nv], its solver starting from nothing."""
    return jnp.concatenate([qpos, qvel, jnp.zeros_like(qvel)])
