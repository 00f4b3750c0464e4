"""Show what a recipe does to an image: one level after the other, as sheets to look at."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_affrect.data import GrayImage, LocalFeatures, Mask, Photograph, View
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.sheet import InspectedLevel, draw_sheet
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
    recorders = (*extractor.extractors[:number], recorder, *extractor.extractors[number + 1 :])
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
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
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
