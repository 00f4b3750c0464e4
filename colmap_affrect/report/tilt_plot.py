"""The space of tilts drawn as in the paper: a half disc, log tilt as radius and phi as angle.

phi is in [0, pi): what leaves the half disc at one end of its diameter comes back at the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Arc, Polygon, Wedge
from matplotlib.patheffects import withStroke

from colmap_affrect.data import ShapeSamples
from colmap_affrect.geometry.affine import compose_affine, rectifying_affine
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.tilts import (
    IDENTITY_LABEL,
    nearest_centers,
    tilts_from_metrics,
    unit_metrics,
)
from colmap_affrect.rectifiers.base import CoverOptions
from colmap_affrect.report.levels import InspectedLevel
from colmap_affrect.report.regions import Color

TICKS = (2, 3, 4, 6, 8, 12, 20)  # tilts written along the diameter
SIDE, BELOW, ABOVE = 1.10, 0.10, 1.12
"""Space to the sides, below and above in radii of the disc; labels stand in it."""

HEIGHT_PER_WIDTH = (BELOW + ABOVE) / (2 * SIDE)

DARK, GRID, FAINT = "#333333", "#CCCCCC", "#999999"
MAX_NUM_SHAPES = 6000


@dataclass(frozen=True)
class TiltClass:
    """A class of maps to mark, with a label that may be empty."""

    tilt: float
    angle_rad: float
    label: str
    color: Color


def ball_outline(tilt: float, angle_rad: float, radius: float) -> Array:
    """Return (N, 2) rows (tilt, angle_rad) of classes whose transition tilt to one is ``radius``.

    They are the classes of diag(r, 1) R(a) M for all a, where M is a map of the class: the
    transition tilt does not change when both maps are multiplied by M from the right. Angles run
    on without jumps, beyond [0, pi) too; the curve ends at the class where it began.
    """
    turns = np.linspace(0.0, np.pi, 361)
    maps = compose_affine(1.0, 0.0, radius, turns) @ rectifying_affine(tilt, angle_rad)
    tilts, angles = tilts_from_metrics(unit_metrics(maps))
    return np.stack([tilts, np.unwrap(angles, period=np.pi)], axis=1)


def plane_points(classes: Floats) -> Array:
    """Return (N, 2) points log t (cos phi, sin phi) of rows (tilt, angle_rad), y up."""
    tilts, angles = classes[:, 0], classes[:, 1]
    return np.stack([np.log(tilts) * np.cos(angles), np.log(tilts) * np.sin(angles)], axis=1)


def tilt_space_captions(level: InspectedLevel) -> tuple[str, str]:
    """Return two lines that say how to read the space of tilts of a level."""
    maps = "dots: maps of the warps" if level.plan.items else "no maps are needed"
    axes = "radius: log tilt; angle: direction that the warp stretches"
    if level.shapes is None or not isinstance(level.options, CoverOptions):
        return axes, maps
    options = level.options
    balls = (
        f"closed curves: balls r = {options.tilt_radius:g} round the maps; inner half circle: that"
        f" of the identity; dashed: largest tilt {options.max_tilt:g}"
    )
    owner = "region" if any(item.region is not None for item in level.plan.items) else "ball"
    return f"{axes}; {maps}; points: shapes, coloured as their {owner}", balls


def draw_tilt_space(
    axes: Axes, level: InspectedLevel, classes: Sequence[TiltClass], colors: Sequence[Color]
) -> None:
    """Draw the shapes and maps of a level, and the balls of its cover, if it has one.

    ``axes`` are empty, of ``HEIGHT_PER_WIDTH``; ``classes`` are marked; ``colors`` are those of the
    warps.
    """
    cover = level.options if isinstance(level.options, CoverOptions) else None
    edge = np.log(1.2 * max([cover.max_tilt if cover else 2.0, *(item.tilt for item in classes)]))
    axes.set_xlim(-SIDE * edge, SIDE * edge)
    axes.set_ylim(-BELOW * edge, ABOVE * edge)
    axes.set_aspect("equal")
    axes.set_axis_off()
    disc = Wedge((0.0, 0.0), edge, 0.0, 180.0, facecolor="white", edgecolor=GRID, linewidth=1.0)
    axes.add_patch(disc)
    _draw_grid(axes, edge)
    if level.shapes is not None:
        every = max(1, -(-len(level.shapes.points) // MAX_NUM_SHAPES))
        shapes = ShapeSamples(level.shapes.points[::every], level.shapes.metrics[::every])
        x, y = plane_points(np.stack(tilts_from_metrics(shapes.metrics), axis=1)).T
        shown = axes.scatter(
            x, y, s=5, c=shape_colors(shapes, level, colors), alpha=0.45, linewidths=0
        )
        shown.set_clip_path(disc)
    if cover:
        _draw_half_circle(axes, np.log(cover.tilt_radius))
        for item in classes:
            _draw_ball(axes, item, cover.tilt_radius, disc)
        _draw_half_circle(axes, np.log(cover.max_tilt), linestyle="--")
    for item in classes:
        _draw_mark(axes, item)


def shape_colors(
    shapes: ShapeSamples, level: InspectedLevel, colors: Sequence[Color]
) -> list[Color]:
    """Colour shapes as the region they lie in, or as the ball where warps show the whole image."""
    items = level.plan.items
    owners = np.full(len(shapes.points), IDENTITY_LABEL)
    if any(item.region is not None for item in items):
        for index, item in enumerate(items):
            owners[item.in_region(shapes.points)] = index
    elif items and isinstance(level.options, CoverOptions):
        centers = np.array([[item.tilt, item.tilt_angle_rad] for item in items])
        owners = nearest_centers(shapes.metrics, centers, level.options.tilt_radius)
    return [colors[owner] if owner >= 0 else to_rgb(FAINT) for owner in owners.tolist()]


def _draw_grid(axes: Axes, edge: float) -> None:
    for degrees in range(0, 181, 30):
        x, y = edge * np.cos(np.deg2rad(degrees)), edge * np.sin(np.deg2rad(degrees))
        axes.plot([0.0, x], [0.0, y], color=GRID, linewidth=0.7)
        align = "center" if degrees == 90 else "left" if degrees < 90 else "right"
        axes.text(1.02 * x, 1.02 * y, f"{degrees}°", ha=align, va="bottom", color=DARK)
    for tick in (1, *(tick for tick in TICKS if np.log(tick) < edge)):
        place = float(np.log(tick))
        _draw_half_circle(axes, place, color=GRID, linewidth=0.7)
        for side in {place, -place}:
            axes.text(side, -0.015 * edge, f"{tick}", ha="center", va="top", color=DARK)


def _draw_half_circle(axes: Axes, radius: float, **style: Any) -> None:
    style = {"color": DARK, "linewidth": 1.4, **style}
    axes.add_patch(Arc((0.0, 0.0), 2 * radius, 2 * radius, theta2=180.0, **style))


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
    effects = [withStroke(linewidth=2.5, foreground="white")]
    place: dict[str, Any] = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center"}
    axes.annotate(item.label, (x, y), path_effects=effects, **place)
