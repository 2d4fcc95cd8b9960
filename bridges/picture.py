"""The paths of a robot before and after adaptation, where matplotlib is installed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bridges.bundle import Bundle, Zone
from bridges.episodes import Episode
from bridges.recording import Recording
from bridges.world import zone_of


def draw(bundle: Bundle, recordings: Mapping[str, Recording], path: Path) -> bool:
    """Draws a panel for each recording, with the goal, its zones and the demonstration.

    Args:
        bundle: whose task it is.
        recordings: by the title of their panel.
        path: .png and .svg are written beside each other.

    Returns:
        Whether it was drawn; False: matplotlib is not installed.
    """
    try:
        # only here: a robot's computer may be without it
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        return False
    zone = zone_of(bundle)
    figure = Figure(figsize=(5.2 * len(recordings), 5.2), layout="constrained")
    panels = figure.subplots(1, len(recordings), squeeze=False, sharex=True, sharey=True)
    for axes, (title, recording) in zip(panels.flat, recordings.items(), strict=True):
        _draw_zone(axes, zone)
        axes.plot(*bundle.tensors["demos/obs"][:, :2].T, "k--", linewidth=1, label="demonstration")
        for episode in recording.episodes:
            _draw_episode(axes, episode)
        whole = [episode for episode in recording.episodes if episode.whole]
        reached = sum(episode.ending == "success" for episode in whole)
        axes.set(title=f"{title}: {reached} of {len(whole)} reach the goal")
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.grid(alpha=0.2)
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=150, bbox_inches="tight")
    return True


def _draw_zone(axes: Any, zone: Zone) -> None:
    from matplotlib.patches import Circle, Rectangle  # noqa: PLC0415

    (x, y), size = zone.goal, zone.success_size
    reached: dict[str, Any] = {"color": "#1f5fa8", "alpha": 0.3, "linewidth": 0}
    axes.add_patch(Circle((x, y), zone.reward_radius, color="#8c8c8c", alpha=0.2, linewidth=0))
    if zone.success == "disc":
        axes.add_patch(Circle((x, y), size, **reached))
    else:
        axes.add_patch(Rectangle((x - size, y - size), 2 * size, 2 * size, **reached))
    axes.plot(x, y, marker="*", color="#1f5fa8", markersize=8)
    axes.plot(0, 0, marker="o", color="black", markersize=4)


def _draw_episode(axes: Any, episode: Episode) -> None:
    """Solid if it is whole; a dot at the end, for some stay where they begin."""
    points = np.array([*(step.obs for step in episode.steps), episode.last_pose])[:, :2]
    style: dict[str, Any] = {
        "linewidth": 1.2,
        "alpha": 0.8,
        "linestyle": "-" if episode.whole else ":",
    }
    (drawn,) = axes.plot(*points.T, **style)
    axes.plot(*points[-1], ".", color=drawn.get_color(), markersize=6)
