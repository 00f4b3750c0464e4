"""What the features of an image cost: size of the warps, and seconds by step."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.extraction import ExtractedImage, ImageExtractor
from colmap_affrect.interfaces import FeatureProfile
from colmap_affrect.types import (
    GrayImage,
    LocalFeatures,
    Mask,
    Photograph,
    RectificationPlan,
    View,
)

IMAGE_STEPS = ("plan", "warp", "detect", "describe")
PAIR_STEPS = ("match", "estimate")
STEPS = (*IMAGE_STEPS, *PAIR_STEPS)
"""Steps that are timed. ``warp`` has what belongs to it: masks, carrying features back, choosing
among them; ``detect`` has the descriptors too of profiles that compute both at once (RootSIFT).
Reading images is not counted."""

PIXELS_PER_MEGAPIXEL = 1e6


@dataclass(frozen=True)
class ImageCost:
    """What the features of one image cost, or the mean of several.

    Attributes:
        area_mpx: area of all warps in megapixels, the image itself not counted.
        num_keypoints: features of the image and of its warps.
        num_regions: different parts of the image that are warped.
        num_warps: warps.
        plan_s, warp_s, detect_s, describe_s: seconds.
    """

    area_mpx: float = 0.0
    num_keypoints: float = 0.0
    num_regions: float = 0.0
    num_warps: float = 0.0
    plan_s: float = 0.0
    warp_s: float = 0.0
    detect_s: float = 0.0
    describe_s: float = 0.0

    @property
    def warps_per_region(self) -> float:
        """Mean number of warps of a region, 0 where nothing is warped."""
        return self.num_warps / self.num_regions if self.num_regions else 0.0

    @property
    def total_s(self) -> float:
        """Seconds of all steps."""
        return sum(self.seconds().values())

    def seconds(self) -> dict[str, float]:
        """Return the seconds by step."""
        return {step: getattr(self, f"{step}_s") for step in IMAGE_STEPS}

    def __add__(self, other: Self) -> Self:
        """Add up, as over the levels of an image."""
        mine, theirs = vars(self), vars(other)
        return type(self)(**{key: mine[key] + theirs[key] for key in mine})

    @classmethod
    def mean(cls, costs: Sequence[Self]) -> Self:
        """Average over images; all 0 without any."""
        total = sum(costs, start=cls())
        count = max(1, len(costs))
        return cls(**{item.name: getattr(total, item.name) / count for item in fields(cls)})

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return dict(vars(self))

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Read :meth:`to_mapping`."""
        return cls(**values)


@dataclass
class _Stopwatch:
    """Seconds since it was last set to zero, by step, and the last plan."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(IMAGE_STEPS, 0.0))
    plan: RectificationPlan | None = None


class _TimedProfile:
    """A feature profile that takes the time of its steps."""

    def __init__(self, profile: FeatureProfile, watch: _Stopwatch) -> None:
        self._profile, self._watch = profile, watch
        self.descriptor_size = profile.descriptor_size

    def detect(self, view: View) -> LocalFeatures:
        start = time.perf_counter()
        detected = self._profile.detect(view)
        self._watch.seconds["detect"] += time.perf_counter() - start
        return detected

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        start = time.perf_counter()
        described = self._profile.describe(images, detected)
        self._watch.seconds["describe"] += time.perf_counter() - start
        return described


@dataclass(frozen=True)
class _TimedExtractor(ImageExtractor):
    """An extractor that takes the time of planning, and of execution without the profile."""

    watch: _Stopwatch = field(default_factory=_Stopwatch)

    def plan(self, photograph: Photograph, level: int = 0) -> RectificationPlan:
        start = time.perf_counter()
        try:
            self.watch.plan = super().plan(photograph, level)
        finally:
            self.watch.seconds["plan"] += time.perf_counter() - start
        return self.watch.plan

    def execute(
        self,
        image: GrayImage,
        plan: RectificationPlan,
        *,
        with_original: bool = True,
        mask: Mask | None = None,
    ) -> LocalFeatures:
        seconds = self.watch.seconds
        start, before = time.perf_counter(), seconds["detect"] + seconds["describe"]
        features = super().execute(image, plan, with_original=with_original, mask=mask)
        profile_s = seconds["detect"] + seconds["describe"] - before
        seconds["warp"] += time.perf_counter() - start - profile_s
        return features


def extract_measured(
    extractor: ImageExtractor,
    path: Path,
    name: str = "",
    intrinsics: NDArray[np.float64] | None = None,
    level: int = 0,
) -> tuple[ExtractedImage, ImageCost]:
    """Extract the features of an image, as :meth:`ImageExtractor.extract_file`, and their cost."""
    watch = _Stopwatch()
    profile = _TimedProfile(extractor.profile, watch)
    timed = _TimedExtractor(
        extractor.options, profile, extractor.rectifiers, extractor.weights, watch=watch
    )
    found = timed.extract_file(path, name, intrinsics, level)
    plan = watch.plan
    cost = ImageCost(
        area_mpx=plan.rectified_area_px / PIXELS_PER_MEGAPIXEL if plan else 0.0,
        num_keypoints=len(found.features),
        num_regions=plan.num_regions if plan else 0,
        num_warps=len(plan.items) if plan else 0,
        **{f"{step}_s": watch.seconds[step] for step in IMAGE_STEPS},
    )
    return found, cost
