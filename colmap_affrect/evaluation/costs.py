"""What the features of an image cost: size of the warps, and seconds by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import LocalFeatures, Photograph, RectificationPlan
from colmap_affrect.project.stopwatch import Stopwatch
from colmap_affrect.report.levels import PIXELS_PER_MEGAPIXEL, TimedFeatures
from colmap_affrect.stages.one_image import ExtractedImage, ImageExtractor

IMAGE_STEPS = ("plan", "warp", "detect", "describe")
PAIR_STEPS = ("match", "estimate")
STEPS = (*IMAGE_STEPS, *PAIR_STEPS)
"""Steps that are timed. ``warp`` has what belongs to it: masks, carrying features back, choosing
among them; ``detect`` has the descriptors too of extractors that compute both at once (RootSIFT).
Reading images is not counted."""


@dataclass(frozen=True)
class ImageCost:
    """What the features of one image cost, or the mean of several.

    Attributes:
        area_mpx: area of all warps in megapixels, the image itself not counted.
        num_keypoints: features of the image and of its warps.
        num_regions: different parts of the image that are warped.
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

    def complexity(self) -> dict[str, float]:
        """Return what the paper's table of complexity has."""
        return {
            "area_mpx": self.area_mpx,
            "num_keypoints": self.num_keypoints,
            "num_regions": self.num_regions,
            "num_warps": self.num_warps,
            "warps_per_region": self.warps_per_region,
        }

    @classmethod
    def total(cls, costs: Sequence[Self]) -> Self:
        """Add up, as over the levels of an image."""
        return cls(**{key: sum(vars(cost)[key] for cost in costs) for key in vars(cls())})

    @classmethod
    def mean(cls, costs: Sequence[Self]) -> Self:
        """Average over images; all 0 without any."""
        total = vars(cls.total(costs))
        return cls(**{key: value / max(1, len(costs)) for key, value in total.items()})


@dataclass(eq=False)
class _TimedExtractor(ImageExtractor):
    """An extractor that takes the time of its steps and keeps its plans."""

    watch: Stopwatch = field(default_factory=Stopwatch)
    plans: list[RectificationPlan] = field(default_factory=list)

    def plan(self, photograph: Photograph, level: int = 0) -> RectificationPlan:
        with self.watch.step("plan"):
            self.plans.append(super().plan(photograph, level))
        return self.plans[-1]

    def execute(
        self,
        photograph: Photograph,
        plan: RectificationPlan,
        level: int = 0,
    ) -> LocalFeatures:
        with self.watch.step("warp"):
            return super().execute(photograph, plan, level)


def extract_measured(
    extractor: ImageExtractor,
    path: Path,
    name: str = "",
    intrinsics: NDArray[np.float64] | None = None,
    level: int = 0,
) -> tuple[ExtractedImage, ImageCost]:
    """Extract the features of an image, as :meth:`ImageExtractor.extract_file`, and their cost."""
    watch = Stopwatch(*IMAGE_STEPS)
    timed = _TimedExtractor(
        extractor.options,
        tuple(TimedFeatures(item, watch) for item in extractor.extractors),
        extractor.rectifiers,
        extractor.weights,
        extractor.resources,
        watch=watch,
    )
    found = timed.extract_file(path, name, intrinsics, level)
    plan = timed.plans[-1] if timed.plans else RectificationPlan(found.image_size)
    return found, ImageCost(
        plan.rectified_area_px / PIXELS_PER_MEGAPIXEL,
        len(found.features),
        plan.num_regions,
        len(plan.items),
        **{f"{step}_s": seconds for step, seconds in watch.seconds.items()},
    )
