"""What can be wrong in a COLMAP database of any version, and what to do about it.

Rows that COLMAP does not expect end the process inside COLMAP, so SQLite reads the tables.
"""

import logging
import sqlite3
import struct
import tomllib
from collections import Counter, defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap.links import check_links
from colmap_affrect.colmap.model_files import MAX_SIDE_PX, camera_like
from colmap_affrect.colmap.moved_keypoints import images_with_moved_keypoints
from colmap_affrect.colmap.tables import (
    DAMAGED,
    MAX_NUM_IMAGES,
    Tables,
    columns_of,
    open_read_only,
    read_tables,
    require_intact_pages,
    rows_of,
)
from colmap_affrect.errors import DatabaseError, such_as
from colmap_affrect.geometry.arrays import Floats, Singles

logger = logging.getLogger(__name__)

# by kind what the problems are, and what to do about them
CHECKS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("checks.toml").read_text(encoding="utf-8")
)

FATAL_FOR_MAPPING = frozenset({"camera-panorama", "rig-without-pose"})
"""Problems of databases that are of use to COLMAP, but cannot be mapped."""
FATAL_FOR_IMAGES = FATAL_FOR_MAPPING | {
    "bad-id", "bad-name", "no-parent", "bad-camera", "bad-rig", "bad-frame",
}  # fmt: skip
"""Problems of names, cameras, rigs and frames at which COLMAP, or what reads it, fails or ends."""
USELESS_KEYPOINTS = frozenset({
    "keypoints-not-finite", "keypoints-outside", "keypoints-normalised", "keypoints-at-one-place",
})  # fmt: skip
FATAL = FATAL_FOR_IMAGES | USELESS_KEYPOINTS | {
    "keypoint-data", "descriptor-data", "match-data", "matrix-data",
}  # fmt: skip
"""The same of keypoints and matches."""
WARNED = frozenset({"keypoints-in-a-corner", "keypoints-moved"})
"""Problems that results may be right in spite of."""
FATAL_AS_IT_IS = FATAL | {"no-frame"}
"""The same for a database that is mapped without a copy, which would get frames."""
FATAL_BEFORE_MAPPING = FATAL - {"rig-without-pose"}
"""The same where nothing is mapped yet."""
# By kind the images, pairs or cameras concerned, if any
Problems = dict[str, list[str]]

# Columns that hold so many float64 or nothing, by table; format
MATRICES = {
    "two_view_geometries": {"F": 9, "E": 9, "H": 9, "qvec": 4, "tvec": 3},
    "pose_priors": {"position": 3, "position_covariance": 9, "gravity": 3},
    "rig_sensors": {"sensor_from_rig": 7},
}

# Id, model, size, prior, and how many parameters follow
PACKED_CAMERA = struct.Struct("<IiQQBQ")
# Numbers of COLMAP's keypoints: x, y; with scale and orientation; with an affine shape
KEYPOINT_COLUMNS = (2, 4, 6)
# Longer sides that keypoints may be outside: some programs find, or move, what is at the border;
# judged
MAX_OUTSIDE = 0.01
MAX_OUTSIDE_PX = 2.0  # beside that, in px; judged
# Fewest keypoints that tell their unit; theory: one or two may be near the corner by chance
MIN_NORMALISED = 3
# Largest coordinate of keypoints whose unit is a side of the image, or half of one; theory
MAX_NORMALISED = 2.0
# Fewest keypoints that should fill an image; theory: so many are in no corner by chance
MIN_IN_A_CORNER = 100
# Fewest images whose keypoints tell that they were found in smaller ones; theory
MIN_IMAGES_IN_A_CORNER = 3
# How far these reach at most, in sides; theory: those of images at half their size reach one half
IN_A_CORNER = 0.6
# One place has a few keypoints, of several orientations or shapes; judged
MIN_AT_ONE_PLACE = 10


def refuse_unusable(
    path: Path, kinds: Collection[str] = FATAL, *, warns: bool = False
) -> None:
    """Refuse a damaged database, or one with some kinds of problems.

    Args:
        path: the database, which is only read.
        kinds: of problems that are refused, as ``checks.toml`` names them.
        warns: whether other problems that make results wrong are said in a warning.

    Raises:
        DatabaseError: names the first of these problems, and what to do about it.
    """
    looks_for_moved = warns or "keypoints-moved" in kinds
    _, problems = check_database(path, looks_for_moved=looks_for_moved)
    for kind in sorted(kinds & problems.keys(), key=list(CHECKS).index):
        what = CHECKS[kind]["what"]
        advice = CHECKS[kind]["advice"].format(path=path)
        raise DatabaseError(
            f"{what} ({such_as(problems[kind])})", where=path, advice=advice
        )
    if not warns:
        return
    for kind in sorted(WARNED & problems.keys()):
        check = CHECKS[kind]
        items = such_as(problems[kind])
        logger.warning("%s: %s (%s); %s", path, check["what"], items, check["advice"])


def check_database(
    path: Path, *, looks_for_moved: bool = True
) -> tuple[Tables, Problems]:
    """Check a database, which is only read; DatabaseError if damaged.

    Whether keypoints have moved after verification, which takes longest, is left out on request.
    """
    found: Problems = defaultdict(list)
    with open_read_only(path) as connection:
        try:
            connection.text_factory = lambda data: data.decode("utf-8", "replace")
            require_intact_pages(connection, path)
            tables = read_tables(connection)
            _check_cameras(tables, found)
            _check_images(connection, tables, found)
            check_links(connection, tables, found)
            _check_matrices(connection, found)
            _check_keypoints(connection, tables, found)
            _check_descriptors(connection, tables, found)
            _check_pairs(connection, tables, found)
            has_all_rows = FATAL.isdisjoint(found)
            if looks_for_moved and has_all_rows:
                moved = images_with_moved_keypoints(connection, tables)
                if moved:
                    found["keypoints-moved"] = moved
        except (*DAMAGED, TypeError, ValueError, OverflowError) as error:
            raise DatabaseError(f"damaged ({error})", where=path) from error
    return tables, dict(found)


def _check_cameras(tables: Tables, found: Problems) -> None:
    for camera_id, camera in tables.cameras.items():
        label = f"camera {camera_id}"
        like = camera_like(camera.model)
        if not like:
            found["bad-camera"].append(f"{label}: model {camera.model}")
            continue
        focals = like.focal_length_idxs()
        if not len(focals):
            found["camera-panorama"].append(f"{label}: {like.model.name}")
        params = _array(
            blob=camera.params,
            rows=1,
            columns=len(like.params),
            dtype=np.dtype("<f8"),
        )
        is_finite = params is not None and np.isfinite(params).all()
        if params is None or not is_finite or (params[0, focals] <= 0.0).any():
            found["bad-camera"].append(label)
        shorter = min(camera.width, camera.height)
        longer = max(camera.width, camera.height)
        if shorter <= 0 or longer > MAX_SIDE_PX:
            found["bad-camera"].append(f"{label}: {camera.width} x {camera.height} px")


def _check_images(
    connection: sqlite3.Connection, tables: Tables, found: Problems
) -> None:
    _check_image_names(connection, tables, found)
    for image_id, name in tables.names.items():
        if tables.camera_ids[image_id] not in tables.cameras:
            found["no-parent"].append(name)
        if tables.num_frames and image_id not in tables.frame_images:
            found["no-frame"].append(name)


def _check_image_names(
    connection: sqlite3.Connection, tables: Tables, found: Problems
) -> None:
    (encoding,) = connection.execute("PRAGMA encoding").fetchone()  # of all its texts
    rows = connection.execute(
        "SELECT image_id, CAST(name AS BLOB), typeof(name) FROM images"
    )
    for image_id, raw, kind in rows:
        codec = encoding if kind == "text" else "utf-8"
        name = (raw or b"").decode(codec, "replace")
        if not name or "\0" in name or name.encode(codec) != raw:
            found["bad-name"].append(f"image {image_id}: {name!r}")
    for name, count in Counter(tables.names.values()).items():
        if count > 1:
            found["bad-name"].append(f"{name}, {count} times")


def _check_matrices(connection: sqlite3.Connection, found: Problems) -> None:
    for table in MATRICES:
        _check_sizes(connection, table, found)
    rows = rows_of(connection, "pair_id camera1 camera2", "two_view_geometries")
    for pair_id, camera1, camera2 in rows:
        if not (_is_camera_or_none(camera1) and _is_camera_or_none(camera2)):
            found["matrix-data"].append(f"camera1 or camera2 of pair_id {pair_id}")
    if {"qvec", "tvec"} <= columns_of(connection, "two_view_geometries"):
        query = "SELECT pair_id FROM two_view_geometries WHERE (qvec IS NULL) != (tvec IS NULL)"
        for (pair_id,) in connection.execute(query):
            found["matrix-data"].append(f"qvec and tvec of pair_id {pair_id}")


def _check_sizes(connection: sqlite3.Connection, table: str, found: Problems) -> None:
    """Find matrices and vectors of a table that hold another number of values than they must."""
    sizes = MATRICES[table]
    for name in sizes.keys() & columns_of(connection, table):
        for row, blob in rows_of(connection, f"rowid {name}", table):
            if not blob:
                continue
            matrix = _array(
                blob=blob,
                rows=1,
                columns=sizes[name],
                dtype=np.dtype("<f8"),
            )
            if matrix is None:
                found["matrix-data"].append(f"{name} of row {row} of {table}")


def _is_camera_or_none(blob: Any) -> bool:
    """Return whether COLMAP can read a camera that it has packed into a column, if there is one."""
    if not blob:
        return True
    if not isinstance(blob, bytes) or len(blob) < PACKED_CAMERA.size:
        return False
    _, model, *_, count = PACKED_CAMERA.unpack_from(blob)
    like = camera_like(model)
    size = PACKED_CAMERA.size + 8 * count
    return like is not None and count == len(like.params) and len(blob) == size


def _check_keypoints(
    connection: sqlite3.Connection, tables: Tables, found: Problems
) -> None:
    extents: dict[str, float] = {}
    rows = rows_of(connection, "image_id rows cols data", "keypoints")
    for image_id, count, width, blob in rows:
        name = tables.names.get(image_id)
        if not name:
            continue
        if count and width not in KEYPOINT_COLUMNS:
            found["keypoint-data"].append(f"{name} has {width}")
            continue
        keypoints = _array(
            blob=blob,
            rows=count,
            columns=width,
            dtype=np.dtype("<f4"),
        )
        if keypoints is None:
            found["keypoint-data"].append(name)
            continue
        size = _size_of(tables, image_id)
        for kind in keypoint_problems(keypoints, size):
            found[kind].append(name)
        if size and count >= MIN_IN_A_CORNER:
            extents[name] = extent(keypoints, size)
    if are_in_a_corner(extents.values()):
        found["keypoints-in-a-corner"] += sorted(extents)


def _size_of(tables: Tables, image_id: int) -> tuple[int, int] | None:
    """Return (width, height) of an image in px, None where no camera has one."""
    camera = tables.cameras.get(tables.camera_ids[image_id])
    has_size = camera and min(camera.width, camera.height) > 0
    return (camera.width, camera.height) if camera and has_size else None


def _check_descriptors(
    connection: sqlite3.Connection, tables: Tables, found: Problems
) -> None:
    rows = rows_of(connection, "image_id rows cols data", "descriptors")
    for image_id, count, width, blob in rows:
        descriptors = _array(
            blob=blob,
            rows=count,
            columns=width,
            dtype=np.dtype("u1"),
        )
        if descriptors is None:
            found["descriptor-data"].append(
                tables.names.get(image_id, f"image {image_id}")
            )


def extent(keypoints: Singles, size: tuple[int, int]) -> float:
    """Return how far (N, 2 or more) keypoints reach from the upper left corner, 1 for a side.

    That of the side where they reach further.
    """
    return float((keypoints[:, :2].max(axis=0) / np.array(size, np.float64)).max())


def are_in_a_corner(extents: Collection[float]) -> bool:
    """Return whether the keypoints of all images end so early that these were shrunk."""
    return len(extents) >= MIN_IMAGES_IN_A_CORNER and max(extents) < IN_A_CORNER


def keypoint_problems(keypoints: Floats, size: tuple[int, int] | None) -> list[str]:
    """Return which kinds of problems some keypoints of an image have.

    Args:
        keypoints: (N, 2 or more), in COLMAP's px.
        size: (width, height) of the image in px, None where it is not known.
    """
    finite = np.asarray((np.abs(keypoints) <= MAX_SIDE_PX).all(axis=1))
    points = keypoints[finite, :2]
    found = list[str]()
    if not finite.all():
        found.append("keypoints-not-finite")
    if (size is None or max(size) > MAX_NORMALISED) and _are_normalised(points):
        found.append("keypoints-normalised")
    if size and _are_outside(points, size):
        found.append("keypoints-outside")
    if _are_at_one_place(points, len(keypoints)):
        found.append("keypoints-at-one-place")
    return found


def _are_normalised(points: Floats) -> bool:
    """Tell whether (N, 2) keypoints are not in px, but in sides of their image."""
    if len(points) < MIN_NORMALISED:
        return False
    return bool(np.abs(points).max() <= MAX_NORMALISED)


def _are_outside(points: Floats, size: tuple[int, int]) -> bool:
    """Tell whether some of (N, 2) keypoints are clearly outside of an image of (width, height)."""
    if not len(points):
        return False
    margin_px = MAX_OUTSIDE * max(size) + MAX_OUTSIDE_PX
    beyond_px = np.maximum(-points, points - np.array(size, np.float32))
    return bool(beyond_px.max() > margin_px)


def _are_at_one_place(points: Floats, num_keypoints: int) -> bool:
    """Tell whether more than half of the keypoints of an image are at the same of (N, 2) points."""
    if len(points) < MIN_AT_ONE_PLACE:
        return False
    middle = len(points) // 2
    # What more than half have is the median
    median = np.partition(points, middle, axis=0)[middle]
    num_there = int((points == median).all(axis=1).sum())
    return num_there >= max(MIN_AT_ONE_PLACE, num_keypoints // 2 + 1)


def _array(
    blob: Any, rows: int, columns: int, dtype: np.dtype[Any]
) -> NDArray[Any] | None:
    """Return the (rows, columns) array that is stored in a table, None if it is another size."""
    data = b"" if blob is None else blob
    if not isinstance(data, bytes) or rows < 0 or columns < 0:
        return None
    if len(data) != rows * columns * dtype.itemsize:
        return None
    return np.frombuffer(data, dtype).reshape(rows, columns)


def _check_pairs(
    connection: sqlite3.Connection, tables: Tables, found: Problems
) -> None:
    for table, what in (("matches", "raw matches"), ("two_view_geometries", "inliers")):
        stored = rows_of(connection, "pair_id rows cols data", table)
        for pair_id, rows, columns, blob in stored:
            image_ids = divmod(pair_id, MAX_NUM_IMAGES)
            matches = _array(blob, rows, columns, np.dtype("<u4"))
            if not _are_matches(matches, image_ids, tables):
                names = [tables.names.get(key, f"image {key}") for key in image_ids]
                found["match-data"].append(f"{names[0]} - {names[1]} ({what})")


def _are_matches(
    matches: NDArray[Any] | None, image_ids: tuple[int, int], tables: Tables
) -> bool:
    """Tell whether matches are (M, 2) numbers of keypoints of two images of a database."""
    if matches is None or image_ids[0] == image_ids[1]:
        return False
    if not tables.names.keys() >= set(image_ids):
        return False
    if not len(matches):
        return True
    if matches.shape[1] != 2:
        return False
    num_keypoints = [
        tables.keypoints.get(image_id, (0, 0))[0] for image_id in image_ids
    ]
    return bool((matches.max(axis=0) < num_keypoints).all())
