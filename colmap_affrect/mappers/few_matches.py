"""Pairs with few matches that are right all the same, as of coded targets.

The number of inliers is a limit where many raw matches are wrong. Where nearly all of a few agree
with one geometry, and third images confirm them one by one, chance does not explain that.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import cameras_of_images
from colmap_affrect.colmap.two_views import significance
from colmap_affrect.colmap.verification import (
    REJECTED,
    VerificationOptions,
    two_view_options,
)
from colmap_affrect.geometry.arrays import Floats, Indices, Singles
from colmap_affrect.geometry.significance import log10_choose

Ids = tuple[int, int]
Matched = Mapping[int, int]  # feature of another image by the feature of one

MIN_FEW = 7
"""Fewest matches of a pair: what determines a fundamental matrix (theory). Fewer say nothing of the
pair that any wrong matches would not say."""
MAX_RAW = 30
"""Raw matches of which fewer than 15 inliers can be significant (theory: of more they are not, with
the usual chance of 3 per cent)."""
MIN_INLIER_SHARE = 0.8  # of raw matches; below, a pair is not trusted (judged)
MAX_DISAGREEING = 0.1  # share of matches that a third image may contradict (judged)


@dataclass(frozen=True)
class FewMatches:
    """The matches of a pair that are sure although they are few."""

    ids: Ids
    matches: Indices  # (M, 2) features
    geometry: pycolmap.TwoViewGeometry


def sure_few_matches(
    database: pycolmap.Database, verified: Mapping[Ids, Indices]
) -> list[FewMatches]:
    """Return the pairs with few raw matches that are sure, beside those that are verified.

    Args:
        database: Has keypoints and raw matches.
        verified: (M, 2) inliers of the pairs that have enough of them.

    Returns:
        The pairs, sorted by ids.
    """
    raw = _few_raw_matches(database, verified)
    if not raw:
        return []
    cameras = cameras_of_images(database)
    options = VerificationOptions()
    third_images = _ThirdImages({**raw, **verified})
    found = list[FewMatches]()
    for ids, matches in sorted(raw.items()):
        first, second = ids
        both = cameras[first], cameras[second]
        points1 = _positions(database, first, matches[:, 0])
        points2 = _positions(database, second, matches[:, 1])
        points = points1, points2
        geometry = _geometry(both, points, options)
        if geometry is None:
            continue
        inliers = matches[np.asarray(geometry.inlier_matches, np.int64)[:, 0]]
        if len(inliers) < MIN_INLIER_SHARE * len(matches):
            continue
        of_chance = significance(
            geometry=geometry,
            cameras=both,
            keypoints=points,
            max_error_px=options.max_error_px,
        )
        evidence = max(of_chance, 0.0) + third_images.log10_evidence(ids, inliers)
        if evidence >= options.min_significance:
            found.append(FewMatches(ids, inliers, geometry))
    return found


def _few_raw_matches(
    database: pycolmap.Database, verified: Collection[Ids]
) -> dict[Ids, Indices]:
    """Return the raw matches, each once, of pairs that have few and are not verified."""
    found = {}
    frames = _Frames(database, verified)
    for pair_id, matches in zip(*database.read_all_matches(), strict=True):
        ids = pycolmap.pair_id_to_image_pair(pair_id)
        is_known = ids in verified or frames.are_tied(ids)
        if not is_known and MIN_FEW <= len(matches) <= MAX_RAW:
            each_once = np.unique(np.asarray(matches, np.int64), axis=0)
            if len(each_once) >= MIN_FEW:
                found[ids] = each_once
    return found


class _Frames:
    """What rigs of several sensors took at once: all images of a frame have one pose."""

    def __init__(self, database: pycolmap.Database, verified: Collection[Ids]) -> None:
        """Take the frames of a database, and the pairs of its images that tie them."""
        images = database.read_all_images()
        self._frame_of = {image.image_id: image.frame_id for image in images}
        self._num_images = Counter(self._frame_of.values())
        self._tied = {self._frames_of(ids) for ids in verified}

    def are_tied(self, ids: Ids) -> bool:
        """Tell whether other images tie the frames of two images, or both are of one frame."""
        frames = self._frames_of(ids)
        if min(self._num_images[frame] for frame in frames) < 2:
            return False
        return frames in self._tied or len(frames) == 1

    def _frames_of(self, ids: Ids) -> frozenset[int]:
        return frozenset(self._frame_of[image_id] for image_id in ids)


def _geometry(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    points: tuple[Floats, Floats],
    options: VerificationOptions,
) -> pycolmap.TwoViewGeometry | None:
    """Return the two-view geometry of points, those of a row match; its inliers are rows, twice.

    As many samples are drawn as find a geometry that is trusted: with fewer inliers none is.

    Args:
        cameras: Of both images.
        points: (M, 2) px in both images.
        options: Of verification.

    Returns:
        The geometry; None where fewer than ``MIN_FEW`` matches agree with one.
    """
    rows = np.arange(len(points[0]), dtype=np.uint32)
    trusted = options.changed(
        min_num_inliers=MIN_FEW, ransac_min_inlier_ratio=MIN_INLIER_SHARE
    )
    geometry = pycolmap.estimate_two_view_geometry(
        cameras[0],
        points[0].astype(np.float64),
        cameras[1],
        points[1].astype(np.float64),
        np.stack([rows, rows], axis=1),
        two_view_options(trusted),
    )
    is_rejected = geometry.config in REJECTED
    if is_rejected or len(geometry.inlier_matches) < MIN_FEW:
        return None
    return geometry


class _ThirdImages:
    """Tells whether third images confirm the matches of a pair."""

    def __init__(self, matches: Mapping[Ids, Indices]) -> None:
        """Take (M, 2) matches by pair."""
        self._matched: dict[Ids, Matched] = {}
        self._partners = defaultdict[int, set[int]](set)
        for (first, second), rows in matches.items():
            self._matched[first, second] = dict(rows.tolist())
            self._matched[second, first] = dict(rows[:, ::-1].tolist())
            self._partners[first].add(second)
            self._partners[second].add(first)

    def log10_evidence(self, ids: Ids, matches: Indices) -> float:
        """Return how much less probable by chance it is that a third image confirms matches.

        The best third image counts, as if chance had tried all of them.

        Args:
            ids: Of the pair.
            matches: (M, 2) features.

        Returns:
            Decimal logarithm; 0 where no third image confirms them.
        """
        thirds = self._partners[ids[0]] & self._partners[ids[1]]
        evidence = [self._log10_by(third, ids, matches) for third in thirds]
        best = max(evidence, default=0.0) - math.log10(max(len(thirds), 1))
        return max(best, 0.0)

    def _log10_by(self, third: int, ids: Ids, matches: Indices) -> float:
        first_to_third = self._matched[ids[0], third]
        third_to_second = self._matched[third, ids[1]]
        num_chained = 0
        num_agreeing = 0
        for first, second in matches.tolist():
            chained = third_to_second.get(first_to_third.get(first, -1))
            if chained is not None:
                num_chained += 1
                num_agreeing += chained == second
        if num_agreeing < (1.0 - MAX_DISAGREEING) * num_chained:
            return 0.0
        num_features = len(set(third_to_second.values()))
        by_chance = num_agreeing * math.log10(max(num_features, 1))
        return by_chance - log10_choose(num_chained, num_agreeing)


def _positions(
    database: pycolmap.Database, image_id: int, features: Indices
) -> Singles:
    """Return the (M, 2) positions of features of an image.

    Args:
        database: Has the keypoints.
        image_id: Of the image.
        features: (M,) numbers of keypoints.
    """
    keypoints = np.asarray(database.read_keypoints(image_id), np.float32)
    return keypoints[features, :2]
