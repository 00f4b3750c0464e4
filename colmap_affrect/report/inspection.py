"""Show what a recipe does to an image: one level after the other, as sheets to look at.

A sheet has the photograph with its regions, its features, and the warps.
"""

import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.data import ColorImage, LocalFeatures, Mask, Photograph, RectificationPlan, View
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.geometry.affine import project, transform_lafs
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS, resized_from_original
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.outputs import fitting_name, new_results
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.one_image import ImageExtractor

Color = tuple[int, int, int]
Marks = dict[tuple[float, float], str]  # text by place, px

PALETTE: Sequence[str] = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#882255",
)  # fmt: skip
"""Okabe and Ito's colours for all kinds of colour vision, and one of Paul Tol's."""
TINT = 0.45  # share of the colour over a region
WIDTH_PX, PANELS_PER_ROW, WARPS_PER_ROW, MAX_NUM_WARPS = 1596, 2, 6, 24
TITLE_PX, MARGIN_PX = 24, 4
MAX_NUM_FEATURES, MAX_NUM_WARP_FEATURES = 1500, 120  # drawn, the strongest
FEATURE_SIGMAS = 2.0  # radius of the ellipses drawn for features
TURN = np.linspace(0.0, 2.0 * np.pi, 25)
UNIT_CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)])
DARK: Color = (85, 85, 85)


@dataclass(frozen=True)
class InspectedLevel:
    """One level of a recipe, carried out on one photograph.

    Coordinates are px of the photograph at the size of processing where nothing else is said.
    """

    photograph: Photograph
    plan: RectificationPlan
    warning: str  # why it was not rectified though it was to be; empty if all went well
    # by rectification id, 0 for the photograph itself: what features were looked for in, and all
    # that were detected there, frames in px of the view
    seen: Mapping[int, tuple[View, LocalFeatures]]
    features: LocalFeatures  # those of all views that were kept
    seconds: float


def draw_sheet(level: InspectedLevel, summary: str, path: Path) -> None:
    """Draw one level under its summary, and write it as PNG.

    Above the photograph with the regions and their warps in one colour each, beside it its
    features; below the largest warps with theirs.
    """
    colors, items = warp_colors(level.plan), level.plan.items
    largest = sorted(range(len(items)), key=lambda index: -items[index].canvas_area_px)
    warps = [_warp(level, index, colors[index]) for index in sorted(largest[:MAX_NUM_WARPS])]
    rows = [row_of([(np.zeros((0, WIDTH_PX, 3), np.uint8), summary)], 1)]
    rows.append(row_of([_regions(level), _features(level, colors)], PANELS_PER_ROW))
    for first in range(0, len(warps), WARPS_PER_ROW):
        rows.append(row_of(warps[first : first + WARPS_PER_ROW], WARPS_PER_ROW))
    _, data = cv2.imencode(".png", np.concatenate(rows)[:, :, ::-1])
    replace_bytes(path, data.tobytes())


def _regions(level: InspectedLevel) -> tuple[ColorImage, str]:
    image = tinted(level.photograph, level.plan)
    if level.photograph.mask is not None:
        image[~level.photograph.mask] //= 3
    numbers = defaultdict(list)
    for number, item in enumerate(level.plan.items, 1):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            middle = columns.mean() + item.region_origin[0], rows.mean() + item.region_origin[1]
            numbers[middle].append(str(number))
    marks = {place: ", ".join(alike[:3]) for place, alike in numbers.items()}
    dark = "; dark: masked" if level.photograph.mask is not None else ""
    title = f"regions by number of warp{dark}" if marks else f"no regions{dark}"
    return panel_of(image, PANELS_PER_ROW, marks=marks), title


def _features(level: InspectedLevel, colors: Sequence[Color]) -> tuple[ColorImage, str]:
    features = level.features
    palette = [DARK, *colors]
    drawn = [palette[number] for number in features.rectification_ids.tolist()]
    pale = 255 - (255 - level.photograph.gray) // 2
    image = panel_of(pale, PANELS_PER_ROW, features, drawn, MAX_NUM_FEATURES)
    shown = min(len(features), MAX_NUM_FEATURES)
    return image, f"the strongest {shown} of {len(features)} features; gray: without a warp"


def _warp(level: InspectedLevel, index: int, color: Color) -> tuple[ColorImage, str]:
    item = level.plan.items[index]
    (image, mask), found = level.seen[index + 1]
    kept = level.features.select(level.features.rectification_ids == index + 1)
    if mask is not None:
        outside = 255 - (255 - image) // 4
        image = np.where(mask if image.ndim == 2 else mask[:, :, None], image, outside)
    features = replace(kept, lafs=transform_lafs(item.rectified_from_image, kept.lafs))
    panel = panel_of(image, WARPS_PER_ROW, features, [color] * len(kept), MAX_NUM_WARP_FEATURES)
    return panel, f"{index + 1}: tilt {item.tilt:.2f}, {len(kept)} of {len(found)} features"


def panel_of(
    image: Bytes,
    per_row: int,
    features: LocalFeatures | None = None,
    colors: Sequence[Color] = (),
    max_num: int = 0,
    marks: Marks | None = None,
) -> ColorImage:
    """Show an (H, W[, 3]) image as large as fits, with its strongest features, and texts."""
    side, height, width = WIDTH_PX // per_row - MARGIN_PX, *image.shape[:2]
    scale = side / max(width, height)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    shrunk = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    panel: ColorImage = np.empty((*size[::-1], 3), np.uint8)
    panel[:] = shrunk.reshape(*size[::-1], -1)
    panel_from_image = resized_from_original((width, height), size)
    if features is not None:
        order = np.argsort(-features.responses, kind="stable")[:max_num]
        lafs = transform_lafs(panel_from_image, features.lafs[order])
        outlines = lafs[:, :, :2] @ UNIT_CIRCLE * (FEATURE_SIGMAS / MEASUREMENT_SIGMAS)
        points = np.rint(np.swapaxes(outlines + lafs[:, :, 2:], 1, 2)).astype(np.int32)
        for index, outline in zip(order.tolist(), points, strict=True):
            cv2.polylines(panel, [outline], True, colors[index], 1, cv2.LINE_AA)
    for place, text in (marks or {}).items():
        x, y = np.rint(project(panel_from_image, np.array([place]))[0]).astype(int).tolist()
        _write(panel, text, (x, y))
    return panel


def row_of(panels: Sequence[tuple[ColorImage, str]], per_row: int) -> ColorImage:
    """Put panels side by side, each below its title."""
    height = max(len(panel) for panel, _ in panels) + TITLE_PX
    row = np.full((height, WIDTH_PX, 3), 255, np.uint8)
    for place, (panel, title) in enumerate(panels):
        left = place * WIDTH_PX // per_row
        row[TITLE_PX : TITLE_PX + len(panel), left : left + panel.shape[1]] = panel
        _write(row, title, (left + MARGIN_PX, TITLE_PX - 8))
    return row


def _write(image: ColorImage, text: str, place: tuple[int, int]) -> None:
    """Write black on white, from the left end of the base line on."""
    for gray, thickness in ((255, 3), (0, 1)):
        how = cv2.FONT_HERSHEY_SIMPLEX, 0.4, (gray,) * 3, thickness, cv2.LINE_AA
        cv2.putText(image, text, place, *how)


def warp_colors(plan: RectificationPlan) -> list[Color]:
    """Choose colours, the same for warps of one segment or of one class of the whole image."""
    keys = [
        (item.tilt, item.tilt_angle_rad) if item.region is None else item.segment_id
        for item in plan.items
    ]
    groups = list(dict.fromkeys(keys))
    texts = [PALETTE[groups.index(key) % len(PALETTE)] for key in keys]
    return [(int(text[1:3], 16), int(text[3:5], 16), int(text[5:], 16)) for text in texts]


def tinted(photograph: Photograph, plan: RectificationPlan) -> ColorImage:
    """Return the (H, W, 3) photograph with each region in the colour of its warp."""
    image = np.repeat(photograph.gray[:, :, None], 3, axis=2)
    for item, color in zip(plan.items, warp_colors(plan), strict=True):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            pixels = rows + item.region_origin[1], columns + item.region_origin[0]
            mixed = (1.0 - TINT) * photograph.gray[pixels][:, None] + TINT * np.array(color)
            image[pixels] = np.rint(mixed).astype(np.uint8)
    return image


def inspect_image(
    extractor: ImageExtractor, path: Path, output_path: Path, mask: Mask | None = None
) -> str:
    """Carry out a recipe on one image, draw every level, and return a summary for people.

    ``<stem>-inspection.png`` is the level of every image, ``<stem>-inspection-level-<k>.png`` level
    k of escalation. Where a depth map cannot be used the level has no warps, as in extraction.
    ``mask`` is (H, W) bool of the stored image. Raises ImageError when the file cannot be read,
    OptionError for an output folder that is not ours.
    """
    workspace = Workspace(output_path)
    workspace.require_own(path.parent)
    numbers = list(extractor.rectifiers)
    read = [extractor.photograph(path, mask=mask, level=number)[0] for number in numbers]
    workspace.begin()
    lines = []
    suffixes = [f"-level-{number}" if number else "" for number in numbers]
    ends = [f"-inspection{suffix}.png" for suffix in suffixes]
    sheets = [output_path / fitting_name(path.stem, end) for end in ends]
    with new_results(*sheets, replaces=True) as new_sheets:
        for number, photograph, sheet in zip(numbers, read, new_sheets, strict=True):
            level = inspect_level(extractor, photograph, number)
            name = extractor.options.levels[number].rectifier.name
            text = f"level {number}, {name}: {_summary(level)}"
            draw_sheet(level, text, sheet)
            lines.append("; ".join(filter(None, (text, level.warning))))
    return "\n".join([*lines, *map(str, sheets)])


def inspect_level(extractor: ImageExtractor, photograph: Photograph, number: int) -> InspectedLevel:
    """Carry out level ``number`` of a recipe as extraction does, and keep all that passes by."""
    start = time.perf_counter()
    plan, warning = extractor.plan(photograph, number)
    recorder = _Recorder(extractor.extractors[number])
    recorders = {**extractor.extractors, number: recorder}
    features = replace(extractor, extractors=recorders).execute(photograph, plan, number)
    first_id = 0 if extractor.options.levels[number].base == number else 1
    seen, seconds = dict(enumerate(recorder.seen, first_id)), time.perf_counter() - start
    return InspectedLevel(photograph, plan, warning, seen, features, seconds)


class _Recorder:
    """A feature extractor that keeps in order what another one is shown and finds."""

    def __init__(self, extractor: FeatureExtractor) -> None:
        self.extractor, self.descriptor_size = extractor, extractor.descriptor_size
        self.seen: list[tuple[View, LocalFeatures]] = []

    def detect(self, view: View) -> LocalFeatures:
        self.seen.append((view, self.extractor.detect(view)))
        return self.seen[-1][1]

    def describe(
        self, images: Sequence[Bytes], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        return self.extractor.describe(images, detected)


def _summary(level: InspectedLevel) -> str:
    count = len(level.plan.items)
    if not count:
        return f"no warps; {len(level.features)} features; {level.seconds:.1f} s"
    warped_share = level.plan.rectified_area_px / math.prod(level.plan.image_size)
    from_warps = int(np.count_nonzero(level.features.rectification_ids))
    return (
        f"{count} warp{'s' * (count != 1)} of {warped_share:.2f} image areas;"
        f" {len(level.features)} features, {from_warps} of them in warps; {level.seconds:.1f} s"
    )
