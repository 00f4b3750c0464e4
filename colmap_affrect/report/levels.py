"""One level of a recipe carried out on one photograph, with all that is decided on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.extraction import MIN_RECTIFIABLE_PX, ImageExtractor
from colmap_affrect.interfaces import DepthSource, FeatureProfile, ShapeSource
from colmap_affrect.options import DenseShapesOptions, RectifierOptions
from colmap_affrect.types import (
    GrayImage,
    LocalFeatures,
    Photograph,
    Rectification,
    RectificationPlan,
    ShapeSamples,
    View,
)

PIXELS_PER_MEGAPIXEL = 1_000_000


@runtime_checkable
class ReadsShapes(Protocol):
    """A rectifier whose warps follow affine shapes; one without this attribute shows none."""

    shapes: ShapeSource | None


@runtime_checkable
class ReadsDepth(Protocol):
    """A rectifier whose regions follow a depth map; one without this attribute shows none."""

    source: DepthSource | None


@dataclass(frozen=True)
class InspectedLevel:
    """One level of a recipe, carried out on one photograph.

    Attributes:
        number: 0 for the level that every image gets.
        options: of its rectifier.
        profile_name: of the features.
        photograph: at the size of processing; coordinates are px of it where nothing else is said.
        plan: of the rectifier.
        warning: why it was not rectified though it was to be; empty if all went well.
        views: what features were looked for in, by rectification id; 0 is the photograph itself.
        found: all features detected there, frames in px of the view.
        features: those of all views that were kept.
        shapes: what the rectifier read; None if it reads no shapes.
        depth: (h, w) z-depth that it read; None if it reads no depth.
        seconds: by step.
    """

    number: int
    options: RectifierOptions
    profile_name: str
    photograph: Photograph
    plan: RectificationPlan
    warning: str
    views: Mapping[int, View]
    found: Mapping[int, LocalFeatures]
    features: LocalFeatures
    shapes: ShapeSamples | None
    depth: NDArray[np.floating] | None
    seconds: Mapping[str, float]

    def kept_of(self, rectification_id: int) -> LocalFeatures:
        """Return the kept features of one view, frames in px of the photograph."""
        return self.features.select(self.features.rectification_ids == rectification_id)

    @property
    def warped_share(self) -> float:
        """Area of all warps in areas of the photograph."""
        width, height = self.plan.image_size
        return self.plan.rectified_area_px / (width * height)


def inspect_level(extractor: ImageExtractor, photograph: Photograph, number: int) -> InspectedLevel:
    """Carry out level ``number`` of a recipe as extraction does, and keep all that passes by."""
    start = perf_counter()
    plan, warning = extractor.plan_or_warn(photograph, number)
    planned = perf_counter()
    recorder = _Recorder(extractor.profile)
    recording = replace(extractor, profile=recorder)
    features = recording.execute(
        photograph.gray, plan, with_original=number == 0, mask=photograph.mask
    )
    executed = perf_counter()
    first_id = 0 if number == 0 else 1
    return InspectedLevel(
        number,
        extractor.options.rectifiers[number],
        extractor.options.features.profile,
        photograph,
        plan,
        warning,
        dict(enumerate(recorder.views, first_id)),
        dict(enumerate(recorder.found, first_id)),
        features,
        _shapes(extractor, photograph, number),
        None if warning else _depth(extractor, photograph, number),
        {
            "plan": planned - start,
            "warp and choose": executed - planned - recorder.detect_s - recorder.describe_s,
            "detect": recorder.detect_s,
            "describe": recorder.describe_s,
        },
    )


class _Recorder:
    """A feature profile that keeps, in order, what another one is shown and finds in it."""

    def __init__(self, profile: FeatureProfile) -> None:
        self.profile = profile
        self.descriptor_size = profile.descriptor_size
        self.views: list[View] = []
        self.found: list[LocalFeatures] = []
        self.detect_s = self.describe_s = 0.0

    def detect(self, view: View) -> LocalFeatures:
        start = perf_counter()
        found = self.profile.detect(view)
        self.detect_s += perf_counter() - start
        self.views.append(view)
        self.found.append(found)
        return found

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        start = perf_counter()
        described = self.profile.describe(images, detected)
        self.describe_s += perf_counter() - start
        return described


def _shapes(extractor: ImageExtractor, photograph: Photograph, number: int) -> ShapeSamples | None:
    """Read the affine shapes again that the rectifier of a level has read."""
    rectifier = extractor.rectifiers[number]
    if not isinstance(rectifier, ReadsShapes) or rectifier.shapes is None:
        return None
    if min(photograph.size) < MIN_RECTIFIABLE_PX:
        return None
    if isinstance(extractor.options.rectifiers[number], DenseShapesOptions):
        return rectifier.shapes.grid(photograph.gray).samples()
    return rectifier.shapes.samples(photograph.gray)


def _depth(
    extractor: ImageExtractor, photograph: Photograph, number: int
) -> NDArray[np.floating] | None:
    """Read the depth map again that the rectifier of a level has read."""
    rectifier = extractor.rectifiers[number]
    if not isinstance(rectifier, ReadsDepth) or rectifier.source is None:
        return None
    if min(photograph.size) < MIN_RECTIFIABLE_PX:
        return None
    return rectifier.source.depth(photograph)


def describe_level(level: InspectedLevel) -> dict[str, Any]:
    """Return one level as plain values for JSON: warps, totals, seconds.

    Coordinates and areas are in px of the photograph at the size of processing; a ``share`` is
    that of its area; a ``bounding_box`` is left, top, width, height.
    """
    plan = level.plan
    regions = plan.num_regions
    return {
        "level": level.number,
        "rectifier": level.options.name,
        "features": level.profile_name,
        "warning": level.warning,
        "original": {
            "features_found": len(level.found[0]) if 0 in level.found else 0,
            "features_kept": len(level.kept_of(0)),
        },
        "warps": [_describe_warp(level, *warp) for warp in enumerate(plan.items, 1)],
        "totals": {
            "warped_area_mpx": plan.rectified_area_px / PIXELS_PER_MEGAPIXEL,
            "warped_share": level.warped_share,
            "keypoints": len(level.features),
            "regions": regions,
            "warps": len(plan.items),
            "warps_per_region": len(plan.items) / regions if regions else 0.0,
        },
        "seconds": {step: round(seconds, 4) for step, seconds in level.seconds.items()},
    }


def _describe_warp(level: InspectedLevel, warp_id: int, item: Rectification) -> dict[str, Any]:
    width, height = level.plan.image_size
    area_px = region_area_px(item, level.plan.image_size)
    return {
        "id": warp_id,
        "segment": item.segment_id,
        "tilt": float(item.tilt),
        "angle_deg": float(np.rad2deg(item.tilt_angle_rad)),
        "rectified_from_image": item.rectified_from_image.tolist(),
        "canvas_size": list(item.canvas_size),
        "region": {
            "bounding_box": list(bounding_box(item, level.plan.image_size)),
            "area_px": area_px,
            "share": area_px / (width * height),
        },
        "features_found": len(level.found[warp_id]),
        "features_kept": len(level.kept_of(warp_id)),
    }


def region_area_px(item: Rectification, image_size: tuple[int, int]) -> int:
    """Count the pixels of a region in an image of (width, height)."""
    if item.region is None:
        return image_size[0] * image_size[1]
    return int(np.count_nonzero(item.region))


def bounding_box(item: Rectification, image_size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, width and height of a region in an image of (width, height), in px."""
    if item.region is None:
        return (0, 0, *image_size)
    columns = np.flatnonzero(item.region.any(axis=0))
    rows = np.flatnonzero(item.region.any(axis=1))
    left, top = item.region_origin[0] + int(columns[0]), item.region_origin[1] + int(rows[0])
    return left, top, int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1


def summary(level: InspectedLevel) -> str:
    """Return one line about a level for people."""
    count, total_s = len(level.plan.items), sum(level.seconds.values())
    if not count:
        return f"no warps; {len(level.features)} features; {total_s:.1f} s"
    from_warps = int(np.count_nonzero(level.features.rectification_ids))
    return (
        f"{count} warp{'s' * (count != 1)} of {level.warped_share:.2f} image areas;"
        f" {len(level.features)} features, {from_warps} of them in warps; {total_s:.1f} s"
    )
