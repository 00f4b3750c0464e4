"""Verification of the pairs of a database, in threads or on the workers of a cluster."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.verification import (
    Matches,
    Side,
    VerificationOptions,
    estimate_geometry,
)
from colmap_affrect.geometry.arrays import Floats, Indices
from colmap_affrect.parallel.executor import Executor, Threads, available_cores

Names = tuple[str, str]
# (N, 2, 3) LAFs of each image of a pair, in pixel-centre px
Frames = tuple[Floats, Floats]

PAIRS_PER_WRITE = 100  # a run that is ended loses at most as many; resource
NUM_CACHED_IMAGES = 256  # as COLMAP keeps: 80 MB of 13,000 keypoints each

# Pairs that are verified meanwhile where one takes far longer than others; resource
PAIRS_AHEAD = 16

ExtractedPx = int | Mapping[tuple[int, int], int] | None
"""Longest side that photographs were shrunk to, if any; or by pair of image ids, lower first."""


def of_pair(extracted_px: ExtractedPx, ids: tuple[int, int]) -> int | None:
    """Return what was true of a pair of image ids."""
    return extracted_px.get(ids) if isinstance(extracted_px, Mapping) else extracted_px


@dataclass(frozen=True)
class _Task:
    """A pair to verify, with the keypoints of its matches alone: it may go to another machine."""

    image_ids: tuple[int, int]
    sides: tuple[Side, Side]  # keypoints of a row match
    matches: Matches  # raw, numbers of the keypoints in the database
    extracted_px: int | None

    @classmethod
    def of(
        cls,
        image_ids: tuple[int, int],
        sides: tuple[Side, Side],
        matches: Matches,
        extracted_px: int | None,
    ) -> Self:
        """Keep of two images the keypoints that are matched.

        Args:
            image_ids: of the two images.
            sides: with all of their keypoints.
            matches: (M, 2) numbers of keypoints.
            extracted_px: longest side that photographs were shrunk to before extraction, if any.
        """
        matched1 = Side(sides[0].camera, sides[0].keypoints[matches[:, 0]])
        matched2 = Side(sides[1].camera, sides[1].keypoints[matches[:, 1]])
        return cls(image_ids, (matched1, matched2), matches, extracted_px)


@dataclass(frozen=True)
class _Done:
    """A pair that is verified, or rejected."""

    image_ids: tuple[int, int]
    geometry: pycolmap.TwoViewGeometry


@dataclass(frozen=True)
class _Estimator:
    """Estimates the geometries of pairs, in a thread of this process or on a worker."""

    options: VerificationOptions

    def __call__(self, task: _Task) -> _Done:
        """Return the geometry of a pair; its inliers are raw matches."""
        numbers = np.arange(len(task.matches), dtype=np.uint32)
        rows = np.stack([numbers, numbers], axis=1)
        geometry = estimate_geometry(task.sides, rows, self.options, task.extracted_px)
        inliers = np.asarray(geometry.inlier_matches)[:, 0]
        geometry.inlier_matches = task.matches.astype(np.uint32)[inliers]
        return _Done(task.image_ids, geometry)


def verify(
    path: Path,
    options: VerificationOptions,
    extracted_px: ExtractedPx = None,
    advance: Callable[[int], None] | None = None,
    pairs: Collection[tuple[int, int]] | None = None,
) -> None:
    """Estimate the two-view geometry of every matched pair of a database that has none yet.

    Args:
        path: the database.
        options: of verification.
        extracted_px: longest side that photographs were shrunk to before extraction.
        advance: is called with the number of pairs that are done.
        pairs: of image ids, the lower one first, that may be verified; None: all.
    """
    with colmap_database.open_database(path) as database:
        todo = colmap_database.pairs_to_verify(database)
        if pairs is not None:
            may_be_verified = [tuple(pair) in pairs for pair in todo.tolist()]
            todo = todo[may_be_verified]
        if len(todo):
            colmap_database.require_database_space(path, len(todo))
            verify_pairs(
                database=database,
                pairs=todo,
                options=options,
                extracted_px=extracted_px,
                advance=advance,
            )


def verify_pairs(
    database: pycolmap.Database,
    pairs: Indices,
    options: VerificationOptions,
    extracted_px: ExtractedPx = None,
    advance: Callable[[int], None] | None = None,
    executor: Executor | None = None,
) -> None:
    """Estimate the two-view geometries of matched pairs.

    A geometry is written when it has been judged: whatever ends this, no pair counts as verified
    that was not.

    Args:
        database: has the keypoints and raw matches, and gets the geometries.
        pairs: (N, 2) image ids.
        options: of verification.
        extracted_px: longest side that photographs were shrunk to before extraction.
        advance: is called with the number of pairs that are done.
        executor: where pairs are verified, e.g. a cluster; None: threads here.
    """
    executor = executor or Threads(available_cores(), PAIRS_AHEAD)
    cameras = colmap_database.cameras_of_images(database)

    @lru_cache(NUM_CACHED_IMAGES)
    def side(image_id: int) -> Side:
        keypoints = np.asarray(database.read_keypoints(image_id), np.float32)
        return Side(cameras[image_id], keypoints)

    def tasks() -> Iterator[_Task]:
        for image_id1, image_id2 in pairs:
            sides = (side(image_id1), side(image_id2))
            matches = _each_once(database.read_matches(image_id1, image_id2))
            image_ids = (int(image_id1), int(image_id2))
            size_px = of_pair(extracted_px, image_ids)
            yield _Task.of(image_ids, sides, matches, size_px)

    verified = executor.map(_Estimator(options), tasks())
    batch = list(islice(verified, PAIRS_PER_WRITE))
    while batch:
        with pycolmap.DatabaseTransaction(database):
            for done in batch:
                database.write_two_view_geometry(*done.image_ids, done.geometry)
        if advance:
            advance(len(batch))
        batch = list(islice(verified, PAIRS_PER_WRITE))


def _each_once(matches: Matches) -> Matches:
    """Leave out repetitions: each match is evidence once, and would agree with its own copies."""
    _, first = np.unique(matches, axis=0, return_index=True)
    return matches if len(first) == len(matches) else matches[np.sort(first)]


class PairVerifier:
    """Tries matches of single pairs, with the result of :func:`verify` and the same seed."""

    def __init__(
        self,
        ids: Mapping[str, int],
        cameras: Mapping[str, pycolmap.Camera],
        options: VerificationOptions,
        extracted_px: ExtractedPx = None,
    ) -> None:
        """Take what is known of the images.

        Args:
            ids: in the database, by image name.
            cameras: by image name.
            options: of verification.
            extracted_px: longest side that photographs were shrunk to before extraction.
        """
        self._ids = ids
        self._cameras = cameras
        self._options = options
        self._extracted_px = extracted_px

    def inliers(self, names: Names, frames: Frames, indices: Matches) -> Indices:
        """Return the matches that the two-view geometry of a pair explains.

        Args:
            names: of the two images, in any order.
            frames: (N, 2, 3) local affine frames of each, in pixel-centre px.
            indices: (M, 2) raw matches, in the order of ``names``.

        Returns:
            (K, 2) of these matches; none if the geometry is rejected.
        """
        geometry = self.geometry(names, frames, indices)
        found = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
        is_in_order = self._ids[names[0]] < self._ids[names[1]]
        return found if is_in_order else found[:, ::-1]

    def geometry(
        self, names: Names, frames: Frames, indices: Matches
    ) -> pycolmap.TwoViewGeometry:
        """Return the two-view geometry of a pair, from the image with the lower id.

        Args:
            names: of the two images, in any order.
            frames: (N, 2, 3) local affine frames of each, in pixel-centre px.
            indices: (M, 2) raw matches, in the order of ``names``.

        Returns:
            The geometry; an empty one if it is rejected.
        """
        ids = (self._ids[names[0]], self._ids[names[1]])
        sides = (self._side(names[0], frames[0]), self._side(names[1], frames[1]))
        if ids[0] > ids[1]:
            ids = (ids[1], ids[0])
            sides = (sides[1], sides[0])
            indices = indices[:, ::-1]
        size_px = of_pair(self._extracted_px, ids)
        return estimate_geometry(
            sides=sides,
            matches=indices,
            options=self._options,
            extracted_px=size_px,
        )

    def _side(self, name: str, lafs: Floats) -> Side:
        return Side(self._cameras[name], colmap_database.colmap_keypoints(lafs))


def verified_pairs(path: Path, min_num_inliers: int) -> dict[tuple[int, int], int]:
    """Return the number of inliers of each verified pair of image ids."""
    with colmap_database.open_database(path) as database:
        return colmap_database.num_inliers_of_pairs(database, min_num_inliers)
