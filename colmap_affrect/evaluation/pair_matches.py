"""Matches of the pairs of a dataset by one recipe, level by level where the recipe escalates.

A pair is matched as a run of its two images alone would match it: a recipe with escalation climbs
until COLMAP's geometric verification finds enough inliers, and the level with most of them counts.
Its cameras are taken for unknown.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

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
from colmap_affrect.progress import Progress
from colmap_affrect.stages import MatchableCache

VERIFICATION_SEED = 0


@dataclass(frozen=True)
class MatchedPair:
    """The matches of a pair.

    Attributes:
        pair: the pair.
        points: (M, 2) pixel-centre px of the matches in each image.
        num_keypoints: features of the two images that were matched.
        level: of escalation; -1 when no level was verified.
        verified_inliers: of COLMAP's two-view geometry; 0 if a run would not take it, or if the
            recipe does not escalate.
        seconds: of matching and verification, at all levels that were tried.
    """

    pair: EvaluationPair
    points: tuple[NDArray[np.floating], NDArray[np.floating]]
    num_keypoints: tuple[int, int]
    level: int
    verified_inliers: int
    seconds: float


def match_all(
    pairs: Sequence[EvaluationPair],
    features: RecipeFeatures,
    max_num_keypoints: int | None,
    title: str,
    progress: Progress,
) -> Iterator[MatchedPair]:
    """Extract what the pairs need, match them, and yield each as soon as it is decided.

    Pairs of images without features (``features.failures``) are left out.

    Args:
        pairs: of the dataset.
        features: of the recipe.
        max_num_keypoints: of each image, the strongest of all its features; None for all.
        title: of the recipe, for progress.
        progress: where to show progress of extraction.
    """
    options = features.recipe.extraction
    num_levels = len(options.rectifiers)
    todo, best = list(pairs), dict[str, MatchedPair]()
    for level, rectifier in enumerate(options.rectifiers):
        names = sorted({image.name for pair in todo for image in pair.images})
        label = f"{title}, {rectifier.name}" if num_levels > 1 else title
        features.extract(names, level, label, progress)
        todo = [pair for pair in todo if not _lost(pair, features)]
        still_open = []
        for found in _match(todo, features, level, max_num_keypoints, verify=num_levels > 1):
            name = found.pair.name
            best[name] = _better(best.get(name), found)
            counts = {("1", "2"): best[name].verified_inliers}
            if level + 1 < num_levels and open_pairs(counts, options.escalation_strong_num_inliers):
                still_open.append(found.pair)
            else:
                yield best.pop(name)
        todo = still_open


def _lost(pair: EvaluationPair, features: RecipeFeatures) -> bool:
    return any(image.name in features.failures for image in pair.images)


def _better(known: MatchedPair | None, new: MatchedPair) -> MatchedPair:
    """Choose the one with more verified inliers, of equals the new one without, and add times."""
    if known is None:
        return new
    takes_new = new.verified_inliers > known.verified_inliers or not known.verified_inliers
    return replace(new if takes_new else known, seconds=known.seconds + new.seconds)


def _match(
    pairs: Sequence[EvaluationPair],
    features: RecipeFeatures,
    level: int,
    max_num_keypoints: int | None,
    *,
    verify: bool,
) -> Iterator[MatchedPair]:
    options = features.recipe.matching
    cache = MatchableCache(features.store, options, level, max_num_keypoints)
    sizes = features.store.image_sizes()

    def match(pair: EvaluationPair) -> MatchedPair:
        names = tuple(image.name for image in pair.images)
        (image1, _), (image2, _) = cache[names[0]], cache[names[1]]
        start = time.perf_counter()
        rows1, rows2 = match_features(image1, image2, options).indices.T
        points = image1.keypoints[rows1], image2.keypoints[rows2]
        count = verified_inliers(*points, sizes[names[0]], sizes[names[1]]) if verify else 0
        return MatchedPair(
            pair,
            points,
            (len(image1.keypoints), len(image2.keypoints)),
            level if count else -1,
            count,
            time.perf_counter() - start,
        )

    return map_ordered(match, pairs, available_cores())


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
