"""Matches of the pairs of a dataset by one recipe, level by level where the recipe escalates.

A pair is matched as a run of its two images alone would match it: a recipe with escalation climbs
until COLMAP's geometric verification finds enough inliers, and the level with most of them counts.
Its cameras are taken for unknown.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import colmap_keypoints
from colmap_affrect.colmap.verification import Side, VerificationOptions, estimate_geometry
from colmap_affrect.conventions import DEFAULT_FOCAL_RATIO
from colmap_affrect.evaluation.protocol import EvaluationPair
from colmap_affrect.evaluation.recipe_features import RecipeFeatures
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import Progress
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.climbing import insecure_images
from colmap_affrect.stages.one_pair import CachedMatcher, Matching

VERIFICATION_SEED = 0

Result = TypeVar("Result")


@dataclass(frozen=True)
class MatchedPair:
    """The matches of a pair."""

    pair: EvaluationPair
    points: tuple[Array, Array]  # (M, 2) pixel-centre px of the matches in each image
    num_keypoints: tuple[int, int]
    # rectifier of the level of escalation that counts, ``none`` when no level was verified;
    # empty without escalation
    level: str
    num_levels: int  # that were tried
    # of COLMAP's two-view geometry; 0 if a run would not take it, or without escalation
    verified_inliers: int
    seconds: float  # of matching and verification, at all levels that were tried

    def better(self, new: Self) -> Self:
        """Choose the one with more verified inliers, the new one if none has any; add times."""
        takes_new = new.verified_inliers > self.verified_inliers or not self.verified_inliers
        seconds = self.seconds + new.seconds
        return replace(new if takes_new else self, seconds=seconds, num_levels=new.num_levels)


@dataclass(frozen=True)
class PairMatcher:
    """Matches pairs by so many of the strongest features of each image; None for all."""

    recipe: Recipe
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
        levels = self.recipe.extraction.levels
        todo, best = list(pairs), dict[str, MatchedPair]()
        for level, chosen in enumerate(levels):
            names = sorted({image.name for pair in todo for image in pair.images})
            title = f"{self.title}, {chosen.name}" if len(levels) > 1 else self.title
            self.features.extract(names, level, title, self.progress)
            usable = []
            for pair in todo:
                if not any(image.name in self.features.failures for image in pair.images):
                    usable.append(pair)
                elif pair.name in best:
                    yield finish(best[pair.name])
            todo = []
            with self.progress.stage(title, len(usable), "pairs") as advance:
                for found, result in self._level(level, usable, best, finish):
                    best[found.pair.name] = found
                    if result is None:
                        todo.append(found.pair)
                    else:
                        yield result
                    advance(1)

    def _level(
        self,
        level: int,
        pairs: Sequence[EvaluationPair],
        best: Mapping[str, MatchedPair],
        finish: Callable[[MatchedPair], Result],
    ) -> Iterator[tuple[MatchedPair, Result | None]]:
        """Yield the best matches of each pair so far, with a result if it need not climb on."""
        extraction = self.recipe.extraction
        chosen = extraction.levels[level]
        matching = Matching(
            self.features.store,
            chosen.matching or self.recipe.matching,
            level,
            chosen.base,
            chosen.features.kind,
            self.features.resources,
            self.max_num_keypoints,
        )
        prepared = CachedMatcher(matching)
        sizes = self.features.store.image_sizes()

        def match(pair: EvaluationPair) -> tuple[MatchedPair, Result | None]:
            name1, name2 = (image.name for image in pair.images)
            image1, image2 = prepared.prepared(name1), prepared.prepared(name2)
            start = time.perf_counter()
            rows1, rows2 = prepared.match(image1, image2).indices.T
            frames = (image1.frames[rows1], image2.frames[rows2])
            count, decided = 0, ""
            if extraction.escalation:
                limit = chosen.max_image_size_px
                count = verified_inliers(frames, (sizes[name1], sizes[name2]), limit)
                decided = chosen.name if count else "none"
            found = MatchedPair(
                pair,
                (frames[0][:, :, 2], frames[1][:, :, 2]),
                (len(image1.frames), len(image2.frames)),
                decided,
                level + 1,
                count,
                time.perf_counter() - start,
            )
            if pair.name in best:
                found = best[pair.name].better(found)
            inliers = {(name1, name2): found.verified_inliers}
            is_open = bool(insecure_images(inliers, self.recipe.escalate.strong_num_inliers))
            climbs = is_open and level < len(extraction.escalation)
            return found, None if climbs else finish(found)

        return map_ordered(match, pairs, available_cores())


def verified_inliers(
    frames: tuple[Floats, Floats],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    extracted_px: int | None = None,
) -> int:
    """Return the inliers of COLMAP's two-view geometry; 0 if a run would not take it.

    ``frames`` are (M, 2, 3) local affine frames that match, pixel-centre px, in images of ``sizes``
    (width, height), which were shrunk to a longer side of ``extracted_px``.
    """
    options = VerificationOptions(random_seed=VERIFICATION_SEED)
    first, second = (
        Side(
            # What COLMAP assumes of an image without EXIF: a camera of its own, of unknown focus.
            # The id matters: two images of one camera are verified in another way.
            pycolmap.Camera.create_from_model_name(
                camera_id, "SIMPLE_RADIAL", DEFAULT_FOCAL_RATIO * max(size), *size
            ),
            colmap_keypoints(lafs),
        )
        for camera_id, (size, lafs) in enumerate(zip(sizes, frames, strict=True), 1)
    )
    rows = np.stack([np.arange(len(frames[0]))] * 2, axis=1)
    return len(estimate_geometry((first, second), rows, options, extracted_px).inlier_matches)
