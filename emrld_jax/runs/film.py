"""A film of runners before and after adaptation, rendered in software: no display is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from emrld_jax.runs.camera import Camera, check_camera
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.panels import Panel, save
from emrld_jax.runs.strides import is_runner
from envs_jax import Env
from envs_jax.physics.models import check_installed

WIDTH, HEIGHT = 320, 200  # px, as rendered
SHOWN = 130  # px of the height, from below: above is the sky
STRIP = 8  # frames of an episode in the film strip


def prepare_films(env: Any) -> None:
    """Chooses what to render with, before anything imports MuJoCo, which reads that only then.

    Raises:
        ConfigError: nothing is known to film, or a library is missing; names it.
        MissingPackageError: a package is not installed.
    """
    if not is_runner(env):
        raise ConfigError(f"video=true is for half_cheetah; {env.name} has pictures of its paths")
    check_installed(("imageio",))
    check_camera(env.model, "video=true")


def film(env: Env, panels: Sequence[Panel], folder: Path) -> None:
    """Writes film.gif and a film strip: the first episode of each direction, in each panel.

    What renders them was chosen by `prepare_films`.
    """
    import imageio  # noqa: PLC0415

    shots = {
        f"{words}, {panel.title.rpartition(', ')[2]}": _episode(env, panel, direction)
        for direction, words in ((1.0, "forward"), (-1.0, "backward"))
        for panel in panels
        if np.any(np.asarray(panel.demos.tasks.direction) == direction)
    }
    rendered = {title: _render(env, positions) for title, positions in shots.items()}
    captioned = np.stack([_captioned(rendered[title], title, shots[title]) for title in shots])
    grid = captioned.reshape(len(shots) // len(panels), len(panels), *captioned.shape[1:])
    frames = [np.vstack([np.hstack(row) for row in grid[:, :, t]]) for t in range(env.horizon)]
    imageio.mimwrite(folder / "film.gif", frames, duration=1000 * env.dt, loop=0)  # type: ignore[arg-type] # ms a frame
    _strip(env, rendered, shots, folder / "film_strip")


def _episode(env: Any, panel: Panel, direction: float) -> np.ndarray:
    """Joint positions of the first episode in a direction, [T, 9]; its last one is held."""
    task = int(np.argmax(np.asarray(panel.demos.tasks.direction) == direction))
    obs, mask = np.asarray(panel.obs[task][0]), np.asarray(panel.mask[task][0])
    last = int(mask.sum()) - 1
    return np.asarray(env.positions(obs[np.minimum(np.arange(len(obs)), last)]))


def _render(env: Any, positions: np.ndarray) -> np.ndarray:
    """Pictures of a runner with these joint positions [T, 9]: [T, SHOWN, WIDTH, 3]."""
    with Camera(env.model, WIDTH, HEIGHT) as camera:
        return np.stack([camera.picture(qpos)[HEIGHT - SHOWN :] for qpos in positions])


def _way(positions: np.ndarray, t: int) -> str:
    way = round(float(positions[t, 0] - positions[0, 0]), 1)
    return f"{way + 0.0:+.1f} m"  # no -0.0


def _captioned(frames: np.ndarray, title: str, positions: np.ndarray) -> np.ndarray:
    """The frames with a title, and how far the runner has come."""
    from PIL import Image, ImageDraw, ImageFont  # noqa: PLC0415

    font, captioned = ImageFont.load_default(15), []
    for t, frame in enumerate(frames):
        picture = Image.fromarray(frame)
        draw = ImageDraw.Draw(picture)
        for text, place, anchor in (
            (title, (6, 4), "la"),
            (_way(positions, t), (WIDTH - 6, SHOWN - 4), "rd"),
        ):
            draw.text(place, text, "white", font, anchor, stroke_width=2, stroke_fill="black")
        captioned.append(np.asarray(picture))
    return np.stack(captioned)


def _strip(
    env: Env, frames: dict[str, np.ndarray], shots: dict[str, np.ndarray], path: Path
) -> None:
    """A row of still frames for each shot, evenly over its time."""
    figure = Figure(figsize=(1.7 * STRIP, 1.0 * len(frames) + 0.3), layout="constrained")
    grid = figure.subplots(len(frames), STRIP, squeeze=False)
    times = np.linspace(0, env.horizon - 1, STRIP).round().astype(int)
    for row, (title, shot) in zip(grid, frames.items(), strict=True):
        for axes, t in zip(row, times, strict=True):
            axes.imshow(shot[t])
            axes.set(xticks=[], yticks=[], xlabel=_way(shots[title], int(t)))
        row[0].set_ylabel(
            title.replace(", ", "\n").replace(" adapt", "\nadapt"),
            rotation=0,
            ha="right",
            va="center",
        )
    for axes, t in zip(grid[0], times, strict=True):
        axes.set_title(f"{env.dt * t:.2f} s")
    save(figure, path)
