"""What renders an environment: a drawing of the plane, or MuJoCo's picture of a runner."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from bridges.environments import zone
from bridges.gymnasium.checks import METADATA, check_mode
from bridges.gymnasium.drawing import draw_plane
from emrld_jax.runs.camera import Camera, check_camera, choose_renderer
from emrld_jax.runs.strides import is_runner
from envs_jax import Env

WIDTH, HEIGHT = 480, 320  # px, of a runner's picture


class Painter(Protocol):
    """Renders episodes of one environment."""

    def paint(self, path: np.ndarray, task: Any) -> np.ndarray:
        """A picture of what was observed in an episode of a task.

        Args:
            path: [T, O].
            task: the environment's NamedTuple.

        Returns:
            [height, width, 3] uint8.
        """
        ...

    def close(self) -> None:
        """Frees what it holds; may be called twice."""
        ...


def metadata(env: Env) -> dict[str, Any]:
    """What Gymnasium wants to know: runners are shown in their own time, others faster."""
    return {**METADATA, "render_fps": round(1 / env.dt)} if is_runner(env) else dict(METADATA)


def painter(env: Env, mode: str | None) -> Painter | None:
    """What renders an environment in a mode; None for no mode.

    Raises:
        ValueError: there is no such mode.
        ConfigError: nothing can render here.
    """
    check_mode(mode)
    if is_runner(env):
        choose_renderer()  # also for others that are made later, before MuJoCo is imported
    if mode is None:
        return None
    return RunnerPainter(env) if is_runner(env) else PlanePainter(env)


class PlanePainter:
    """Draws the plane from above."""

    def __init__(self, env: Env) -> None:
        self._env = env

    def paint(self, path: np.ndarray, task: Any) -> np.ndarray:
        """See `Painter`."""
        place = zone(self._env, task)
        assert place is not None  # of all that do not run
        return draw_plane(place, path)

    def close(self) -> None:
        """Holds nothing."""


class RunnerPainter:
    """Has MuJoCo render the runner, followed by its camera.

    Raises:
        ConfigError: nothing can render here.
    """

    def __init__(self, env: Any) -> None:
        check_camera(env.model, "render_mode='rgb_array'")
        self._env, self._camera = env, Camera(env.model, WIDTH, HEIGHT)

    def paint(self, path: np.ndarray, task: Any) -> np.ndarray:
        """See `Painter`; the task does not show."""
        return self._camera.picture(np.asarray(self._env.positions(path[-1])))

    def close(self) -> None:
        """Frees what renders; may be called twice."""
        self._camera.close()
