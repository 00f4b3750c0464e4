"""Matches under masks that are painted after matching, left out of a database that is mapped."""

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.data import Mask, in_mask
from colmap_affrect.geometry.arrays import Bools, Indices
from colmap_affrect.geometry.conventions import pixel_from_colmap
from colmap_affrect.images.masks import read_mask
from colmap_affrect.images.photographs import MaskOptions, Photographs


def read_painted_masks(folder: Path, names: Mapping[str, int]) -> dict[int, Mask]:
    """Read the masks of a folder that ``--mask-path`` could take.

    Args:
        folder: of the masks; a/b.jpg has a/b.jpg.png.
        names: of images, with their ids.

    Returns:
        (H, W) masks by image id, False where nothing counts, of images that have one.

    Raises:
        ImageError: a mask cannot be read.
    """
    photographs = Photographs(Path(), MaskOptions(path=str(folder)))
    found = {}
    for name, image_id in names.items():
        path = photographs.own_mask(name)
        if path:
            found[image_id] = read_mask(path)
    return found


def leave_out_masked(
    database: pycolmap.Database, masks: Mapping[int, Mask]
) -> list[tuple[int, int]]:
    """Take matches of masked keypoints out of a database.

    Pairs that lose some have no two-view geometry afterwards: it has to be estimated from the
    matches that are left, which are the raw ones and those of the geometry before.

    Args:
        database: which is changed.
        masks: (H, W) by image id, False where nothing counts.

    Returns:
        The ids of the pairs that have lost matches, the lower one first.
    """
    image_ids = sorted(image.image_id for image in database.read_all_images())
    is_free = {}
    for image_id, mask in masks.items():
        if database.exists_keypoints(image_id):
            positions = np.asarray(database.read_keypoints(image_id), float)[:, :2]
            is_free[image_id] = in_mask(mask, pixel_from_colmap(positions))
    changed = []
    for pair in combinations(image_ids, 2):
        if is_free.keys() & set(pair):
            known = _known_matches(database, pair)
            kept = _free_matches(known, pair, is_free)
            if len(kept) < len(known):
                _replace_matches(database, pair, kept)
                changed.append(pair)
    return changed


def _known_matches(database: pycolmap.Database, pair: tuple[int, int]) -> Indices:
    """Return the (M, 2) raw matches of a pair and the inliers of its geometry, each once."""
    found = [np.zeros((0, 2), np.uint32)]
    if database.exists_matches(*pair):
        found.append(np.asarray(database.read_matches(*pair), np.uint32))
    if database.exists_two_view_geometry(*pair):
        geometry = database.read_two_view_geometry(*pair)
        found.append(np.asarray(geometry.inlier_matches, np.uint32).reshape(-1, 2))
    return np.unique(np.concatenate(found), axis=0)


def _free_matches(
    matches: Indices, pair: tuple[int, int], is_free: Mapping[int, Bools]
) -> Indices:
    """Return the matches of which no keypoint is masked."""
    is_kept = np.ones(len(matches), bool)
    for side, image_id in enumerate(pair):
        if image_id in is_free:
            is_kept &= is_free[image_id][matches[:, side]]
    return matches[is_kept]


def _replace_matches(
    database: pycolmap.Database, pair: tuple[int, int], matches: Indices
) -> None:
    """Write other matches of a pair, which is not verified any more."""
    if database.exists_two_view_geometry(*pair):
        database.delete_two_view_geometry(*pair)
    if database.exists_matches(*pair):
        database.delete_matches(*pair)
    if len(matches):
        database.write_matches(*pair, matches)
