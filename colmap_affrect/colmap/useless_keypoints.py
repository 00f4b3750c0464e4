"""Keypoints that no model can use, left out of copies of other programs' databases.

COLMAP fails at those that are not finite, and may never end where those of an image are all at one
place. They keep their indices, which models refer to; matches of them are taken away.
"""

import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np

from colmap_affrect.colmap.tables import pair_images, rows_of
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


def with_places(keypoints: Singles) -> Singles:
    """Return (N, columns) keypoints with a place in the image for those that are nowhere."""
    finite = _are_finite(keypoints)[:, None]
    return np.where(finite, keypoints, PLACEHOLDER[: keypoints.shape[1]]).astype(np.float32)


def leave_out_useless(path: Path) -> str:
    """Leave useless keypoints out of an intact database that COLMAP has not open.

    Returns what is left out, empty if nothing is.
    """
    with closing(sqlite3.connect(path)) as connection, connection:
        masks = _masks(connection)
        if not masks:
            return ""
        _give_places(connection, masks)
        num_matches = _leave_out_matches(connection, "matches", masks, 0)
        _leave_out_matches(connection, "two_view_geometries", masks, MIN_NUM_INLIERS)
        images = connection.execute("SELECT image_id, name FROM images ORDER BY name").fetchall()
    return left_out({name: masks[key] for key, name in images if key in masks}, num_matches)


def left_out(masks: Mapping[str, Bools], num_matches: int) -> str:
    """Say which keypoints are left out, by image name, empty if there are none."""
    count = sum(int(mask.sum()) for mask in masks.values())
    if not count:
        return ""
    return (
        f"{count} keypoints of {such_as(masks)} are left out, with {num_matches} matches: they are "
        "not finite, outside of the image, or most of it at one place"
    )


def _masks(connection: sqlite3.Connection) -> dict[int, Bools]:
    """Return for each image that has useless keypoints which ones they are."""
    masks = {}
    rows = connection.execute(
        "SELECT image_id, rows, cols, data, width, height FROM keypoints "
        "NATURAL JOIN (SELECT image_id, camera_id FROM images) "
        "NATURAL JOIN (SELECT camera_id, width, height FROM cameras) WHERE rows > 0"
    )
    for image_id, count, columns, data, *size in rows:
        keypoints = np.frombuffer(data, "<f4").reshape(count, columns)
        if found := useless(keypoints, (size[0], size[1])):
            masks[int(image_id)] = np.asarray(np.logical_or.reduce(list(found.values())))
    return masks


def _give_places(connection: sqlite3.Connection, images: Iterable[int]) -> None:
    for image_id in images:
        row = connection.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?",
                                 [image_id])  # fmt: skip
        count, columns, data = row.fetchone()
        placed = with_places(np.frombuffer(data, "<f4").reshape(count, columns))
        connection.execute("UPDATE keypoints SET data = ? WHERE image_id = ?",
                           [placed.tobytes(), image_id])  # fmt: skip


def _leave_out_matches(
    connection: sqlite3.Connection, table: str, masks: Mapping[int, Bools], least: int
) -> int:
    """Leave out matches of useless keypoints, and rows that keep fewer than ``least``.

    Returns how many were left out.
    """
    num_lost = 0
    pairs = [row[0] for row in rows_of(connection, "pair_id", table)]
    for pair_id in [pair for pair in pairs if not masks.keys().isdisjoint(pair_images(pair))]:
        # Names of tables are those of COLMAP, written down in this module.
        row = connection.execute(f"SELECT data FROM {table} WHERE pair_id = ?", [pair_id])  # noqa: S608
        indices = np.frombuffer(row.fetchone()[0] or b"", "<u4").reshape(-1, 2)
        lost = np.zeros(len(indices), np.bool_)
        for side, image_id in enumerate(pair_images(pair_id)):
            if image_id in masks:
                lost |= masks[image_id][indices[:, side]]
        kept = indices[~lost]
        if lost.any() and len(kept) < least:
            connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", [pair_id])  # noqa: S608
        elif lost.any():
            connection.execute(
                f"UPDATE {table} SET rows = ?, data = ? WHERE pair_id = ?",  # noqa: S608
                [len(kept), kept.tobytes(), pair_id],
            )
        num_lost += int(lost.sum())
    return num_lost
