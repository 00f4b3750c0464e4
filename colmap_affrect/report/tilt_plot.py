"""The space of tilts drawn as in the paper: a half disc, log tilt as radius and phi as angle.

phi is in [0, pi): what leaves the half disc at one end of its diameter comes back at the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Polygon, Wedge
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from colmap_affrect.geometry.affine import compose_affine
from colmap_affrect.geometry.canvas import rectifying_affine
from colmap_affrect.geometry.tilts import tilts_from_metrics, unit_metrics

Color = tuple[float, float, float]

TICKS = (2, 3, 4, 6, 8, 12, 20)
"""Tilts written along the diameter."""

SIDE, BELOW, ABOVE = 1.10, 0.10, 1.12
"""Space to the sides, below and above in radii of the disc; labels stand in it."""

HEIGHT_PER_WIDTH = (BELOW + ABOVE) / (2 * SIDE)

DARK, GRID = "#333333", "#CCCCCC"


@dataclass(frozen=True)
class TiltClass:
    """A class of maps to mark.

    Attributes:
        tilt, angle_rad: its coordinates.
        label: text beside the mark; may be empty.
        color: of mark and ball.
    """

    tilt: float
    angle_rad: float
    label: str
    color: Color


def ball_outline(
    tilt: float, angle_rad: float, radius: float, num_points: int = 361
) -> NDArray[np.float64]:
    """Return (N, 2) rows (tilt, angle_rad) of classes whose transition tilt to one is ``radius``.

    They are the classes of diag(r, 1) R(a) M for all a, where M is a map of the class: the
    transition tilt does not change when both maps are multiplied by M from the right. Angles run
    on without jumps, beyond [0, pi) too; the curve ends at the class where it began.
    """
    turns = np.linspace(0.0, np.pi, num_points)
    maps = compose_affine(1.0, 0.0, radius, turns) @ rectifying_affine(tilt, angle_rad)
    tilts, angles = tilts_from_metrics(unit_metrics(maps))
    return np.stack([tilts, np.unwrap(angles, period=np.pi)], axis=1)


def plane_points(classes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return (N, 2) points log t (cos phi, sin phi) of rows (tilt, angle_rad), y up."""
    tilts, angles = classes[:, 0], classes[:, 1]
    return np.stack([np.log(tilts) * np.cos(angles), np.log(tilts) * np.sin(angles)], axis=1)


def draw_tilt_space(
    axes: Axes,
    largest_tilt: float,
    classes: Sequence[TiltClass],
    *,
    shapes: NDArray[np.floating],
    shape_colors: Sequence[Color],
    radius: float | None,
    max_tilt: float | None,
) -> None:
    """Draw shapes, classes of maps and their balls into axes of ``HEIGHT_PER_WIDTH``.

    Args:
        axes: empty ones.
        largest_tilt: where the disc ends.
        classes: maps to mark.
        shapes: (N, 2) rows (tilt, angle_rad), drawn as points.
        shape_colors: N colours.
        radius: r of the balls, as a tilt ratio; None draws none.
        max_tilt: drawn as a dashed half circle; None draws none.
    """
    edge = float(np.log(largest_tilt))
    axes.set_xlim(-SIDE * edge, SIDE * edge)
    axes.set_ylim(-BELOW * edge, ABOVE * edge)
    axes.set_aspect("equal")
    axes.set_axis_off()
    disc = Wedge((0.0, 0.0), edge, 0.0, 180.0, facecolor="white", edgecolor=GRID, linewidth=1.0)
    axes.add_patch(disc)
    _draw_grid(axes, edge)
    x, y = plane_points(shapes).T
    points = axes.scatter(x, y, s=5, c=shape_colors, alpha=0.45, linewidths=0)
    points.set_clip_path(disc)
    if radius is not None:
        _draw_half_circle(axes, float(np.log(radius)), "-")
        for item in classes:
            _draw_ball(axes, item, radius, disc)
    if max_tilt is not None:
        _draw_half_circle(axes, float(np.log(max_tilt)), "--")
    for item in classes:
        _draw_mark(axes, item)


def _draw_grid(axes: Axes, edge: float) -> None:
    for degrees in range(0, 181, 30):
        direction = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
        axes.plot(*np.stack([np.zeros(2), edge * direction], axis=1), color=GRID, linewidth=0.7)
        align = "center" if degrees == 90 else "left" if degrees < 90 else "right"
        x, y = (1.02 * edge * direction).tolist()
        axes.text(x, y, f"{degrees}°", ha=align, va="bottom", color=DARK)
    for tick in (1, *(tick for tick in TICKS if np.log(tick) < edge)):
        place = float(np.log(tick))
        _draw_half_circle(axes, place, "-", color=GRID, linewidth=0.7)
        for side in {place, -place}:
            axes.text(side, -0.015 * edge, f"{tick}", ha="center", va="top", color=DARK)


def _draw_half_circle(
    axes: Axes, radius: float, linestyle: str, color: str = DARK, linewidth: float = 1.4
) -> None:
    axes.add_patch(
        Arc(
            (0.0, 0.0),
            2 * radius,
            2 * radius,
            theta2=180.0,
            linestyle=linestyle,
            color=color,
            linewidth=linewidth,
        )
    )


def _draw_ball(axes: Axes, item: TiltClass, radius: float, disc: Wedge) -> None:
    outline = plane_points(ball_outline(item.tilt, item.angle_rad, radius))
    # A class is a pair of opposite points; a ball around the identity is one curve of both halves.
    curves = [np.concatenate([outline, -outline])] if item.tilt < radius else [outline, -outline]
    for curve in curves:
        polygon = Polygon(curve, facecolor=(*item.color, 0.10), edgecolor=item.color, linewidth=1.6)
        axes.add_patch(polygon)
        polygon.set_clip_path(disc)


def _draw_mark(axes: Axes, item: TiltClass) -> None:
    ((x, y),) = plane_points(np.array([[item.tilt, item.angle_rad]]))
    axes.plot(x, y, "o", color=item.color, markeredgecolor=DARK, markersize=6, clip_on=False)
    axes.annotate(
        item.label,
        (x, y),
        (0, 5),
        textcoords="offset points",
        ha="center",
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
    )
