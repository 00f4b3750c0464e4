"""Show what a recipe does to an image, a sheet for each level.

A sheet has the photograph with its regions, its features, and the warps.
"""

import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_affrect.data import (
    ColorImage,
    LocalFeatures,
    Mask,
    Photograph,
    RectificationPlan,
    View,
)
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.geometry.affine import transform_lafs
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.geometry.lines import Lines
from colmap_affrect.images.lines import lines_of
from colmap_affrect.images.orientation import picture_down
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.line_report import line_report
from colmap_affrect.project.outputs import fitting_name, new_results
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.line_pictures import line_sheet
from colmap_affrect.report.sheets import (
    PALETTE,
    Color,
    Panel,
    Point,
    encode_png,
    rgb,
    row_of,
    text_row,
)
from colmap_affrect.stages.one_image import ImageExtractor

# What is drawn was chosen by eye, so that a sheet stays readable.
PANELS_PER_ROW = 2  # photographs
WARPS_PER_ROW = 6
MAX_NUM_WARPS = 24  # the largest
MAX_NUM_FEATURES = 1500  # on a photograph, the strongest
MAX_NUM_WARP_FEATURES = 120  # on a warp, the strongest
MAX_NUM_NUMBERS = 3  # of warps of one region
TINT = 0.45  # share of the colour of a region in its pixels
MASK_DIMMING = 3  # masked pixels have this part of their brightness
FEATURE_FADING = 2  # contrast of a photograph under its features is divided by it
OUTSIDE_FADING = 4  # contrast outside of the mask of a warp is divided by it
DARK: Color = (85, 85, 85)  # of features that are of no warp


@dataclass(frozen=True)
class InspectedLevel:
    """One level of a recipe, carried out on one photograph.

    Coordinates are px of the photograph at the size of processing where nothing else is said.
    """

    photograph: Photograph
    plan: RectificationPlan
    not_rectified: str  # why the photograph was not, as asked; empty if it was
    # by rectification id, 0 for the photograph itself: the view in which features were detected,
    # and all of them, LAFs in px of the view
    detected: Mapping[int, tuple[View, LocalFeatures]]
    features: LocalFeatures  # of all views, without those that were discarded
    seconds: float


def draw_sheet(level: InspectedLevel, summary: str, path: Path) -> None:
    """Draw one level and write it as PNG.

    The summary comes first, then the photograph with its regions beside its features, then the
    largest warps with their features. A region and its warp have one colour.

    Args:
        level: what is drawn.
        summary: text above the sheet.
        path: the PNG file, which is replaced.
    """
    colors = warp_colors(level.plan)
    warps = [_warp(level, index, colors[index]) for index in _largest_warps(level.plan)]
    photographs = [_regions(level), _features(level, colors)]
    rows = [text_row(summary), row_of(photographs, PANELS_PER_ROW)]
    for first in range(0, len(warps), WARPS_PER_ROW):
        rows.append(row_of(warps[first : first + WARPS_PER_ROW], WARPS_PER_ROW))
    replace_bytes(path, encode_png(rows))


def _largest_warps(plan: RectificationPlan) -> list[int]:
    """Return the indices of the largest warps, in the order of the plan."""
    indices = range(len(plan.items))
    by_area = sorted(indices, key=lambda index: -plan.items[index].canvas_area_px)
    return sorted(by_area[:MAX_NUM_WARPS])


def _regions(level: InspectedLevel) -> Panel:
    """Draw the photograph with its regions, each with the numbers of its warps."""
    image = tinted(level.photograph, level.plan)
    masked = ""
    if level.photograph.mask is not None:
        image[~level.photograph.mask] //= MASK_DIMMING
        masked = "; dark: masked"
    labels = _region_labels(level.plan)
    title = "regions by number of warp" if labels else "no regions"
    panel = Panel.fit(image, PANELS_PER_ROW, title + masked)
    panel.draw_labels(labels)
    return panel


def _region_labels(plan: RectificationPlan) -> dict[Point, str]:
    """Return the numbers of the warps of each region, by the middle of the region."""
    numbers = defaultdict[Point, list[str]](list)
    for number, item in enumerate(plan.items, 1):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            left, top = item.region_origin
            middle = (columns.mean() + left, rows.mean() + top)
            numbers[middle].append(str(number))
    return {
        middle: ", ".join(same[:MAX_NUM_NUMBERS]) for middle, same in numbers.items()
    }


def _features(level: InspectedLevel, colors: Sequence[Color]) -> Panel:
    """Draw the features on the faded photograph, in the colours of the warps they are of."""
    features = level.features
    palette = [DARK, *colors]
    feature_colors = [palette[number] for number in features.rectification_ids.tolist()]
    num_shown = min(len(features), MAX_NUM_FEATURES)
    title = (
        f"the strongest {num_shown} of {len(features)} features; gray: without a warp"
    )
    panel = Panel.fit(
        _faded(level.photograph.gray, FEATURE_FADING), PANELS_PER_ROW, title
    )
    panel.draw_features(features, feature_colors, MAX_NUM_FEATURES)
    return panel


def _warp(level: InspectedLevel, index: int, color: Color) -> Panel:
    """Draw a warp with those of its features that were kept."""
    item = level.plan.items[index]
    rectification_id = index + 1
    (image, mask), detected = level.detected[rectification_id]
    is_of_warp = level.features.rectification_ids == rectification_id
    kept = level.features.select(is_of_warp)
    if mask is not None:
        inside = mask if image.ndim == 2 else mask[:, :, None]
        image = np.where(inside, image, _faded(image, OUTSIDE_FADING))
    counts = f"{len(kept)} of {len(detected)} features"
    title = f"{rectification_id}: tilt {item.tilt:.2f}, {counts}"
    panel = Panel.fit(image, WARPS_PER_ROW, title)
    features = replace(kept, lafs=transform_lafs(item.rectified_from_image, kept.lafs))
    panel.draw_features(features, [color] * len(kept), MAX_NUM_WARP_FEATURES)
    return panel


def _faded(image: Bytes, factor: int) -> Bytes:
    """Return an image with its contrast divided by a factor, white staying white."""
    return 255 - (255 - image) // factor


def warp_colors(plan: RectificationPlan) -> list[Color]:
    """Return a colour for each warp.

    Warps of one segment have the same colour, and so have those of the whole image with one tilt.
    """
    numbers: dict[tuple[float, float] | int, int] = {}  # of colours, by tilt or segment
    colors = []
    for item in plan.items:
        key = (
            (item.tilt, item.tilt_angle_rad) if item.region is None else item.segment_id
        )
        number = numbers.setdefault(key, len(numbers))
        colors.append(rgb(PALETTE[number % len(PALETTE)]))
    return colors


def tinted(photograph: Photograph, plan: RectificationPlan) -> ColorImage:
    """Return the (H, W, 3) photograph with each region in the colour of its warp."""
    image = np.repeat(photograph.gray[:, :, None], 3, axis=2)
    for item, color in zip(plan.items, warp_colors(plan), strict=True):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            left, top = item.region_origin
            pixels = (rows + top, columns + left)
            grays = photograph.gray[pixels][:, None]
            mixed = (1.0 - TINT) * grays + TINT * np.array(color)
            image[pixels] = np.rint(mixed).astype(np.uint8)
    return image


def inspect_image(
    extractor: ImageExtractor, path: Path, output_path: Path, mask: Mask | None = None
) -> str:
    """Carry out a recipe on one image and draw every level.

    ``<stem>-inspection.png`` is the level of every image, ``<stem>-inspection-level-<k>.png`` level
    k of escalation, ``<stem>-inspection-lines.png`` has its straight lines. Where a depth map
    cannot be used the level has no warps, as in extraction.

    Args:
        extractor: carries out the recipe.
        path: the photograph.
        output_path: folder of the sheets.
        mask: (H, W) bool of the image as it is stored, False where it is not to be used.

    Returns:
        A line for each level, one on the lines, and one for each sheet.

    Raises:
        ImageError: the photograph cannot be read.
        OptionError: the output folder is not ours.
    """
    workspace = Workspace(output_path)
    workspace.require_own(path.parent)
    numbers = list(extractor.rectifiers)
    photographs = []
    sheets = [output_path / fitting_name(path.stem, "-inspection-lines.png")]
    original_size = (0, 0)
    for number in numbers:
        photograph, original_size = extractor.photograph(path, mask=mask, level=number)
        photographs.append(photograph)
        suffix = f"-level-{number}" if number else ""
        sheets.append(output_path / fitting_name(path.stem, f"-inspection{suffix}.png"))
    workspace.begin()
    lines = []
    with new_results(*sheets, replaces=True) as new_sheets:
        for number, photograph, sheet in zip(
            numbers, photographs, new_sheets[1:], strict=True
        ):
            level = inspect_level(extractor, photograph, number)
            name = extractor.options.levels[number].rectifier.name
            line = f"level {number}, {name}: {_summary(level)}"
            draw_sheet(level, line, sheet)
            why = level.not_rectified
            lines.append(f"{line}; not rectified: {why}" if why else line)
        found = lines_of(photographs[0].gray, photographs[0].mask, picture_down(path))
        lines.append(_draw_lines(photographs[0], original_size, found, new_sheets[0]))
    return "\n".join([*lines, *map(str, sheets)])


def _draw_lines(
    photograph: Photograph,
    original_size: tuple[int, int],
    found: Lines,
    sheet: Path,
) -> str:
    """Draw the straight lines of a photograph; return what they say."""
    report = line_report(found.findings(), original_size)
    replace_bytes(sheet, line_sheet(photograph.gray, found, report, photograph.mask))
    return f"lines: {report.sentence()}"


def inspect_level(
    extractor: ImageExtractor, photograph: Photograph, number: int
) -> InspectedLevel:
    """Carry out one level of a recipe as extraction does, and keep what it works with.

    Args:
        extractor: carries out the recipe.
        photograph: at the size of processing of the level.
        number: of the level.

    Returns:
        The plan, the views, and the features before and after their selection.
    """
    start = time.perf_counter()
    plan, not_rectified = extractor.plan(photograph, number)
    recorder = _Recorder(extractor.extractors[number])
    extractors = {**extractor.extractors, number: recorder}
    recorded = replace(extractor, extractors=extractors)
    features = recorded.execute(photograph, plan, number)
    looks_at_photograph = extractor.options.levels[number].base == number
    first_id = 0 if looks_at_photograph else 1
    detected = dict(enumerate(recorder.detected, first_id))
    seconds = time.perf_counter() - start
    return InspectedLevel(photograph, plan, not_rectified, detected, features, seconds)


class _Recorder:
    """A feature extractor that keeps the views another one gets, and the features it detects."""

    def __init__(self, extractor: FeatureExtractor) -> None:
        self.extractor = extractor
        self.descriptor_size = extractor.descriptor_size
        self.detected: list[tuple[View, LocalFeatures]] = []

    def detect(self, view: View) -> LocalFeatures:
        features = self.extractor.detect(view)
        self.detected.append((view, features))
        return features

    def describe(
        self, images: Sequence[Bytes], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        return self.extractor.describe(images, detected)


def _summary(level: InspectedLevel) -> str:
    num_warps = len(level.plan.items)
    if not num_warps:
        return f"no warps; {len(level.features)} features; {level.seconds:.1f} s"
    warps = "warp" if num_warps == 1 else "warps"
    warped_share = level.plan.rectified_area_px / math.prod(level.plan.image_size)
    from_warps = int(np.count_nonzero(level.features.rectification_ids))
    return (
        f"{num_warps} {warps} of {warped_share:.2f} image areas;"
        f" {len(level.features)} features, {from_warps} of them in warps; {level.seconds:.1f} s"
    )
