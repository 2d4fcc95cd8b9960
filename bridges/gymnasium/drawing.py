"""A picture of a robot in the plane: where it has been, its goal, what pays and what ends.

Needs Pillow and NumPy alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

if TYPE_CHECKING:
    from bridges.bundle import Zone

SIZE = 400  # px, of the square picture
FINE = 2  # times as many are drawn, and then averaged: smooth edges
VIEW = 2.5  # m from the middle to the edges, where there is no arena to show
MARGIN = 0.12  # m around it
GRID = 0.5  # m
ROBOT = 0.1  # m, radius; a TurtleBot3 Burger's is about that

PAPER, LINES, FRAME, INK = (255, 255, 255), (232, 236, 238), (150, 158, 164), (38, 50, 56)
PAYS, ENDS, WAY = (255, 236, 179), (129, 199, 132), (0, 105, 140)

Point = tuple[float, float]
Place = Callable[[Point], Point]  # of a position in m, in px


def draw_plane(zone: Zone, path: np.ndarray) -> np.ndarray:
    """The plane with the robot at the end of its path.

    Args:
        zone: the task's.
        path: what was observed in the episode, [T, O]: x (m), y (m), and perhaps theta (rad).

    Returns:
        [SIZE, SIZE, 3] uint8; y points up.
    """
    picture = Image.new("RGB", (SIZE * FINE, SIZE * FINE), PAPER)
    draw = ImageDraw.Draw(picture)
    reach = VIEW if zone.arena is None else zone.arena
    scale = SIZE * FINE / (2 * (reach + MARGIN))

    def place(point: Point) -> Point:
        return (reach + MARGIN + point[0]) * scale, (reach + MARGIN - point[1]) * scale

    _ground(draw, zone, reach, place)
    _goal(draw, zone, place, scale)
    _way(draw, path, place, scale)
    return np.asarray(picture.reduce(FINE))


def _ground(draw: ImageDraw.ImageDraw, zone: Zone, reach: float, place: Place) -> None:
    for number in range(-math.floor(reach / GRID), math.floor(reach / GRID) + 1):
        at = number * GRID
        draw.line((place((at, -reach)), place((at, reach))), LINES, FINE)
        draw.line((place((-reach, at)), place((reach, at))), LINES, FINE)
    if zone.arena is not None:
        draw.rectangle((place((-reach, reach)), place((reach, -reach))), None, FRAME, FINE)


def _goal(draw: ImageDraw.ImageDraw, zone: Zone, place: Place, scale: float) -> None:
    center = place((zone.goal[0], zone.goal[1]))
    _disc(draw, center, zone.reward_radius * scale, PAYS)
    half = zone.success_size * scale
    if zone.success == "disc":
        _disc(draw, center, max(half, 2 * FINE), ENDS)
    else:
        x, y = center
        draw.rectangle((x - half, y - half, x + half, y + half), ENDS)


def _way(draw: ImageDraw.ImageDraw, path: np.ndarray, place: Place, scale: float) -> None:
    points = [place((float(x), float(y))) for x, y in path[:, :2]]
    _disc(draw, points[0], 3 * FINE, INK)
    if len(points) > 1:
        draw.line(points, WAY, 2 * FINE, joint="curve")
    if path.shape[1] < 3:
        _disc(draw, points[-1], 4 * FINE, WAY)
        return
    x, y = points[-1]
    theta = float(path[-1, 2])
    _disc(draw, (x, y), ROBOT * scale, WAY)
    ahead = ROBOT * scale
    draw.line((x, y, x + ahead * math.cos(theta), y - ahead * math.sin(theta)), PAPER, 2 * FINE)


def _disc(
    draw: ImageDraw.ImageDraw, center: Point, radius: float, color: tuple[int, int, int]
) -> None:
    x, y = center
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), color)
