"""Matches of the pairs of a dataset by one recipe, level by level where the recipe escalates.

A pair is matched as a run of its two images alone would match it: a recipe with escalation climbs
until COLMAP's geometric verification finds enough inliers, and the level with most of them counts.
Its cameras are taken for unknown.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.verification import REJECTED, two_view_options
from colmap_affrect.conventions import DEFAULT_FOCAL_RATIO, colmap_from_pixel
from colmap_affrect.escalation import open_pairs
from colmap_affrect.evaluation.protocol import EvaluationPair
from colmap_affrect.evaluation.recipe_features import RecipeFeatures
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.matching.nearest import match_features
from colmap_affrect.options import VerificationOptions
from colmap_affrect.pair_tasks import MatchableCache
from colmap_affrect.progress import Progress

VERIFICATION_SEED = 0

Result = TypeVar("Result")


@dataclass(frozen=True)
class MatchedPair:
    """The matches of a pair.

    Attributes:
        pair: the pair.
        points: (M, 2) pixel-centre px of the matches in each image.
        num_keypoints: features of the two images that were matched.
        level: of escalation; None when no level was verified, or without escalation.
        num_levels: that were tried.
        verified_inliers: of COLMAP's two-view geometry; 0 if a run would not take it, or without
            escalation.
        seconds: of matching and verification, at all levels that were tried.
    """

    pair: EvaluationPair
    points: tuple[NDArray[np.float64], NDArray[np.float64]]
    num_keypoints: tuple[int, int]
    level: int | None
    num_levels: int
    verified_inliers: int
    seconds: float


@dataclass(frozen=True)
class PairMatcher:
    """Matches pairs by the features of a recipe.

    Attributes:
        features: of the recipe.
        max_num_keypoints: of each image, the strongest of all its features; None for all.
        title: of the recipe, for progress.
        progress: where to show progress.
    """

    features: RecipeFeatures
    max_num_keypoints: int | None
    title: str
    progress: Progress

    def run(
        self, pairs: Sequence[EvaluationPair], finish: Callable[[MatchedPair], Result]
    ) -> Iterator[Result]:
        """Extract what pairs need, match them, and yield what ``finish`` makes of their matches.

        It is called in parallel, as soon as the matches of a pair are decided. Pairs of images that
        cannot be used (``features.failures``) are left out.
        """
        rectifiers = self.features.recipe.extraction.rectifiers
        todo, best = list(pairs), dict[str, MatchedPair]()
        for level, rectifier in enumerate(rectifiers):
            names = sorted({image.name for pair in todo for image in pair.images})
            title = f"{self.title}, {rectifier.name}" if len(rectifiers) > 1 else self.title
            self.features.extract(names, level, title, self.progress)
            lost = [pair for pair in todo if self._is_lost(pair)]
            yield from (finish(best.pop(pair.name)) for pair in lost if pair.name in best)
            todo = [pair for pair in todo if not self._is_lost(pair)]
            with self.progress.stage(title, len(todo), "pairs") as advance:
                for found, result in self._level(level, todo, best, finish):
                    if result is not None:
                        best.pop(found.pair.name, None)
                        yield result
                    else:
                        best[found.pair.name] = found
                    advance(1)
            todo = [pair for pair in todo if pair.name in best]

    def _is_lost(self, pair: EvaluationPair) -> bool:
        return any(image.name in self.features.failures for image in pair.images)

    def _level(
        self,
        level: int,
        pairs: Sequence[EvaluationPair],
        best: Mapping[str, MatchedPair],
        finish: Callable[[MatchedPair], Result],
    ) -> Iterator[tuple[MatchedPair, Result | None]]:
        """Yield the best matches of each pair so far, with a result if it need not climb on."""
        extraction, matching = self.features.recipe.extraction, self.features.recipe.matching
        num_levels = len(extraction.rectifiers)
        cache = MatchableCache(self.features.store, matching, level, self.max_num_keypoints)
        sizes = self.features.store.image_sizes()

        def match(pair: EvaluationPair) -> tuple[MatchedPair, Result | None]:
            names = tuple(image.name for image in pair.images)
            (image1, _), (image2, _) = cache[names[0]], cache[names[1]]
            start = time.perf_counter()
            rows1, rows2 = match_features(image1, image2, matching).indices.T
            points = image1.keypoints[rows1], image2.keypoints[rows2]
            count = 0
            if num_levels > 1:
                count = verified_inliers(*points, sizes[names[0]], sizes[names[1]])
            found = MatchedPair(
                pair,
                (points[0].astype(np.float64), points[1].astype(np.float64)),
                (len(image1.keypoints), len(image2.keypoints)),
                level if count else None,
                level + 1,
                count,
                time.perf_counter() - start,
            )
            found = _better(best.get(pair.name), found)
            counts = {("1", "2"): found.verified_inliers}
            strong = extraction.escalation_strong_num_inliers
            climbs = level + 1 < num_levels and bool(open_pairs(counts, strong))
            return found, None if climbs else finish(found)

        return map_ordered(match, pairs, available_cores())


def _better(known: MatchedPair | None, new: MatchedPair) -> MatchedPair:
    """Choose the one with more verified inliers, the new one if none has any; add their times."""
    if known is None:
        return new
    takes_new = new.verified_inliers > known.verified_inliers or not known.verified_inliers
    seconds = known.seconds + new.seconds
    return replace(new if takes_new else known, seconds=seconds, num_levels=new.num_levels)


def verified_inliers(
    points1: NDArray[np.floating],
    points2: NDArray[np.floating],
    size1: tuple[int, int],
    size2: tuple[int, int],
) -> int:
    """Return the inliers of COLMAP's two-view geometry; 0 if a run would not take it.

    Args:
        points1: (M, 2) pixel-centre px of image 1.
        points2: (M, 2) those of image 2 that match them.
        size1: (width, height) of image 1 in px.
        size2: (width, height) of image 2 in px.
    """
    options = VerificationOptions()
    geometry = pycolmap.estimate_two_view_geometry(
        _unknown_camera(1, size1),
        colmap_from_pixel(points1),
        _unknown_camera(2, size2),
        colmap_from_pixel(points2),
        np.stack([np.arange(len(points1))] * 2, axis=1),
        two_view_options(options, VERIFICATION_SEED),
    )
    if geometry.config in REJECTED:
        return 0
    count = len(geometry.inlier_matches)
    return count if count >= options.min_num_inliers else 0


def _unknown_camera(camera_id: int, size: tuple[int, int]) -> pycolmap.Camera:
    """Return what COLMAP assumes of an image without EXIF: a camera of its own, of unknown focus.

    The id matters: two images of one camera are verified in another way.
    """
    focal_px = DEFAULT_FOCAL_RATIO * max(size)
    return pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_RADIAL", focal_px, *size)
