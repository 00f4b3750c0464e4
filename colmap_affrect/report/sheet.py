"""One picture of one level of a recipe: the photograph with its regions, features, and warps."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patheffects import withStroke

from colmap_affrect.data import (
    ColorImage,
    GrayImage,
    LocalFeatures,
    Mask,
    Photograph,
    RectificationPlan,
)
from colmap_affrect.geometry.affine import transform_frames
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.report.levels import InspectedLevel, summary

Color = tuple[float, float, float]
Size = tuple[int, int]

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#882255")
"""Okabe and Ito's colours for all kinds of colour vision, and one of Paul Tol's."""

TINT = 0.45  # share of the colour over a region

DPI = 100
WIDTH_INCHES, TOP_INCHES, WARP_INCHES, TITLE_INCHES = 16.0, 7.0, 2.6, 0.6
TITLE_CHARS = 180  # that fit into a line
WARPS_PER_ROW, MAX_NUM_WARPS = 6, 24
MAX_NUM_FEATURES, MAX_NUM_WARP_FEATURES = 1500, 120  # drawn, the strongest
FEATURE_SIGMAS = 2.0  # radius of the ellipses drawn for features
TURN = np.linspace(0.0, 2.0 * np.pi, 25)
UNIT_CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)])
DARK = "#555555"
OUTLINED = [withStroke(linewidth=2.5, foreground="white")]
STYLE: list[str | dict[str, Any]] = [
    "default",
    {
        "font.family": "DejaVu Sans",
        "font.size": 9.0,
        "axes.titlesize": 9.0,
        "text.parse_math": False,
    },
]


def draw_sheet(level: InspectedLevel, stored_size: Size, path: Path) -> None:
    """Draw one level and write it as PNG.

    Above the photograph with the regions and their warps in one colour each, beside it its
    features; below the largest warps with theirs. ``stored_size`` is (width, height) of the image
    file in px.
    """
    colors = warp_colors(level.plan)
    items = level.plan.items
    largest = sorted(range(len(items)), key=lambda index: -items[index].canvas_area_px)
    chosen = sorted(largest[:MAX_NUM_WARPS])
    rows = [chosen[first : first + WARPS_PER_ROW] for first in range(0, len(chosen), WARPS_PER_ROW)]
    heights = [TOP_INCHES]
    for row in rows:
        aspects = [items[index].canvas_size[1] / items[index].canvas_size[0] for index in row]
        heights.append(WARP_INCHES * min(1.5, max(aspects)) + TITLE_INCHES)
    with matplotlib.style.context(STYLE):
        figure = Figure(
            (WIDTH_INCHES, sum(heights)), dpi=DPI, facecolor="white", layout="constrained"
        )
        FigureCanvasAgg(figure)
        figure.suptitle("\n".join(map(printable, _title(level, stored_size))))
        grid = figure.add_gridspec(len(heights), WARPS_PER_ROW, height_ratios=heights)
        half = WARPS_PER_ROW // 2
        _draw_regions(figure.add_subplot(grid[0, :half]), level)
        _draw_all_features(figure.add_subplot(grid[0, half:]), level, colors)
        for place, index in enumerate(chosen, WARPS_PER_ROW):
            axes = figure.add_subplot(grid[divmod(place, WARPS_PER_ROW)])
            _draw_warp(axes, level, index + 1, colors[index])
        figure.savefig(path, format="png")


def printable(text: str) -> str:
    """Replace the characters that the font of the sheets has no glyph for."""
    font = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return "".join(
        character if font.get_char_index(ord(character)) else "\N{REPLACEMENT CHARACTER}"
        for character in text
    )


def _title(level: InspectedLevel, stored_size: Size) -> Iterator[str]:
    width, height = level.photograph.size
    stored = f" (stored: {stored_size[0]} x {stored_size[1]} px)"
    which = f"level {level.number} of escalation" if level.number else "level of every image"
    steps = ", ".join(f"{step} {seconds:.2f} s" for step, seconds in level.seconds.items())
    yield from wrap(level.photograph.name, TITLE_CHARS)
    yield (
        f"{width} x {height} px{stored * (level.photograph.size != stored_size)}; {which}: "
        f"rectifier {level.rectifier}, features {level.extractor}"
    )
    yield f"{summary(level)}: {steps}" + "; contrast stretched" * level.photograph.stretched
    yield from wrap(level.warning, TITLE_CHARS)


def _draw_regions(axes: Axes, level: InspectedLevel) -> None:
    image = tinted(level.photograph, level.plan)
    if level.photograph.mask is not None:
        image[~level.photograph.mask] //= 3
    has_regions = any(item.region is not None for item in level.plan.items)
    all_of_it = "every warp shows the whole photograph" if level.plan.items else "no warps"
    dark = "; dark: masked" if level.photograph.mask is not None else ""
    _show(axes, image, f"Regions: {'by number of warp' if has_regions else all_of_it}{dark}")
    labels: dict[tuple[float, ...], list[int]] = {}
    for number, item in enumerate(level.plan.items, 1):
        if item.region is not None:
            middle = region_middle(item.region, item.region_origin)
            labels.setdefault(tuple(middle.tolist()), []).append(number)
    for (x, y), numbers in labels.items():
        text = ", ".join(map(str, numbers[:3])) + " ..." * (len(numbers) > 3)
        axes.text(x, y, text, ha="center", va="center", path_effects=OUTLINED)


def _draw_all_features(axes: Axes, level: InspectedLevel, colors: Sequence[Color]) -> None:
    features = level.features
    shown = min(len(features), MAX_NUM_FEATURES)
    title = f"Features: the strongest {shown} of {len(features)}; gray: of the photograph itself"
    _show(axes, 255 - (255 - level.photograph.gray) // 2, title)
    palette = [to_rgb(DARK), *colors]
    ids = features.rectification_ids.tolist()
    _draw_features(axes, features, [palette[view] for view in ids], MAX_NUM_FEATURES)


def _draw_warp(axes: Axes, level: InspectedLevel, number: int, color: Color) -> None:
    item = level.plan.items[number - 1]
    found, kept = level.found[number], level.kept_of(number)
    (width, height), angle = item.canvas_size, np.rad2deg(item.tilt_angle_rad)
    image, mask = level.views[number]
    pale = 255 - (255 - image) // 4  # outside of the region
    _show(
        axes,
        image if mask is None else np.where(mask, image, pale),
        f"{number}: tilt {item.tilt:.2f} at {angle:.0f}°, {width} x {height} px\n"
        f"{len(kept)} of {len(found)} features kept",
    )
    frames = transform_frames(item.rectified_from_image, kept.lafs)
    _draw_features(axes, kept.with_frames(frames), [color] * len(kept), MAX_NUM_WARP_FEATURES)


def _draw_features(
    axes: Axes, features: LocalFeatures, colors: Sequence[Color], max_num: int
) -> None:
    order = np.argsort(-features.responses, kind="stable")[:max_num]
    lafs = features.lafs[order]
    outlines = lafs[:, :, :2] @ UNIT_CIRCLE * (FEATURE_SIGMAS / MEASUREMENT_SIGMAS)
    segments = np.swapaxes(outlines + lafs[:, :, 2:], 1, 2)
    chosen = [colors[index] for index in order.tolist()]
    axes.add_collection(LineCollection(list(segments), colors=chosen, linewidths=1.2))


def _show(axes: Axes, image: GrayImage | ColorImage, title: str) -> None:
    """Show an image; data coordinates are its px, and nothing that is drawn later moves it."""
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.autoscale(False)
    axes.set_title(title)
    axes.set_axis_off()


def warp_colors(plan: RectificationPlan) -> list[Color]:
    """Choose a colour for each warp of a plan.

    Warps of one segment, or of one class that shows the whole image, have the same; where these are
    more than the palette has, it begins anew.
    """
    keys = [
        (item.tilt, item.tilt_angle_rad) if item.region is None else item.segment_id
        for item in plan.items
    ]
    groups = list(dict.fromkeys(keys))
    return [to_rgb(PALETTE[groups.index(key) % len(PALETTE)]) for key in keys]


def tinted(photograph: Photograph, plan: RectificationPlan) -> ColorImage:
    """Return the (H, W, 3) photograph with each region in the colour of its warp."""
    image = np.repeat(photograph.gray[:, :, None], 3, axis=2)
    for item, color in zip(plan.items, warp_colors(plan), strict=True):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            pixels = rows + item.region_origin[1], columns + item.region_origin[0]
            mixed = (1.0 - TINT) * photograph.gray[pixels][:, None] + TINT * 255.0 * np.array(color)
            image[pixels] = np.rint(mixed).astype(np.uint8)
    return image


def region_middle(region: Mask, origin: tuple[int, int]) -> Array:
    """Return the (2,) pixel of an (h, w) region that is nearest to its centre of mass, image px."""
    rows, columns = np.nonzero(region)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    nearest = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    return np.asarray(points[nearest] + origin)
