"""Keypoints that no model can use, left out of copies of other programs' databases.

COLMAP fails at those that are not finite, and may never end where those of an image are all at one
place. They keep their indices, which models refer to; matches of them are taken away.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import cameras_of_images
from colmap_affrect.errors import such_as
from colmap_affrect.geometry.arrays import Bools, Singles

KINDS = {"keypoints-not-finite", "keypoints-outside", "keypoints-at-one-place"}  # of checks.CHECKS
MAX_SIDE_PX = 1 << 24  # of a photograph; the largest panoramas have a tenth of it
OUTSIDE_TOLERANCE_PX = 1.0  # keypoints of images shrunk for detection may lie outside
MIN_AT_ONE_PLACE = 10  # one place has a few keypoints, of several orientations or shapes
MIN_NUM_INLIERS = 15  # of a pair that lost some: fewer are no geometry, by COLMAP's default
PLACEHOLDER = np.array([0, 0, 1, 0, 0, 1], "<f4")  # x, y, scale or the shape of a circle


def useless(keypoints: Singles, size: tuple[int, int] | None) -> dict[str, Bools]:
    """Tell for each kind of problem which of (N, 2 or more) keypoints have it, if any.

    ``size`` is the (width, height) of the image, None if not known; its corner is the origin.
    """
    finite = _are_finite(keypoints)
    points = keypoints[:, :2]
    found: dict[str, Bools] = {"keypoints-not-finite": ~finite}
    if size is not None:
        beyond = np.maximum(-points, points - np.asarray(size, np.float32))
        is_outside = np.asarray((beyond > OUTSIDE_TOLERANCE_PX).any(axis=1))
        found["keypoints-outside"] = finite & is_outside
    if finite.sum() >= MIN_AT_ONE_PLACE:  # what more than half have is the median
        half = len(points[finite]) // 2
        there = np.asarray((points == np.partition(points[finite], half, axis=0)[half]).all(axis=1))
        if there.sum() >= max(MIN_AT_ONE_PLACE, len(points) // 2 + 1):
            found["keypoints-at-one-place"] = there
    return {kind: mask for kind, mask in found.items() if mask.any()}


def _are_finite(keypoints: Singles) -> Bools:
    return np.asarray((np.abs(keypoints) <= MAX_SIDE_PX).all(axis=1))


def _with_places(keypoints: Singles) -> Singles:
    """Return (N, columns) keypoints with a place in the image for those that are nowhere."""
    finite = _are_finite(keypoints)[:, None]
    return np.where(finite, keypoints, PLACEHOLDER[: keypoints.shape[1]]).astype(np.float32)


def leave_out_useless(database: pycolmap.Database) -> str:
    """Leave useless keypoints out of an intact database, and geometries that keep few inliers.

    Returns what is left out, empty if nothing is.
    """
    cameras, masks, names = cameras_of_images(database), dict[int, Bools](), list[str]()
    with pycolmap.DatabaseTransaction(database):
        for image in sorted(database.read_all_images(), key=lambda image: str(image.name)):
            key, camera = image.image_id, cameras[image.image_id]
            if not database.num_keypoints_for_image(key):
                continue
            keypoints = np.asarray(database.read_keypoints(key), np.float32)
            if found := useless(keypoints, (camera.width, camera.height)):
                masks[key] = np.asarray(np.logical_or.reduce(list(found.values())))
                names.append(image.name)
                database.update_keypoints(key, _with_places(keypoints))
        num_matches = _leave_out_matches(database, masks)
    count = sum(int(mask.sum()) for mask in masks.values())
    if not count:
        return ""
    return (
        f"{count} keypoints of {such_as(names)} are left out, with {num_matches} matches: "
        "they are not finite, outside of the image, or most of it at one place"
    )


def _leave_out_matches(database: pycolmap.Database, masks: Mapping[int, Bools]) -> int:
    """Leave out matches and inliers of useless keypoints; return how many matches."""
    num_matches = 0
    for pair in map(pycolmap.pair_id_to_image_pair, database.read_num_matches()[0]):
        indices = np.asarray(database.read_matches(*pair), np.uint32)
        if (lost := _lost(indices, pair, masks)).any():
            database.delete_matches(*pair)
            database.write_matches(*pair, indices[~lost])
            num_matches += int(lost.sum())
    for pair_id in database.read_two_view_geometry_num_inliers()[0]:
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        geometry = database.read_two_view_geometry(*pair)
        indices = np.asarray(geometry.inlier_matches, np.uint32).reshape(-1, 2)
        if (lost := _lost(indices, pair, masks)).any():
            database.delete_two_view_geometry(*pair)
            geometry.inlier_matches = indices[~lost]
            if len(geometry.inlier_matches) >= MIN_NUM_INLIERS:
                database.write_two_view_geometry(*pair, geometry)
    return num_matches


def _lost(indices: NDArray[np.uint32], pair: tuple[int, int], masks: Mapping[int, Bools]) -> Bools:
    """Tell which of (M, 2) matches are of a useless keypoint."""
    lost = np.zeros(len(indices), np.bool_)
    for column, image_id in zip(indices.T, pair, strict=True):
        if image_id in masks:
            lost |= masks[image_id][column]
    return lost
