"""Images whose keypoints are not those that their pairs were verified with.

A database keeps the geometry of each verified pair beside its inliers. Where a program
has mirrored, turned, scaled or sorted the keypoints of an image afterwards, the inliers
of its pairs do not fit their own geometries any more, and those of other pairs do.
"""

import sqlite3
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import camera_like
from colmap_affrect.colmap.tables import MAX_NUM_IMAGES, Tables, rows_of
from colmap_affrect.geometry.affine import homography_errors
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.epipolar import sampson_errors

MAX_ERROR_PX = 12.0
"""Of an inlier that fits, or ``MAX_ERROR`` of the longer side: three times what COLMAP verifies
with by default, so that refined keypoints and coarser limits pass."""
MAX_ERROR = 0.01  # Longer sides; COLMAP
# Share of the inliers that fit their own geometry: of a sound pair all, of a mirrored
# image at most 0.3 (measured)
MIN_FITTING = 0.5
MIN_INLIERS = 15  # of a pair that is looked at, as COLMAP verifies pairs by default
NUM_PAIRS = 12  # of an image that are looked at; resource
NUM_SAMPLED = 100  # inliers of a pair that are looked at; resource
# That do not fit: of one pair alone nobody knows which image it is; theory
MIN_PAIRS = 2
# Of the pairs of an image that do not fit; of its partners few are such; judged
MIN_SHARE = 0.8
COLUMNS = "pair_id rows cols data F E H"


@dataclass(frozen=True)
class _Image:
    """What of an image decides whether matches fit."""

    points: Floats  # (N, 2) px
    camera: pycolmap.Camera | None  # None where its parameters cannot be used
    longer_side: int  # px


def images_with_moved_keypoints(
    connection: sqlite3.Connection, tables: Tables
) -> list[str]:
    """Return the names of images whose pairs contradict their own two-view geometries.

    Pairs without a geometry say nothing. Mirroring along the epipolar lines of all pairs
    of an image stays unseen.

    Args:
        connection: To a database whose rows have been checked.
        tables: What it holds.
    """
    images = _Images(connection, tables)
    num_pairs = Counter[int]()
    num_contradicting = Counter[int]()
    for pair_id, rows, columns, blob, *matrices in rows_of(
        connection, COLUMNS, "two_view_geometries"
    ):
        ids = divmod(pair_id, MAX_NUM_IMAGES)
        is_known = min(num_pairs[image_id] for image_id in ids) >= NUM_PAIRS
        if rows < MIN_INLIERS or columns != 2 or is_known:
            continue
        matches = np.frombuffer(blob, "<u4").reshape(rows, columns)
        step = max(1, rows // NUM_SAMPLED)
        share = _fitting_share(
            images=images,
            ids=ids,
            matches=matches[::step],
            blobs=matrices,
        )
        if share is not None:
            num_pairs.update(ids)
            if share < MIN_FITTING:
                num_contradicting.update(ids)
    found = list[str]()
    for image_id, num in num_contradicting.items():
        if num >= max(MIN_PAIRS, MIN_SHARE * num_pairs[image_id]):
            found.append(tables.names[image_id])
    return sorted(found)


class _Images:
    """The images of a database; each is read once."""

    def __init__(self, connection: sqlite3.Connection, tables: Tables) -> None:
        self.connection = connection
        self.tables = tables
        self._known = dict[int, _Image]()

    def of(self, image_id: int) -> _Image:
        """Return an image by its id."""
        if image_id not in self._known:
            self._known[image_id] = self._read(image_id)
        return self._known[image_id]

    def _read(self, image_id: int) -> _Image:
        query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
        row = self.connection.execute(query, (image_id,)).fetchone()
        count, width, blob = row
        keypoints = np.frombuffer(blob, "<f4").reshape(count, width)
        points = keypoints[:, :2].astype(np.float64)
        camera = self.tables.cameras[self.tables.camera_ids[image_id]]
        longer_side = max(camera.width, camera.height)
        native = camera_like(camera.model)
        params = np.frombuffer(camera.params or b"", "<f8")
        if native is None or len(params) != len(native.params):
            return _Image(points, None, longer_side)
        native.params = params.tolist()
        return _Image(points, native, longer_side)


def _fitting_share(
    images: _Images,
    ids: tuple[int, int],
    matches: Any,
    blobs: Sequence[bytes | None],
) -> float | None:
    """Return the share of matches that fit one of the geometries of their pair, the largest one.

    Once most fit the first one, the others are not looked at.

    Args:
        images: Of the database.
        ids: Of both images.
        matches: (M, 2) keypoints of both.
        blobs: Fundamental and essential matrix and homography, as they are stored.

    Returns:
        The share; None where the pair has no geometry.
    """
    both = [images.of(image_id) for image_id in ids]
    points1 = both[0].points[matches[:, 0]]
    points2 = both[1].points[matches[:, 1]]
    longer_side = max(image.longer_side for image in both)
    limit_px = max(MAX_ERROR_PX, MAX_ERROR * longer_side)
    fundamental, essential, homography = map(_matrix, blobs)
    share: float | None = None
    with np.errstate(all="ignore"):  # errors that are not numbers fit nothing
        if fundamental is not None:
            share = _share_within(
                limit_px, sampson_errors(fundamental, points1, points2)
            )
            if share >= MIN_FITTING:
                return share
        if essential is not None:
            for errors in _errors_of_rays(essential, both, (points1, points2)):
                share = max(share or 0.0, _share_within(limit_px, errors))
        if homography is not None:
            errors = homography_errors(homography, points1, points2)
            share = max(share or 0.0, _share_within(limit_px, errors))
    return share


def _share_within(limit_px: float, errors: Array) -> float:
    return float(np.count_nonzero(errors <= limit_px) / len(errors))


def _errors_of_rays(
    essential: Array, images: Sequence[_Image], points: tuple[Array, Array]
) -> list[Array]:
    """Return the (M,) errors in px of matches by an essential matrix; none of odd cameras."""
    scales = list[Array]()
    scaled = list[Array]()
    for image, of_image in zip(images, points, strict=True):
        if image.camera is None:
            return []
        focal_px = float(image.camera.mean_focal_length())
        rays = np.asarray(image.camera.cam_from_img(of_image), np.float64)
        scaled.append(focal_px * rays)
        scales.append(np.diag([1.0 / focal_px, 1.0 / focal_px, 1.0]))
    return [sampson_errors(scales[1] @ essential @ scales[0], *scaled)]


def _matrix(blob: bytes | None) -> Array | None:
    """Return a stored (3, 3) matrix, None where there is none, or one of zeros."""
    if not blob:
        return None
    matrix = np.frombuffer(blob, "<f8").reshape(3, 3)
    is_usable = np.isfinite(matrix).all() and matrix.any()
    return matrix if is_usable else None
