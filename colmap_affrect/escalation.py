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

import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.verification import PairVerifier, inlier_matches, verified_pairs
from colmap_affrect.errors import ImageError
from colmap_affrect.executor import Executor
from colmap_affrect.extraction import ImageExtractor, Resources
from colmap_affrect.image_tasks import extract_images
from colmap_affrect.matching.pairs import Pair
from colmap_affrect.outcomes import StageReport
from colmap_affrect.pair_tasks import iterate_matches
from colmap_affrect.photographs import Photographs
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.stages import (
    PAIRS_PER_WRITE,
    feature_store,
    listed_pairs,
    make_extractor,
    match_pairs,
    match_store,
    read_indices,
    verify_new,
    write_images_and_keypoints,
)
from colmap_affrect.store import PairMatches
from colmap_affrect.workspace import Workspace

logger = logging.getLogger(__name__)


def escalate(
    workspace: Workspace,
    *,
    resources: Resources | None = None,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Climb the levels of the recipe; nothing happens when it has none.

    Args:
        workspace: verified.
        resources: weights and device of networks.
        executor: where images and pairs are worked on; by default in threads of this process.
        overwrite: bring all pairs back to level 0 first; features that are there are kept.
        progress: where to show progress.

    Returns:
        ``num_done`` counts the pairs that were matched again now.
    """
    start = time.perf_counter()
    levels = workspace.extraction_options().escalation
    workspace.claim("escalate", {"levels": len(levels)}, overwrite=overwrite)
    ladder = _Ladder(workspace, resources, executor)
    if overwrite:
        ladder.undo(progress)
    climbed: set[Pair] = set()
    for level, rectifier in enumerate(levels, 1):
        title = f"{rectifier.name} ({level} of {len(levels)})"
        for choose in (ladder.open_pairs, lambda level=level: ladder.links(level)):
            todo = ladder.untried(choose(), level)
            with progress.stage(title, ladder.num_steps(todo, level), "steps") as advance:
                ladder.climb(todo, level, advance)
            climbed |= set(todo)
    return StageReport("escalate", time.perf_counter() - start, len(climbed))


def pair_levels(workspace: Workspace) -> dict[str, int]:
    """Return how many pairs each level of a recipe with escalation decided, and how many none.

    Keys are the names of the rectifiers, in order, and ``none``; empty without escalation.
    """
    options = workspace.extraction_options()
    if not options.escalation:
        return {}
    names = [rectifier.name for rectifier in options.rectifiers]
    ladder = _Ladder(workspace)
    num_inliers, levels = ladder.num_inliers(), ladder.matches.levels(ladder.pairs)
    counts = dict.fromkeys([*names, "none"], 0)
    for pair in ladder.pairs:
        counts[names[levels[pair]] if num_inliers.get(pair) else "none"] += 1
    return counts


def open_pairs(
    num_inliers: Mapping[Pair, int], strong_num_inliers: int, loose: Collection[str] = ()
) -> list[Pair]:
    """Return the pairs that are not verified, and those of an image that mapping may well lose.

    Args:
        num_inliers: of each pair, 0 where it is not verified.
        strong_num_inliers: an image needs a pair with as many.
        loose: images that have little in common with two others; see :func:`loose_images`.
    """
    secure = {
        name for pair, count in num_inliers.items() if count >= strong_num_inliers for name in pair
    }.difference(loose)
    return [pair for pair, count in num_inliers.items() if not count or not secure.issuperset(pair)]


def loose_images(matches: Mapping[Pair, NDArray[np.int64]], min_num_features: int) -> set[str]:
    """Return the images with fewer features than that in tracks through three images or more.

    A mapper registers an image by features whose matches it has triangulated already. That takes
    two other images, so a strong pair alone ties an image to nothing.

    Args:
        matches: (M, 2) features of the first and the second image, of each verified pair.
        min_num_features: that an image needs.
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


class _Ladder:
    """The stores and options of a workspace, and one climb of some pairs to one level."""

    def __init__(
        self,
        workspace: Workspace,
        resources: Resources | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.workspace, self._executor = workspace, executor
        self._resources = resources or Resources()
        self._device = self._resources.device
        self.options = workspace.extraction_options()
        self.pairs = listed_pairs(workspace)
        self.features, self.matches = feature_store(workspace), match_store(workspace)
        self._extractor: ImageExtractor | None = None

    def num_inliers(self) -> dict[Pair, int]:
        """Return the inliers of each pair that is in the database, 0 where it is not verified."""
        options, _ = self.workspace.verification_options()
        ids = colmap_database.image_ids(self.workspace.database)
        verified = verified_pairs(self.workspace.database, options.min_num_inliers)
        counts = {}
        for first, second in self.pairs:
            if first in ids and second in ids:
                low, high = sorted((ids[first], ids[second]))
                counts[first, second] = verified.get((low, high), 0)
        return counts

    def open_pairs(self) -> list[Pair]:
        """See :func:`open_pairs`; of two images nothing more can be asked than a strong pair."""
        num_inliers = self.num_inliers()
        loose: set[str] = set()
        if len({name for pair in num_inliers for name in pair}) > 2:
            loose = loose_images(self._inlier_matches(), self.options.escalation_min_num_tracks)
        return open_pairs(num_inliers, self.options.escalation_strong_num_inliers, loose)

    def _inlier_matches(self) -> dict[Pair, NDArray[np.int64]]:
        options, _ = self.workspace.verification_options()
        ids = colmap_database.image_ids(self.workspace.database)
        names = {image_id: name for name, image_id in ids.items()}
        verified = inlier_matches(self.workspace.database, options.min_num_inliers)
        return {(names[one], names[two]): indices for (one, two), indices in verified.items()}

    def links(self, level: int) -> list[Pair]:
        """Return the verified pairs of the images that gained by a level."""
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
        write_images_and_keypoints(self.workspace, self.features)
        self._replace_matches()
        verify_new(self.workspace, *self.workspace.verification_options())

    def undo(self, progress: Progress) -> None:
        """Bring all pairs back to level 0."""
        levels = self.matches.levels(self.pairs)
        higher = [pair for pair in self.pairs if levels[pair]]
        with progress.stage("match", len(higher), "pairs") as advance:
            options = self.workspace.matching_options()
            match_pairs(
                higher,
                self.features,
                self.matches,
                options,
                0,
                advance,
                self._device,
                self._executor,
            )
        self.matches.mark_tried(self.pairs, 0)
        self._replace_matches()
        verify_new(self.workspace, *self.workspace.verification_options())

    def _images_to_extend(self, pairs: Sequence[Pair], level: int) -> list[str]:
        names = sorted({name for pair in pairs for name in pair})
        return [name for name in names if len(self.features.level_ends(name)) <= level]

    def _extend(self, names: Sequence[str], level: int, advance: Callable[[int], None]) -> None:
        """Add to images the features of all levels that they lack, up to this one."""
        if not names:
            return
        photographs = Photographs.recorded(self.workspace)
        if self._extractor is None:
            known = self.features.names()
            self._extractor = make_extractor(self.workspace, self.options, self._resources, known)
        missing = [
            (name, lacking)
            for name in names
            for lacking in range(len(self.features.level_ends(name)), level + 1)
        ]
        images = extract_images(photographs, self._extractor, missing, self._executor)
        with closing(images) as found_images:
            for (name, reached), found in zip(missing, found_images, strict=True):
                if isinstance(found, ImageError):
                    raise found
                if found.warning:
                    logger.warning("%s: %s", name, found.warning)
                self.features.extend(name, found.features)
                if reached == level:
                    advance(1)

    def _match_again(
        self, pairs: Sequence[Pair], level: int, advance: Callable[[int], None]
    ) -> None:
        options, seed = self.workspace.verification_options()
        verifier = PairVerifier(self.workspace.database, options, seed)
        num_inliers = self.num_inliers()
        matching = self.workspace.matching_options()
        tried: list[Pair] = []
        better: list[PairMatches] = []

        def record() -> None:
            self.matches.mark_tried(tried, level)
            self.matches.write(better)
            tried.clear()
            better.clear()

        matches = iterate_matches(
            pairs, self.features, matching, level, self._device, self._executor
        )
        try:
            with closing(matches) as found_pairs:
                for found in found_pairs:
                    names = found.names
                    first, second = (self.features.read_frames(name)[:, :, 2] for name in names)
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
        """Put those matches into the database that differ from the ones there."""
        ids = colmap_database.image_ids(self.workspace.database)
        pairs = [pair for pair in self.pairs if pair[0] in ids and pair[1] in ids]
        with colmap_database.open_database(self.workspace.database) as database:
            for (name1, name2), indices in zip(
                pairs, read_indices(self.matches, pairs), strict=True
            ):
                colmap_database.replace_matches(database, ids[name1], ids[name2], indices)
