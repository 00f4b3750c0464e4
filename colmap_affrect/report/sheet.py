"""One picture of one level of a recipe: regions, space of tilts, depth, warps, features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from colmap_affrect.conventions import HALF_PIXEL, MEASUREMENT_SIGMAS, resized_from_original
from colmap_affrect.geometry.affine import project, transform_frames
from colmap_affrect.geometry.planes import normals_from_depth, shrink_depth
from colmap_affrect.geometry.tilts import IDENTITY_LABEL, nearest_centers, tilts_from_metrics
from colmap_affrect.imaging import shrink_to
from colmap_affrect.options import CoverOptions
from colmap_affrect.rectifiers.depth_planes import MAX_DEPTH_SIZE_PX
from colmap_affrect.report.levels import (
    PIXELS_PER_MEGAPIXEL,
    InspectedLevel,
    region_area_px,
    summary,
)
from colmap_affrect.report.tilt_plot import (
    HEIGHT_PER_WIDTH,
    Color,
    TiltClass,
    draw_tilt_space,
)
from colmap_affrect.types import (
    GrayImage,
    LocalFeatures,
    Mask,
    Rectification,
    RectificationPlan,
    ShapeSamples,
)

Size = tuple[int, int]

DPI = 100
WIDTH_PX = 1800
MARGIN_PX = 24
INNER_PX = WIDTH_PX - 2 * MARGIN_PX
HEAD_PX = 50
"""Title and caption of a section."""
NAME_PX, LINE_PX = 34, 20
NAME_CHARS, LINE_CHARS = 110, 200
"""What fits into a line of the header."""
FONT_PT, HEADER_PT, TITLE_PT, NAME_PT = 9.0, 10.5, 12.0, 16.0

MAP_BOX_PX = (900, 720)
MAX_TILTS_WIDTH_PX = 880
DEPTH_BOX_PX = ((INNER_PX - MARGIN_PX) // 2, 560)
FEATURES_BOX_PX = (INNER_PX, 1000)
"""Largest width and height of the pictures."""
MIN_MAP_PX, MIN_DEPTH_PX = 520, 240
"""Room for the captions of narrow pictures that have another one at their right."""

TILE_TITLE_PX = 36
TILE_GAP_PX = 14
MIN_TILE_WIDTH_PX = 190
MAX_TILE_WIDTH_PX = (INNER_PX - TILE_GAP_PX) // 2
MIN_TILE_HEIGHT_PX, MAX_TILE_HEIGHT_PX = 72, 440
ALL_TILES_PX = INNER_PX * 550
"""Area of all warps as they are shown, nearly."""
MAX_NUM_TILES = 40

MAX_NUM_LEGEND_ROWS = 14
MAX_NUM_MARK_LABELS = 16
MAX_NUM_SHAPES = 6000
MAX_NUM_FEATURES = 1500
MAX_NUM_TILE_FEATURES = 120

FEATURE_SIGMAS = 2.0
"""Radius of the ellipses drawn for features, in sigma."""

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#882255")
"""Okabe and Ito's colours for all kinds of colour vision, and one of Paul Tol's."""
ANGLE_COLORS = LinearSegmentedColormap.from_list(
    "tilt angle", [PALETTE[index] for index in (0, 5, 2, 6, 1, 4, 3, 0)]
)
"""For more maps than the palette has colours: a circle, since the tilt angle has period pi."""
DARK, FAINT, WARNING = "#555555", "#999999", "#B03A00"

STYLE: list[str | dict[str, Any]] = [
    "default",
    {"font.family": "DejaVu Sans", "font.size": FONT_PT, "text.parse_math": False},
]
OUTLINED = [withStroke(linewidth=2.5, foreground="white")]
TURN = np.linspace(0.0, 2.0 * np.pi, 25)
UNIT_CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)])


class _Page:
    """A figure whose parts are placed in px from its top left corner."""

    def __init__(self, height_px: int) -> None:
        self.height_px = height_px
        self.figure = Figure(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)

    def axes(self, left: float, top: float, size: Size) -> Axes:
        """Add axes without frame and ticks."""
        bottom = self.height_px - top - size[1]
        place = (left / WIDTH_PX, bottom / self.height_px)
        extent = (size[0] / WIDTH_PX, size[1] / self.height_px)
        axes = self.figure.add_axes((*place, *extent))
        axes.set_axis_off()
        return axes

    def text(self, left: float, top: float, text: str, **style: Any) -> None:
        """Write a line whose top left corner is given."""
        place = (left / WIDTH_PX, 1.0 - top / self.height_px)
        self.figure.text(*place, printable(text), va="top", **style)

    def heading(self, left: float, top: float, title: str, caption: str) -> None:
        """Write a title and, below it, how to read what follows; ``HEAD_PX`` high."""
        self.text(left, top, title, fontsize=TITLE_PT, weight="bold")
        self.text(left, top + 24, caption, color=DARK)


@dataclass(frozen=True)
class _Section:
    """A part of a sheet: its height, and how it is drawn on a page from a top px on."""

    height_px: int
    draw: Callable[[_Page, int], None]


def draw_sheet(level: InspectedLevel, stored_size: Size, path: Path) -> None:
    """Draw one level and write it as PNG, ``WIDTH_PX`` wide and as high as it takes.

    From top to bottom: the regions over the photograph and the shapes in the space of tilts;
    depth and normals, where there are any; the warps with their features; all features.

    Args:
        level: what to draw.
        stored_size: (width, height) of the image file in px.
        path: of the PNG.
    """
    colors = warp_colors(level.plan)
    sections = [_header(level, stored_size)]
    if level.plan.items or level.shapes is not None:
        sections.append(_overview(level, colors))
    if level.depth is not None:
        sections.append(_depth_and_normals(level, level.depth))
    if level.plan.items:
        sections.append(_warps(level, colors))
    sections.append(_features(level, colors))
    with matplotlib.style.context(STYLE):
        page = _Page(MARGIN_PX + sum(section.height_px + MARGIN_PX for section in sections))
        top = MARGIN_PX
        for section in sections:
            section.draw(page, top)
            top += section.height_px + MARGIN_PX
        page.figure.savefig(path, format="png")


def warp_colors(plan: RectificationPlan) -> list[Color]:
    """Choose a colour for each warp of a plan.

    Warps of one segment have the same, and so have warps of one class that show the whole
    image. Where that is more than the palette has, the tilt angle decides.
    """
    keys = [
        (item.tilt, item.tilt_angle_rad) if item.region is None else item.segment_id
        for item in plan.items
    ]
    groups = list(dict.fromkeys(keys))
    if len(groups) > len(PALETTE):
        return [to_rgb(ANGLE_COLORS(item.tilt_angle_rad / np.pi)) for item in plan.items]
    return [to_rgb(PALETTE[groups.index(key)]) for key in keys]


def printable(text: str) -> str:
    """Replace the characters that the font of the sheets has no glyph for."""
    font = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return "".join(
        character if font.get_char_index(ord(character)) else "\N{REPLACEMENT CHARACTER}"
        for character in text
    )


def _header(level: InspectedLevel, stored_size: Size) -> _Section:
    width, height = level.photograph.size
    stored = f" (stored: {stored_size[0]} x {stored_size[1]} px)"
    which = f"level {level.number} of escalation" if level.number else "level of every image"
    shapes = f" ({level.options.shape_source})" if isinstance(level.options, CoverOptions) else ""
    steps = ", ".join(f"{step} {seconds:.2f} s" for step, seconds in level.seconds.items())
    about = [
        f"{width} x {height} px{stored * (level.photograph.size != stored_size)};"
        f" {which}: rectifier {level.options.name}{shapes}, features {level.profile_name}",
        f"{summary(level)}: {steps}",
    ]
    names = wrap(level.photograph.name, NAME_CHARS)
    warnings = wrap(level.warning, LINE_CHARS)

    def draw(page: _Page, top: int) -> None:
        for name in names:
            page.text(MARGIN_PX, top, name, fontsize=NAME_PT, weight="bold")
            top += NAME_PX
        for line, color in [(line, "black") for line in about] + [(w, WARNING) for w in warnings]:
            page.text(MARGIN_PX, top, line, fontsize=HEADER_PT, color=color)
            top += LINE_PX

    return _Section(NAME_PX * len(names) + LINE_PX * (len(about) + len(warnings)), draw)


# --- Regions and the space of tilts


@dataclass(frozen=True)
class _LegendRow:
    """The warps of one class in one segment."""

    color: Color
    tilt: float
    angle_rad: float
    warp_ids: list[int]
    cells: list[str]


LEGEND_COLUMNS = {
    "segment": 30,
    "tilt": 115,
    "angle": 175,
    "of image": 235,
    "warped": 325,
    "found": 425,
    "kept": 490,
    "warps": 555,
}
"""Heads of the legend and their distance from its left side in px."""


def _legend_rows(level: InspectedLevel, colors: Sequence[Color]) -> list[_LegendRow]:
    items = level.plan.items
    groups: dict[tuple[int, float, float], list[int]] = {}
    for warp_id, item in enumerate(items, 1):
        key = (item.segment_id, item.tilt, item.tilt_angle_rad)
        groups.setdefault(key, []).append(warp_id)
    rows = []
    for (segment, tilt, angle_rad), ids in groups.items():
        members = [items[warp_id - 1] for warp_id in ids]
        size = level.plan.image_size
        share = sum(region_area_px(item, size) for item in members) / (size[0] * size[1])
        megapixels = sum(item.canvas_area_px for item in members) / PIXELS_PER_MEGAPIXEL
        cells = [
            str(segment) if members[0].region is not None else "-",
            f"{tilt:.2f}",
            f"{np.rad2deg(angle_rad):.0f}°",
            f"{share:.1%}",
            f"{megapixels:.2f} Mpx",
            str(sum(len(level.found[warp_id]) for warp_id in ids)),
            str(sum(len(level.kept_of(warp_id)) for warp_id in ids)),
            ranges(ids, 3),
        ]
        rows.append(_LegendRow(colors[ids[0] - 1], tilt, angle_rad, ids, cells))
    return rows


def ranges(numbers: Sequence[int], max_num: int) -> str:
    """Write rising numbers as ranges, the first ``max_num`` of them.

    >>> ranges([1, 2, 3, 5, 8, 9], 2)
    '1-3, 5 ...'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs]
    return ", ".join(texts[:max_num]) + " ..." * (len(texts) > max_num)


def fitted(size: Size, box: Size) -> Size:
    """Scale (width, height) so that it just fits into a box."""
    scale = min(box[0] / size[0], box[1] / size[1])
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _overview(level: InspectedLevel, colors: Sequence[Color]) -> _Section:
    map_size = fitted(level.photograph.size, MAP_BOX_PX)
    left = MARGIN_PX + max(map_size[0], MIN_MAP_PX) + 2 * MARGIN_PX
    tilts_width = min(WIDTH_PX - MARGIN_PX - left, MAX_TILTS_WIDTH_PX)
    tilts_size = (tilts_width, round(tilts_width * HEIGHT_PER_WIDTH))
    rows = _legend_rows(level, colors)
    lines = rows[:MAX_NUM_LEGEND_ROWS]
    legend_top = HEAD_PX + LINE_PX + tilts_size[1] + MARGIN_PX
    num_lines = len(lines) + 1 + (len(rows) > len(lines)) if rows else 0
    captions = _tilts_captions(level)

    def draw(page: _Page, top: int) -> None:
        page.heading(MARGIN_PX, top, "Regions", _map_caption(level.plan))
        axes = page.axes(MARGIN_PX, top + HEAD_PX, map_size)
        _draw_map(axes, map_size, level, colors)
        page.heading(left, top, "Space of tilts", captions[0])
        page.text(left, top + HEAD_PX - 6, captions[1], color=DARK)
        axes = page.axes(left, top + HEAD_PX + LINE_PX, tilts_size)
        _draw_tilts(axes, level, rows, colors)
        if rows:
            _draw_legend(page, left, top + legend_top, lines, len(rows) - len(lines))

    return _Section(max(HEAD_PX + map_size[1], legend_top + num_lines * LINE_PX), draw)


def _draw_legend(
    page: _Page, left: int, top: int, rows: Sequence[_LegendRow], num_left_out: int
) -> None:
    for title, offset in LEGEND_COLUMNS.items():
        page.text(left + offset, top, title, color=DARK, weight="bold")
    for number, row in enumerate(rows, 1):
        line_top = top + number * LINE_PX
        swatch = page.axes(left, line_top - 1, (18, 14))
        swatch.imshow([[row.color]], aspect="auto")
        for offset, cell in zip(LEGEND_COLUMNS.values(), row.cells, strict=True):
            page.text(left + offset, line_top, cell)
    if num_left_out:
        below = top + (len(rows) + 1) * LINE_PX
        page.text(left, below, f"and {num_left_out} more; all are in the JSON file", color=DARK)


def _map_caption(plan: RectificationPlan) -> str:
    if not plan.items:
        return "no warps"
    if all(item.region is None for item in plan.items):
        return "every warp shows the whole photograph"
    return "tint: segment; number: warp; ellipse: what the warp turns into a circle"


def _draw_map(axes: Axes, shown_px: Size, level: InspectedLevel, colors: Sequence[Color]) -> None:
    width, height = level.photograph.size
    _show(axes, level.photograph.gray, shown_px, fade=0.25)
    tint = np.zeros((height, width, 4), dtype=np.float32)
    numbers_at: dict[tuple[float, float], list[int]] = {}
    for number, (item, color) in enumerate(zip(level.plan.items, colors, strict=True), 1):
        if item.region is None:
            continue
        rows, columns = np.nonzero(item.region)
        tint[rows + item.region_origin[1], columns + item.region_origin[0]] = (*color, 0.5)
        middle = region_middle(item.region, item.region_origin)
        numbers_at.setdefault((float(middle[0]), float(middle[1])), []).append(number)
        ellipse = circle_origin(item, middle, 0.022 * max(width, height))
        axes.plot(*ellipse, color="white", linewidth=4.0, zorder=2)
        axes.plot(*ellipse, color=color, linewidth=2.0, zorder=3)
    axes.imshow(tint, interpolation="nearest", extent=_extent((width, height)), aspect="auto")
    for place, numbers in numbers_at.items():
        text = ranges(numbers, 2)
        axes.text(*place, text, ha="center", va="center", path_effects=OUTLINED, zorder=4)


def region_middle(region: Mask, origin: tuple[int, int]) -> NDArray[np.float64]:
    """Return the (2,) pixel of an (h, w) region that is nearest to its centre of mass, image px."""
    rows, columns = np.nonzero(region)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    nearest = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    return np.asarray(points[nearest] + origin)


def circle_origin(
    item: Rectification, middle: NDArray[np.float64], radius_px: float
) -> NDArray[np.float64]:
    """Return the (2, N) ellipse around a point, in image px, that a warp turns into a circle.

    Its area is that of a circle of ``radius_px``.
    """
    ((x, y),) = project(item.rectified_from_image, middle[None])
    (frame,) = transform_frames(
        item.image_from_rectified, np.array([[[1.0, 0.0, x], [0.0, 1.0, y]]])
    )
    shape = frame[:, :2] * radius_px / np.sqrt(np.linalg.det(frame[:, :2]))
    return np.asarray(shape @ UNIT_CIRCLE + middle[:, None])


def _tilts_captions(level: InspectedLevel) -> tuple[str, str]:
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


def _draw_tilts(
    axes: Axes, level: InspectedLevel, rows: Sequence[_LegendRow], colors: Sequence[Color]
) -> None:
    classes = [
        TiltClass(
            row.tilt,
            row.angle_rad,
            ranges(row.warp_ids, 2) if len(rows) <= MAX_NUM_MARK_LABELS else "",
            row.color,
        )
        for row in rows
    ]
    cover = level.options if isinstance(level.options, CoverOptions) else None
    radius, max_tilt = (cover.tilt_radius, cover.max_tilt) if cover else (None, None)
    largest = 1.2 * max([max_tilt or 2.0, *(row.tilt for row in rows)])
    shapes = level.shapes or ShapeSamples(np.zeros((0, 2)), np.zeros((0, 3)))
    every = max(1, -(-len(shapes.points) // MAX_NUM_SHAPES))
    shapes = ShapeSamples(shapes.points[::every], shapes.metrics[::every])
    draw_tilt_space(
        axes,
        largest,
        classes,
        shapes=np.stack(tilts_from_metrics(shapes.metrics), axis=1),
        shape_colors=shape_colors(shapes, level, colors),
        radius=radius,
        max_tilt=max_tilt,
    )


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


# --- Depth


def _depth_and_normals(level: InspectedLevel, depth: NDArray[np.floating]) -> _Section:
    size = fitted(level.photograph.size, DEPTH_BOX_PX)
    second_left = MARGIN_PX + max(size[0], MIN_DEPTH_PX) + MARGIN_PX
    size_of_depth = (depth.shape[1], depth.shape[0])
    shrunk, shrunk_from_depth = shrink_depth(depth, MAX_DEPTH_SIZE_PX)
    shrunk_from_image = shrunk_from_depth @ resized_from_original(
        level.photograph.size, size_of_depth
    )
    normals = normals_from_depth(shrunk, shrunk_from_image @ level.photograph.camera_matrix)

    def draw(page: _Page, top: int) -> None:
        page.heading(MARGIN_PX, top, "Depth", "bright: near; white: unknown")
        axes = page.axes(MARGIN_PX, top + HEAD_PX, size)
        low, high = np.nanpercentile(1.0 / depth, [1, 99])
        axes.imshow(1.0 / depth, cmap="cividis", vmin=low, vmax=high, aspect="auto")
        caption = "red: to the right, green: down, blue: towards the camera; white: unknown"
        page.heading(second_left, top, "Normals", caption)
        axes = page.axes(second_left, top + HEAD_PX, size)
        axes.imshow(normal_colors(normals), aspect="auto")

    return _Section(HEAD_PX + size[1], draw)


def normal_colors(normals: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return (h, w, 3) colours of unit normals that face the camera; white where unknown."""
    colors = (normals * [1.0, 1.0, -1.0] + 1.0) / 2.0
    return np.where(np.isnan(colors), 1.0, colors)


# --- Warps


@dataclass(frozen=True)
class Tile:
    """Where one of several pictures is shown.

    Attributes:
        index: of the picture.
        left, top: of its upper left corner in px from that of all of them.
        size: (width, height) in px.
    """

    index: int
    left: int
    top: int
    size: Size


def tiles(sizes: Sequence[Size]) -> list[Tile]:
    """Place pictures of (width, height) in rows of ``INNER_PX``, large ones first.

    All have the same scale, so that they fill ``ALL_TILES_PX``, but none is lower than
    ``MIN_TILE_HEIGHT_PX``, higher than ``MAX_TILE_HEIGHT_PX`` or wider than half a row. A title
    has room above each.
    """
    scale = np.sqrt(ALL_TILES_PX / sum(width * height for width, height in sizes))
    shown = []
    for size in sizes:
        height = np.clip(scale * size[1], MIN_TILE_HEIGHT_PX, MAX_TILE_HEIGHT_PX)
        shown.append(fitted(size, (MAX_TILE_WIDTH_PX, round(height))))
    placed: list[Tile] = []
    left = top = row_height = 0
    for index in sorted(range(len(sizes)), key=lambda index: -shown[index][1]):
        width = max(shown[index][0], MIN_TILE_WIDTH_PX)
        if left + width > INNER_PX:
            left, top = 0, top + TILE_TITLE_PX + row_height + TILE_GAP_PX
        row_height = shown[index][1] if left == 0 else row_height
        placed.append(Tile(index, left, top + TILE_TITLE_PX, shown[index]))
        left += width + TILE_GAP_PX
    return placed


def _warps(level: InspectedLevel, colors: Sequence[Color]) -> _Section:
    items = level.plan.items
    by_area = sorted(range(len(items)), key=lambda index: -items[index].canvas_area_px)
    chosen = sorted(by_area[:MAX_NUM_TILES])
    placed = tiles([items[index].canvas_size for index in chosen])
    caption = (
        "largest first. Warp: tilt, tilt angle; width x height in px; features kept of those found."
        f" Ellipses: kept (the strongest {MAX_NUM_TILE_FEATURES}; {FEATURE_SIGMAS:g} sigma);"
        " dots: all found; pale: outside of the region"
    )
    if len(items) > len(chosen):
        caption += f". {len(items) - len(chosen)} more, smaller ones are not shown"

    def draw(page: _Page, top: int) -> None:
        page.heading(MARGIN_PX, top, "Warps", caption)
        for tile in placed:
            index = chosen[tile.index]
            left, tile_top = MARGIN_PX + tile.left, top + HEAD_PX + tile.top
            _draw_warp(page, left, tile_top, tile.size, level, index + 1, colors[index])

    return _Section(HEAD_PX + max(tile.top + tile.size[1] for tile in placed), draw)


def _draw_warp(
    page: _Page,
    left: int,
    top: int,
    size: Size,
    level: InspectedLevel,
    warp_id: int,
    color: Color,
) -> None:
    item = level.plan.items[warp_id - 1]
    found, kept = level.found[warp_id], level.kept_of(warp_id)
    angle = np.rad2deg(item.tilt_angle_rad)
    page.text(left, top - 34, f"{warp_id}:  {item.tilt:.2f}, {angle:.0f}°", weight="bold")
    width, height = item.canvas_size
    page.text(left, top - 18, f"{width} x {height};  {len(kept)} of {len(found)}")
    axes = page.axes(left, top, size)
    image, mask = level.views[warp_id]
    pale = (255 - (255 - image) // 4).astype(np.uint8)
    _show(axes, image if mask is None else np.where(mask, image, pale), size)
    x, y = found.keypoints.T
    axes.scatter(x, y, s=2.5, color=DARK, linewidths=0)
    frames = transform_frames(item.rectified_from_image, kept.lafs)
    _draw_features(axes, kept.with_frames(frames), [color] * len(kept), MAX_NUM_TILE_FEATURES)


# --- Features


def _features(level: InspectedLevel, colors: Sequence[Color]) -> _Section:
    features = level.features
    size = fitted(level.photograph.size, FEATURES_BOX_PX)
    shown = min(len(features), MAX_NUM_FEATURES)
    caption = (
        f"the strongest {shown} of {len(features)}, {FEATURE_SIGMAS:g} sigma; gray: of the"
        " photograph itself; coloured: of warps"
    )

    def draw(page: _Page, top: int) -> None:
        page.heading(MARGIN_PX, top, "Features", caption)
        axes = page.axes(MARGIN_PX, top + HEAD_PX, size)
        _show(axes, level.photograph.gray, size, fade=0.5)
        palette = [to_rgb(DARK), *colors]
        ids = features.rectification_ids.tolist()
        _draw_features(axes, features, [palette[view] for view in ids], MAX_NUM_FEATURES)

    return _Section(HEAD_PX + size[1], draw)


def _draw_features(
    axes: Axes, features: LocalFeatures, colors: Sequence[Color], max_num: int
) -> None:
    order = np.argsort(-features.responses, kind="stable")[:max_num]
    lafs = features.lafs[order]
    outlines = lafs[:, :, :2] @ UNIT_CIRCLE * (FEATURE_SIGMAS / MEASUREMENT_SIGMAS)
    segments = np.swapaxes(outlines + lafs[:, :, 2:], 1, 2)
    chosen = [colors[index] for index in order.tolist()]
    axes.add_collection(LineCollection(list(segments), colors=chosen, linewidths=1.2))


def _show(axes: Axes, image: GrayImage, shown_px: Size, *, fade: float = 0.0) -> None:
    """Show an image, mixed with white, so that data coordinates are its px."""
    size = (image.shape[1], image.shape[0])
    values = 255.0 - (1.0 - fade) * (255.0 - shrink_to(image, max(shown_px)))
    axes.imshow(values, cmap="gray", vmin=0, vmax=255, extent=_extent(size), aspect="auto")
    axes.autoscale(False)


def _extent(size: Size) -> tuple[float, float, float, float]:
    return -HALF_PIXEL, size[0] - HALF_PIXEL, size[1] - HALF_PIXEL, -HALF_PIXEL
