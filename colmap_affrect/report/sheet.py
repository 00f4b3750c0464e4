"""One picture of one level of a recipe: regions, space of tilts, depth, warps, features."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
from matplotlib.transforms import Bbox

from colmap_affrect.conventions import HALF_PIXEL, MEASUREMENT_SIGMAS, resized_from_original
from colmap_affrect.data import GrayImage, LocalFeatures, RectificationPlan
from colmap_affrect.geometry.affine import transform_frames
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.planes import normals_from_depth, shrink_depth
from colmap_affrect.images.reading import shrink_to
from colmap_affrect.rectifiers.base import CoverOptions
from colmap_affrect.rectifiers.depth_planes import MAX_DEPTH_SIZE_PX
from colmap_affrect.report.levels import PIXELS_PER_MEGAPIXEL, InspectedLevel, summary
from colmap_affrect.report.regions import (
    UNIT_CIRCLE,
    Color,
    Size,
    circle_origin,
    region_area_px,
    region_middle,
    region_pixels,
    warp_colors,
)
from colmap_affrect.report.tilt_plot import (
    HEIGHT_PER_WIDTH,
    TiltClass,
    draw_tilt_space,
    tilt_space_captions,
)

DPI = 100
WIDTH_PX = 1800
MARGIN_PX = 24
INNER_PX = WIDTH_PX - 2 * MARGIN_PX
HEAD_PX = 50  # title and caption of a section
FONT_PT, TITLE_PT = 9.0, 12.0
DARK = "#555555"

TILE_TITLE_PX = 36
TILE_GAP_PX = 14
MIN_TILE_WIDTH_PX = 190
MAX_TILE_WIDTH_PX = (INNER_PX - TILE_GAP_PX) // 2
MIN_TILE_HEIGHT_PX, MAX_TILE_HEIGHT_PX = 72, 440
ALL_TILES_PX = INNER_PX * 550  # area of all warps as they are shown, nearly

STYLE: list[str | dict[str, Any]] = [
    "default",
    {"font.family": "DejaVu Sans", "font.size": FONT_PT, "text.parse_math": False},
]


class FigurePage:
    """A figure that is filled downwards; places are px from its top left corner.

    What is drawn also lies beyond its bottom. ``top`` is where the next section begins.
    """

    def __init__(self) -> None:
        self.figure = Figure(figsize=(WIDTH_PX / DPI, 1.0), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        self.top = MARGIN_PX

    def axes(self, left: float, top: float, size: Size) -> Axes:
        """Add axes without frame and ticks."""
        width, height = size
        bottom = 1.0 - (top + height) / DPI
        axes = self.figure.add_axes((left / WIDTH_PX, bottom, width / WIDTH_PX, height / DPI))
        axes.set_axis_off()
        return axes

    def text(self, left: float, top: float, text: str, **style: Any) -> None:
        """Write a line whose top left corner is given."""
        self.figure.text(left / WIDTH_PX, 1.0 - top / DPI, printable(text), va="top", **style)

    def heading(self, left: float, title: str, caption: str) -> None:
        """Write a title and, below it, how to read what follows; ``HEAD_PX`` high."""
        self.text(left, self.top, title, fontsize=TITLE_PT, weight="bold")
        self.text(left, self.top + 24, caption, color=DARK)


@contextmanager
def figure_page(path: Path) -> Iterator[FigurePage]:
    """Fill a page in the block; then what was drawn is written as PNG, ``WIDTH_PX`` wide."""
    with matplotlib.style.context(STYLE):
        page = FigurePage()
        yield page
        drawn = Bbox([[0.0, 1.0 - page.top / DPI], [WIDTH_PX / DPI, 1.0]])
        page.figure.savefig(path, format="png", bbox_inches=drawn)


def printable(text: str) -> str:
    """Replace the characters that the font of the sheets has no glyph for."""
    font = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return "".join(
        character if font.get_char_index(ord(character)) else "\N{REPLACEMENT CHARACTER}"
        for character in text
    )


def fitted(size: Size, box: Size) -> Size:
    """Scale (width, height) so that it just fits into a box."""
    scale = min(box[0] / size[0], box[1] / size[1])
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


Tile = tuple[int, int, Size]  # left, top and size of a picture in px


def tiles(sizes: Sequence[Size]) -> list[Tile]:
    """Place pictures of (width, height) in rows of ``INNER_PX``, large ones first.

    All have the same scale, so that they fill ``ALL_TILES_PX``, but none is lower than
    ``MIN_TILE_HEIGHT_PX``, higher than ``MAX_TILE_HEIGHT_PX`` or wider than half a row. A title
    has room above each.
    """
    scale = np.sqrt(ALL_TILES_PX / sum(width * height for width, height in sizes))
    heights = [np.clip(scale * h, MIN_TILE_HEIGHT_PX, MAX_TILE_HEIGHT_PX) for _, h in sizes]
    shown = [
        fitted(size, (MAX_TILE_WIDTH_PX, round(height)))
        for size, height in zip(sizes, heights, strict=True)
    ]
    placed: dict[int, Tile] = {}
    left = top = row_height = 0
    for index in sorted(range(len(sizes)), key=lambda index: -shown[index][1]):
        width = max(shown[index][0], MIN_TILE_WIDTH_PX)
        if left + width > INNER_PX:
            left, top = 0, top + TILE_TITLE_PX + row_height + TILE_GAP_PX
        row_height = shown[index][1] if left == 0 else row_height
        placed[index] = (left, top + TILE_TITLE_PX, shown[index])
        left += width + TILE_GAP_PX
    return [placed[index] for index in range(len(sizes))]


def ranges(numbers: Sequence[int], max_num: int) -> str:
    """Write rising numbers as ranges, the first ``max_num`` of them.

    >>> ranges([1, 2, 3, 5, 8, 9], 2)
    '1-3, 5 ...'
    """
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs]
    return ", ".join(texts[:max_num]) + " ..." * (len(texts) > max_num)


NAME_PX, LINE_PX = 34, 20
NAME_CHARS, LINE_CHARS = 110, 200  # what fits into a line of the header
HEADER_PT, NAME_PT = 10.5, 16.0

MAP_BOX_PX = (900, 720)
MAX_TILTS_WIDTH_PX = 880
DEPTH_BOX_PX = ((INNER_PX - MARGIN_PX) // 2, 560)
FEATURES_BOX_PX = (INNER_PX, 1000)
"""Largest width and height of the pictures."""
MIN_MAP_PX, MIN_DEPTH_PX = 520, 240
"""Room for the captions of narrow pictures that have another one at their right."""

MAX_NUM_TILES = 40

MAX_NUM_LEGEND_ROWS = 14
MAX_NUM_MARK_LABELS = 16
MAX_NUM_FEATURES = 1500
MAX_NUM_TILE_FEATURES = 120

FEATURE_SIGMAS = 2.0  # radius of the ellipses drawn for features, in sigma
WARNING = "#B03A00"

OUTLINED = [withStroke(linewidth=2.5, foreground="white")]


def draw_sheet(level: InspectedLevel, stored_size: Size, path: Path) -> None:
    """Draw one level and write it as PNG, ``WIDTH_PX`` wide and as high as it takes.

    From top to bottom: the regions over the photograph and the shapes in the space of tilts; depth
    and normals, where there are any; the warps with their features; all features. ``stored_size``
    is (width, height) of the image file in px.
    """
    colors = warp_colors(level.plan)
    with figure_page(path) as page:
        _draw_header(page, level, stored_size)
        if level.plan.items or level.shapes is not None:
            _draw_overview(page, level, colors)
        if level.depth is not None:
            _draw_depth_and_normals(page, level, level.depth)
        if level.plan.items:
            _draw_warps(page, level, colors)
        _draw_all_features(page, level, colors)


def _draw_header(page: FigurePage, level: InspectedLevel, stored_size: Size) -> None:
    width, height = level.photograph.size
    stored = f" (stored: {stored_size[0]} x {stored_size[1]} px)"
    which = f"level {level.number} of escalation" if level.number else "level of every image"
    options = level.options
    shapes = f" ({options.shape_source.name})" if isinstance(options, CoverOptions) else ""
    steps = ", ".join(f"{step} {seconds:.2f} s" for step, seconds in level.seconds.items())
    about = [
        f"{width} x {height} px{stored * (level.photograph.size != stored_size)};"
        f" {which}: rectifier {level.options.name}{shapes}, features {level.extractor_name}",
        f"{summary(level)}: {steps}" + "; contrast stretched" * level.photograph.stretched,
        HOW_TO_READ,
    ]
    for name in wrap(level.photograph.name, NAME_CHARS):
        page.text(MARGIN_PX, page.top, name, fontsize=NAME_PT, weight="bold")
        page.top += NAME_PX
    warnings = wrap(level.warning, LINE_CHARS)
    for line in [*about, *warnings]:
        color = WARNING if line in warnings else "black"
        page.text(MARGIN_PX, page.top, line, fontsize=HEADER_PT, color=color)
        page.top += LINE_PX
    page.top += MARGIN_PX


MASKED = (0.0, 0.0, 0.0, 0.65)  # colour and opacity over what a mask leaves out
HOW_TO_READ = (
    "From above: where the photograph is looked at anew and how strongly it is tilted there, the"
    " warps made of these places, and the features of all of them; one colour is one warp."
)


# --- Regions and the space of tilts

LEGEND_COLUMNS = {
    "segment": 30, "tilt": 115, "angle": 175, "of image": 235, "warped": 325, "found": 425,
    "kept": 490, "warps": 555,
}  # fmt: skip
"""Heads of the legend and their distance from its left side in px."""

WarpIds = dict[tuple[int, float, float], list[int]]
"""Ids of the warps of each class in each segment, by segment, tilt and angle."""


def _draw_overview(page: FigurePage, level: InspectedLevel, colors: Sequence[Color]) -> None:
    map_size = fitted(level.photograph.size, MAP_BOX_PX)
    left = MARGIN_PX + max(map_size[0], MIN_MAP_PX) + 2 * MARGIN_PX
    tilts_width = min(WIDTH_PX - MARGIN_PX - left, MAX_TILTS_WIDTH_PX)
    tilts_size = (tilts_width, round(tilts_width * HEIGHT_PER_WIDTH))
    groups: WarpIds = {}
    for warp_id, item in enumerate(level.plan.items, 1):
        groups.setdefault((item.segment_id, item.tilt, item.tilt_angle_rad), []).append(warp_id)

    masked = "; dark: masked" if level.photograph.mask is not None else ""
    page.heading(MARGIN_PX, "Regions", _map_caption(level.plan) + masked)
    _draw_map(page.axes(MARGIN_PX, page.top + HEAD_PX, map_size), map_size, level, colors)
    caption, more = tilt_space_captions(level)
    page.heading(left, "Space of tilts", caption)
    page.text(left, page.top + HEAD_PX - 6, more, color=DARK)
    is_labelled = len(groups) <= MAX_NUM_MARK_LABELS
    classes = [
        TiltClass(tilt, angle_rad, ranges(ids, 2) if is_labelled else "", colors[ids[0] - 1])
        for (_, tilt, angle_rad), ids in groups.items()
    ]
    tilts_top = page.top + HEAD_PX + LINE_PX
    draw_tilt_space(page.axes(left, tilts_top, tilts_size), level, classes, colors)
    legend_top = tilts_top + tilts_size[1] + MARGIN_PX
    bottom = _draw_legend(page, left, legend_top, level, groups, colors) if groups else legend_top
    page.top = max(page.top + HEAD_PX + map_size[1], bottom) + MARGIN_PX


def _draw_legend(
    page: FigurePage,
    left: int,
    top: int,
    level: InspectedLevel,
    groups: WarpIds,
    colors: Sequence[Color],
) -> int:
    """Draw a table of the classes of warps and return its bottom."""
    for title, offset in LEGEND_COLUMNS.items():
        page.text(left + offset, top, title, color=DARK, weight="bold")
    for (segment, tilt, angle_rad), ids in list(groups.items())[:MAX_NUM_LEGEND_ROWS]:
        top += LINE_PX
        members = [level.plan.items[warp_id - 1] for warp_id in ids]
        width, height = size = level.plan.image_size
        share = sum(region_area_px(item, size) for item in members) / (width * height)
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
        page.axes(left, top - 1, (18, 14)).imshow([[colors[ids[0] - 1]]], aspect="auto")
        for offset, cell in zip(LEGEND_COLUMNS.values(), cells, strict=True):
            page.text(left + offset, top, cell)
    if len(groups) > MAX_NUM_LEGEND_ROWS:
        top += LINE_PX
        num_left_out = len(groups) - MAX_NUM_LEGEND_ROWS
        page.text(left, top, f"and {num_left_out} more; all are in the JSON file", color=DARK)
    return top + LINE_PX


def _map_caption(plan: RectificationPlan) -> str:
    if any(item.region is not None for item in plan.items):
        return "tint: segment; number: warp; ellipse: what the warp turns into a circle"
    return "every warp shows the whole photograph" if plan.items else "no warps"


def _draw_map(axes: Axes, shown_px: Size, level: InspectedLevel, colors: Sequence[Color]) -> None:
    width, height = size = level.photograph.size
    _show(axes, level.photograph.gray, shown_px, fade=0.25)
    tint = np.zeros((height, width, 4), dtype=np.float32)
    if level.photograph.mask is not None:
        tint[~level.photograph.mask] = MASKED
    ids_at: dict[tuple[float, ...], list[int]] = {}
    for warp_id, (item, color) in enumerate(zip(level.plan.items, colors, strict=True), 1):
        if item.region is None:
            continue
        tint[region_pixels(item)] = (*color, 0.5)
        middle = region_middle(item.region, item.region_origin)
        ids_at.setdefault(tuple(middle.tolist()), []).append(warp_id)
        ellipse = circle_origin(item, middle, 0.022 * max(size))
        axes.plot(*ellipse, color="white", linewidth=4.0, zorder=2)
        axes.plot(*ellipse, color=color, linewidth=2.0, zorder=3)
    axes.imshow(tint, interpolation="nearest", extent=_extent(size), aspect="auto")
    for (x, y), ids in ids_at.items():
        text = ranges(ids, 2)
        axes.text(x, y, text, ha="center", va="center", path_effects=OUTLINED, zorder=4)


# --- Depth


def _draw_depth_and_normals(page: FigurePage, level: InspectedLevel, depth: Floats) -> None:
    photograph = level.photograph
    size = fitted(photograph.size, DEPTH_BOX_PX)
    shrunk, shrunk_from_depth = shrink_depth(depth, MAX_DEPTH_SIZE_PX)
    depth_from_image = resized_from_original(photograph.size, (depth.shape[1], depth.shape[0]))
    shrunk_from_image = shrunk_from_depth @ depth_from_image
    normals = normals_from_depth(shrunk, shrunk_from_image @ photograph.camera_matrix)

    page.heading(MARGIN_PX, "Depth", "bright: near; white: unknown")
    axes = page.axes(MARGIN_PX, page.top + HEAD_PX, size)
    low, high = np.nanpercentile(1.0 / depth, [1, 99])
    axes.imshow(1.0 / depth, cmap="cividis", vmin=low, vmax=high, aspect="auto")
    left = MARGIN_PX + max(size[0], MIN_DEPTH_PX) + MARGIN_PX
    caption = "red: to the right, green: down, blue: towards the camera; white: unknown"
    page.heading(left, "Normals", caption)
    page.axes(left, page.top + HEAD_PX, size).imshow(normal_colors(normals), aspect="auto")
    page.top += HEAD_PX + size[1] + MARGIN_PX


def normal_colors(normals: Floats) -> Array:
    """Return (h, w, 3) colours of unit normals that face the camera; white where unknown."""
    colors = (normals * [1.0, 1.0, -1.0] + 1.0) / 2.0
    return np.where(np.isnan(colors), 1.0, colors)


# --- Warps


def _draw_warps(page: FigurePage, level: InspectedLevel, colors: Sequence[Color]) -> None:
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
    page.heading(MARGIN_PX, "Warps", caption)
    page.top += HEAD_PX
    for index, tile in zip(chosen, placed, strict=True):
        _draw_warp(page, tile, level, index + 1, colors[index])
    page.top += max(top + size[1] for _, top, size in placed) + MARGIN_PX


def _draw_warp(
    page: FigurePage, tile: Tile, level: InspectedLevel, warp_id: int, color: Color
) -> None:
    item = level.plan.items[warp_id - 1]
    found, kept = level.found[warp_id], level.kept_of(warp_id)
    left, top, size = MARGIN_PX + tile[0], page.top + tile[1], tile[2]
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


def _draw_all_features(page: FigurePage, level: InspectedLevel, colors: Sequence[Color]) -> None:
    features = level.features
    size = fitted(level.photograph.size, FEATURES_BOX_PX)
    shown = min(len(features), MAX_NUM_FEATURES)
    caption = (
        f"the strongest {shown} of {len(features)}, {FEATURE_SIGMAS:g} sigma; gray: of the"
        " photograph itself; coloured: of warps"
    )
    page.heading(MARGIN_PX, "Features", caption)
    axes = page.axes(MARGIN_PX, page.top + HEAD_PX, size)
    _show(axes, level.photograph.gray, size, fade=0.5)
    palette = [to_rgb(DARK), *colors]
    ids = features.rectification_ids.tolist()
    _draw_features(axes, features, [palette[view] for view in ids], MAX_NUM_FEATURES)
    page.top += HEAD_PX + size[1] + MARGIN_PX


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
