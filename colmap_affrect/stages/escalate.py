"""Escalation on demand: more warps for the pairs of images that need them, and only those.

Level by level (the recipe's ``escalation``; Mishkin, Matas, Perdoch, MODS, 2015) the images of
the pairs that are still open get the features that the level adds, and these pairs are matched
again, by these features and those of the images themselves. New matches take the place of the
old ones only when their two-view geometry has more inliers, so that no pair loses. Two
additions make it serve mapping and not single pairs alone:

- A pair that is verified counts as open while one of its images has no strong pair, or few
  features in tracks through three images.
- Verified pairs of images that gained are matched again at the same level. Their new features
  would otherwise be seen in two images only, and the mapper could not tie them to the rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.verification import PairVerifier, inlier_matches, verified_pairs
from colmap_affrect.errors import ImageError
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.stores import PairMatches
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import (
    Inputs,
    extract_images,
    prepared_recipe,
    recorded_extraction,
    write_images_and_keypoints,
)
from colmap_affrect.stages.match import PAIRS_PER_WRITE, match_pairs, recorded_matching
from colmap_affrect.stages.one_image import ImageExtractor
from colmap_affrect.stages.one_pair import iterate_matches
from colmap_affrect.stages.pairs import listed_pairs
from colmap_affrect.stages.verify import recorded_verification, verify_new


def recorded_escalation(workspace: Workspace) -> EscalateOptions:
    """Return the options on record of escalation, done or still to be done."""
    return EscalateOptions.from_mapping(workspace.planned("escalate") or {}, str(workspace.config))


def escalate(
    context: Context, options: EscalateOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Climb the levels of the recipe; nothing happens when it has none.

    Args:
        context: with verified pairs.
        options: which pairs climb; by default those on record.
        overwrite: bring all pairs back to level 0 first; features that are there are kept.

    Returns:
        ``num_done`` counts the pairs that were matched again now.
    """
    start = time.perf_counter()
    context.resources.require_device()
    context.workspace.require("verify")
    options = options or recorded_escalation(context.workspace)
    context.workspace.record_options("escalate", options.to_mapping(), overwrite=overwrite)
    escalation = Escalation(context, options)
    if overwrite:
        escalation.undo()
    climbed: set[Pair] = set()
    levels = escalation.extraction.escalation
    for level, rectifier in enumerate(levels, 1):
        title = f"{rectifier.name} ({level} of {len(levels)})"
        for choose in (escalation.open_pairs, lambda level=level: escalation.links(level)):
            todo = escalation.untried(choose(), level)
            num_steps = escalation.num_steps(todo, level)
            with context.progress.stage(title, num_steps, "steps") as advance:
                escalation.climb(todo, level, advance)
            climbed |= set(todo)
    return StageReport("escalate", time.perf_counter() - start, len(climbed))


def pair_levels(context: Context) -> dict[str, int]:
    """Return how many pairs each level of a recipe with escalation decided, and how many none.

    Keys are the names of the rectifiers, in order, and ``none``; empty without escalation.
    """
    extraction = recorded_extraction(context.workspace)
    if not extraction.escalation:
        return {}
    names = [rectifier.name for rectifier in extraction.rectifiers]
    escalation = Escalation(context, EscalateOptions())
    num_inliers, levels = escalation.num_inliers(), context.matches.levels(escalation.pairs)
    counts = dict.fromkeys([*names, "none"], 0)
    for pair in escalation.pairs:
        counts[names[levels[pair]] if num_inliers.get(pair) else "none"] += 1
    return counts


def open_pairs(
    num_inliers: Mapping[Pair, int], strong_num_inliers: int, weakly_connected: Collection[str] = ()
) -> list[Pair]:
    """Return the pairs that are not verified, and those of an image that mapping may well lose.

    Args:
        num_inliers: of each pair, 0 where it is not verified.
        strong_num_inliers: an image needs a pair with as many.
        weakly_connected: images that have little in common with two others; see
            :func:`weakly_connected_images`.
    """
    secure = {
        name for pair, count in num_inliers.items() if count >= strong_num_inliers for name in pair
    }.difference(weakly_connected)
    return [pair for pair, count in num_inliers.items() if not count or not secure.issuperset(pair)]


def weakly_connected_images(
    matches: Mapping[Pair, NDArray[np.int64]], min_num_features: int
) -> set[str]:
    """Return the images with too few features in tracks through three images or more.

    A mapper registers an image by features whose matches it has triangulated already. That takes
    two other images, so a strong pair alone ties an image to nothing.

    Args:
        matches: (M, 2) features of the first and the second image, of each verified pair.
        min_num_features: fewer are too few.
    """
    names = sorted({name for pair in matches for name in pair})
    number = {name: index for index, name in enumerate(names)}
    ends = [
        (number[pair[side]] << 32) + indices[:, side]
        for side in (0, 1)
        for pair, indices in matches.items()
    ]
    features, index, num_matches = np.unique(
        np.concatenate([np.zeros(0, np.int64), *ends]), return_inverse=True, return_counts=True
    )
    first, second = index.reshape(2, -1)
    is_shared = num_matches > 1
    in_track = is_shared.copy()
    in_track[first[is_shared[second]]] = True
    in_track[second[is_shared[first]]] = True
    counts = np.bincount(features[in_track] >> 32, minlength=len(names))
    return {name for name, count in zip(names, counts, strict=True) if count < min_num_features}


class Escalation:
    """Lets pairs of a workspace climb to a level, with the options on record."""

    def __init__(self, context: Context, options: EscalateOptions) -> None:
        """Read what is on record."""
        self.context, self.options = context, options
        self.extraction = recorded_extraction(context.workspace)
        self.matching = recorded_matching(context.workspace)
        self.verification = recorded_verification(context.workspace)
        self.pairs = listed_pairs(context)
        self.features, self.matches = context.features, context.matches
        self.path = context.workspace.database

    @cached_property
    def extractor(self) -> ImageExtractor:
        """The recipe, prepared for all images when it is needed first."""
        return prepared_recipe(self.context, self.extraction, self.features.names())

    def num_inliers(self) -> dict[Pair, int]:
        """Return the inliers of each pair that is in the database, 0 where it is not verified."""
        ids = colmap_database.image_ids(self.path)
        verified = verified_pairs(self.path, self.verification.min_num_inliers)
        counts = {}
        for first, second in self.pairs:
            if first in ids and second in ids:
                low, high = sorted((ids[first], ids[second]))
                counts[first, second] = verified.get((low, high), 0)
        return counts

    def open_pairs(self) -> list[Pair]:
        """See :func:`open_pairs`; tracks count only where there are more than two images."""
        num_inliers = self.num_inliers()
        weakly_connected: set[str] = set()
        if len({name for pair in num_inliers for name in pair}) > 2:
            weakly_connected = weakly_connected_images(
                self.inlier_matches(), self.options.min_num_tracks
            )
        return open_pairs(num_inliers, self.options.strong_num_inliers, weakly_connected)

    def inlier_matches(self) -> dict[Pair, NDArray[np.int64]]:
        """Return the (M, 2) features of each verified pair that are inliers."""
        ids = colmap_database.image_ids(self.path)
        names = {image_id: name for name, image_id in ids.items()}
        verified = inlier_matches(self.path, self.verification.min_num_inliers)
        return {(names[one], names[two]): indices for (one, two), indices in verified.items()}

    def links(self, level: int) -> list[Pair]:
        """Return the verified pairs of images that gained matches at a level."""
        levels = self.matches.levels(self.pairs)
        gained = {name for pair in self.pairs if levels[pair] == level for name in pair}
        counts = self.num_inliers()
        return [pair for pair, count in counts.items() if count and gained.intersection(pair)]

    def untried(self, pairs: Sequence[Pair], level: int) -> list[Pair]:
        """Return those of the pairs that were not matched at a level yet."""
        tried = self.matches.tried_levels(pairs)
        return [pair for pair in pairs if tried[pair] < level]

    def num_steps(self, pairs: Sequence[Pair], level: int) -> int:
        """Return how often :meth:`climb` will call ``advance``."""
        return len(self._images_to_extend(pairs, level)) + len(pairs)

    def climb(self, pairs: Sequence[Pair], level: int, advance: Callable[[int], None]) -> None:
        """Match pairs with the features of a level and keep what has more inliers."""
        self._extend(self._images_to_extend(pairs, level), level, advance)
        if pairs:
            self._match_again(pairs, level, advance)
        write_images_and_keypoints(self.context)
        self._replace_matches()
        verify_new(self.context.workspace)

    def undo(self) -> None:
        """Bring all pairs back to level 0."""
        levels = self.matches.levels(self.pairs)
        higher = [pair for pair in self.pairs if levels[pair]]
        with self.context.progress.stage("match", len(higher), "pairs") as advance:
            match_pairs(self.context, higher, self.matching, advance)
        self.matches.mark_tried(self.pairs, 0)
        self._replace_matches()
        verify_new(self.context.workspace)

    def _images_to_extend(self, pairs: Sequence[Pair], level: int) -> list[str]:
        names = sorted({name for pair in pairs for name in pair})
        return [name for name in names if len(self.features.level_ends(name)) <= level]

    def _extend(self, names: Sequence[str], level: int, advance: Callable[[int], None]) -> None:
        """Add to images the features of all levels that they lack, up to this one."""
        if not names:
            return
        missing = [
            (name, lacking)
            for name in names
            for lacking in range(len(self.features.level_ends(name)), level + 1)
        ]
        inputs = Inputs.recorded(self.context.workspace)
        images = extract_images(self.context, inputs, self.extractor, missing)
        with closing(images) as found_images:
            for (name, reached), found in zip(missing, found_images, strict=True):
                if isinstance(found, ImageError):
                    raise found
                self.features.extend(name, found.features)
                if reached == level:
                    advance(1)

    def _match_again(
        self, pairs: Sequence[Pair], level: int, advance: Callable[[int], None]
    ) -> None:
        size_px = self.extraction.max_image_size_px
        verifier = PairVerifier(self.path, self.verification, size_px)
        num_inliers = self.num_inliers()
        tried: list[Pair] = []
        better: list[PairMatches] = []

        def record() -> None:
            self.matches.mark_tried(tried, level)
            self.matches.write(better)
            tried.clear()
            better.clear()

        matches = iterate_matches(
            pairs,
            self.features,
            self.matching,
            level,
            self.context.resources,
            self.context.executor,
            self.extraction.features.name,
        )
        try:
            with closing(matches) as found_pairs:
                for found in found_pairs:
                    names = found.names
                    first, second = (self.features.read_frames(name) for name in names)
                    count = verifier.num_inliers(names, (first, second), found.indices)
                    tried.append(names)
                    if count > num_inliers[names]:
                        better.append(found)
                    advance(1)
                    if len(tried) == PAIRS_PER_WRITE:
                        record()
        finally:
            if tried:
                record()

    def _replace_matches(self) -> None:
        """Put matches into the database where they differ from the ones there."""
        ids = colmap_database.image_ids(self.path)
        pairs = [pair for pair in self.pairs if pair[0] in ids and pair[1] in ids]
        if not pairs:
            return
        with colmap_database.open_database(self.path) as database:
            for (first, second), found in zip(pairs, self.matches.read(pairs), strict=True):
                colmap_database.replace_matches(database, ids[first], ids[second], found.indices)
