"""The COLMAP database: cameras and images through pycolmap, keypoints and matches by us.

Everything is checked before it is written: pycolmap stores wrong dtypes silently, and an
index out of range would later end the Python process.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.conventions import MEASUREMENT_SIGMAS, colmap_from_pixel, pixel_from_colmap
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.options import CameraOptions


@contextmanager
def open_database(path: Path) -> Iterator[pycolmap.Database]:
    """Open a database and close it again; turns pycolmap's failure into one clear line."""
    try:
        database = pycolmap.Database.open(path)
    except RuntimeError as error:
        raise DatabaseError(
            f"{path}: not a usable COLMAP database, or in use by another program"
        ) from error
    try:
        yield database
    finally:
        database.close()


def import_images(
    path: Path, image_path: Path, names: Sequence[str], cameras: CameraOptions
) -> list[str]:
    """Add cameras, rigs, frames and images for the names that the database lacks.

    Image sizes, EXIF focal lengths and GPS priors are read by COLMAP itself, from the
    stored, un-rotated files.

    Returns:
        Names that COLMAP could not read.
    """
    new = sorted(set(names) - set(image_ids(path)))
    if not new:
        return []
    pycolmap.import_images(
        path,
        image_path,
        camera_mode=getattr(pycolmap.CameraMode, cameras.mode.upper().replace("-", "_")),
        image_names=new,
        options=pycolmap.ImageReaderOptions(
            camera_model=cameras.model, camera_params=cameras.params
        ),
    )
    return sorted(set(new) - set(image_ids(path)))


def image_ids(path: Path) -> dict[str, int]:
    """Return name to image id; an empty database is made if the file is missing."""
    with open_database(path) as database:
        return {image.name: image.image_id for image in database.read_all_images()}


def check_cameras(cameras: CameraOptions) -> None:
    """Refuse a camera model that COLMAP does not have, or parameters that do not fit it.

    Raises:
        OptionError: naming the option.
    """
    models = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    if cameras.model not in models:
        raise OptionError(f"--camera-model {cameras.model}: not one of {', '.join(models)}")
    if not cameras.params:
        return
    try:
        values = [float(value) for value in cameras.params.split(",")]
    except ValueError as error:
        raise OptionError(
            f"--camera-params {cameras.params}: not numbers separated by commas"
        ) from error
    expected = pycolmap.Camera.create_from_model_name(1, cameras.model, 1.0, 1, 1)
    if len(values) != len(expected.params):
        raise OptionError(
            f"--camera-params: {cameras.model} needs {len(expected.params)} values "
            f"({expected.params_info}), not {len(values)}"
        )


def geometry_digest(path: Path) -> str:
    """Return a sha256 of which pairs are verified with how many inliers."""
    with open_database(path) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    lines = sorted(f"{pair} {count}" for pair, count in zip(pair_ids, counts, strict=True))
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def num_unverified_pairs(path: Path) -> int:
    """Return the number of pairs that have raw matches and no two-view geometry, good or bad."""
    with open_database(path) as database:
        pair_ids, counts = database.read_num_matches()
        return sum(
            count > 0
            and not database.exists_two_view_geometry(*pycolmap.pair_id_to_image_pair(pair_id))
            for pair_id, count in zip(pair_ids, counts, strict=True)
        )


def colmap_keypoints(lafs: NDArray[np.floating]) -> NDArray[np.float32]:
    """Turn (N, 2, 3) frames into COLMAP's 6 columns x, y, a11, a12, a21, a22.

    The centre moves to COLMAP's corner origin; the shape maps the unit circle to one
    sigma, so the magnification of the measurement ellipse is divided out.
    """
    centers = colmap_from_pixel(lafs[:, :, 2].astype(np.float32))
    shapes = (lafs[:, :, :2] / MEASUREMENT_SIGMAS).astype(np.float32).reshape(-1, 4)
    return np.concatenate([centers, shapes], axis=1)


def write_keypoints(
    database: pycolmap.Database,
    image_id: int,
    lafs: NDArray[np.floating],
    level_ends: Sequence[int] = (),
) -> None:
    """Write the frames of one image unless it has the keypoints already.

    Args:
        database: an open database.
        image_id: of the image.
        lafs: (N, 2, 3) frames.
        level_ends: numbers of frames that it may have had before others were added behind.

    Raises:
        DatabaseError: when it has other ones.
    """
    there = database.num_keypoints_for_image(image_id)
    exists = database.exists_keypoints(image_id)
    if exists and there == len(lafs):
        return
    if exists and there not in level_ends:
        raise DatabaseError(
            f"image {image_id} has {there} keypoints in the database and {len(lafs)} in the "
            "feature file; run extract again with --overwrite"
        )
    keypoints = colmap_keypoints(lafs)
    if not np.isfinite(keypoints).all():
        raise DatabaseError(f"image {image_id}: keypoints are not finite")
    write = database.update_keypoints if exists else database.write_keypoints
    write(image_id, keypoints)


def replace_matches(
    database: pycolmap.Database, image_id1: int, image_id2: int, indices: NDArray[np.integer]
) -> None:
    """Write raw matches in the place of other ones, whose two-view geometry goes too."""
    if database.exists_matches(image_id1, image_id2):
        if np.array_equal(database.read_matches(image_id1, image_id2), indices):
            return
        database.delete_matches(image_id1, image_id2)
        if database.exists_two_view_geometry(image_id1, image_id2):
            database.delete_two_view_geometry(image_id1, image_id2)
    write_matches(database, image_id1, image_id2, indices)


def read_camera_matrix(path: Path, cameras: CameraOptions) -> NDArray[np.float64] | None:
    """Return the (3, 3) intrinsics that COLMAP gives an image, in pixel-centre px.

    From ``cameras.params``, else from EXIF, else COLMAP's guess; without distortion. None
    for a file that COLMAP cannot read.
    """
    if cameras.params:  # which pycolmap's inference leaves out of account
        camera = pycolmap.Camera.create_from_model_name(1, cameras.model, 1.0, 1, 1)
        camera.params = [float(value) for value in cameras.params.split(",")]
    else:
        options = pycolmap.ImageReaderOptions(camera_model=cameras.model)
        try:
            camera = pycolmap.infer_camera_from_image(path, options)
        except (RuntimeError, ValueError):
            return None
    matrix = np.asarray(camera.calibration_matrix(), dtype=np.float64)
    matrix[:2, 2] = pixel_from_colmap(matrix[:2, 2])
    return matrix


def write_matches(
    database: pycolmap.Database,
    image_id1: int,
    image_id2: int,
    indices: NDArray[np.integer],
) -> None:
    """Write raw matches of one pair unless it has some; every index is checked first."""
    if database.exists_matches(image_id1, image_id2):
        return
    counts = [database.num_keypoints_for_image(i) for i in (image_id1, image_id2)]
    if image_id1 == image_id2:
        raise DatabaseError(f"image {image_id1} cannot be matched with itself")
    if indices.ndim != 2 or indices.shape[1] != 2 or not np.issubdtype(indices.dtype, np.integer):
        raise DatabaseError(f"matches must be (M, 2) integers, not {indices.dtype}{indices.shape}")
    if indices.size and (indices.min() < 0 or (indices.max(axis=0) >= counts).any()):
        raise DatabaseError(
            f"matches of images {image_id1}, {image_id2} point at keypoints that do not exist "
            f"(largest {indices.max(axis=0).tolist()}, keypoints {counts}); run match again "
            "with --overwrite"
        )
    database.write_matches(image_id1, image_id2, indices.astype(np.uint32))
