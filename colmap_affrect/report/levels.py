"""One level of a recipe carried out on one photograph, with all that is decided on the way."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from colmap_affrect.data import (
    GrayImage,
    LocalFeatures,
    Photograph,
    Rectification,
    RectificationPlan,
    View,
)
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.progress import Stopwatch
from colmap_affrect.stages.one_image import ImageExtractor

PIXELS_PER_MEGAPIXEL = 1_000_000


@dataclass(frozen=True)
class InspectedLevel:
    """One level of a recipe, carried out on one photograph."""

    number: int  # 0 for the level that every image gets
    rectifier: str  # names of both parts
    extractor: str
    # at the size of processing; coordinates are px of it where nothing else is said
    photograph: Photograph
    plan: RectificationPlan
    warning: str  # why it was not rectified though it was to be; empty if all went well
    # what features were looked for in, by rectification id; 0 is the photograph itself
    views: Mapping[int, View]
    found: Mapping[int, LocalFeatures]  # all features detected there, frames in px of the view
    features: LocalFeatures  # those of all views that were kept
    seconds: Mapping[str, float]

    def kept_of(self, rectification_id: int) -> LocalFeatures:
        """Return the kept features of one view, frames in px of the photograph."""
        return self.features.select(self.features.rectification_ids == rectification_id)

    @property
    def warped_share(self) -> float:
        """Area of all warps in areas of the photograph."""
        return self.plan.rectified_area_px / math.prod(self.plan.image_size)


def inspect_level(extractor: ImageExtractor, photograph: Photograph, number: int) -> InspectedLevel:
    """Carry out level ``number`` of a recipe as extraction does, and keep all that passes by."""
    watch = Stopwatch("plan", "warp and choose", "detect", "describe")
    with watch.step("plan"):
        plan, warning = extractor.plan_or_warn(photograph, number)
    level = extractor.options.levels[number]
    recorder = _Recorder(extractor.extractors[number], watch)
    recorders = (*extractor.extractors[:number], recorder, *extractor.extractors[number + 1 :])
    with watch.step("warp and choose"):
        features = replace(extractor, extractors=recorders).execute(photograph, plan, number)
    first_id = 0 if level.base == number else 1
    return InspectedLevel(
        number,
        level.rectifier.name,
        level.features.name,
        photograph,
        plan,
        warning,
        dict(enumerate(recorder.views, first_id)),
        dict(enumerate(recorder.found, first_id)),
        features,
        watch.seconds,
    )


class _Recorder:
    """A feature extractor that times another one, and keeps in order what it is shown and finds."""

    def __init__(self, extractor: FeatureExtractor, watch: Stopwatch) -> None:
        self.extractor, self.watch = extractor, watch
        self.descriptor_size = extractor.descriptor_size
        self.views: list[View] = []
        self.found: list[LocalFeatures] = []

    def detect(self, view: View) -> LocalFeatures:
        self.views.append(view)
        with self.watch.step("detect"):
            self.found.append(self.extractor.detect(view))
        return self.found[-1]

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        with self.watch.step("describe"):
            return self.extractor.describe(images, detected)


def describe_level(level: InspectedLevel) -> dict[str, Any]:
    """Return one level as plain values for JSON.

    Coordinates and areas are in px of the photograph at the size of processing, boxes are left,
    top, width, height.
    """
    plan = level.plan
    regions = plan.num_regions
    return {
        "level": level.number,
        "rectifier": level.rectifier,
        "features": level.extractor,
        "size": list(level.photograph.size),
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
    size = level.plan.image_size
    area_px = math.prod(size) if item.region is None else int(np.count_nonzero(item.region))
    return {
        "id": warp_id,
        "segment": item.segment_id,
        "tilt": float(item.tilt),
        "angle_deg": float(np.rad2deg(item.tilt_angle_rad)),
        "rectified_from_image": item.rectified_from_image.tolist(),
        "canvas_size": list(item.canvas_size),
        "region": {
            "bounding_box": list(bounding_box(item, size)),
            "area_px": area_px,
            "share": area_px / math.prod(size),
        },
        "features_found": len(level.found[warp_id]),
        "features_kept": len(level.kept_of(warp_id)),
    }


def bounding_box(item: Rectification, image_size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, width and height of a region in an image of (width, height), in px."""
    if item.region is None:
        return (0, 0, *image_size)
    left, top, width, height = cv2.boundingRect(item.region.astype(np.uint8))
    return left + item.region_origin[0], top + item.region_origin[1], width, height


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
