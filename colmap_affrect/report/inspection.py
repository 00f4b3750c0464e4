"""Show what a recipe does to an image: one level after the other, as sheets to look at."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_affrect.data import (
    GrayImage,
    LocalFeatures,
    Mask,
    Photograph,
    RectificationPlan,
    View,
)
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.progress import Stopwatch
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.sheet import draw_sheet
from colmap_affrect.stages.one_image import ImageExtractor


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
    numbers = range(len(extractor.rectifiers))
    read = [extractor.photograph(path, mask=mask, level=number)[0] for number in numbers]
    workspace.begin()
    lines = []
    suffixes = [f"-level-{number}" if number else "" for number in numbers]
    sheets = [output_path / f"{path.stem}-inspection{suffix}.png" for suffix in suffixes]
    with new_results(*sheets, replaces=True) as new_sheets:
        for number, (photograph, sheet) in enumerate(zip(read, new_sheets, strict=True)):
            level = inspect_level(extractor, photograph, number)
            text = f"level {number}, {level.rectifier}: {summary(level)}"
            draw_sheet(level, text, sheet)
            lines.append("; ".join(filter(None, (text, level.warning))))
    return "\n".join([*lines, *map(str, sheets)])


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
