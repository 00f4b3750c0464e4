"""The COLMAP database: what it holds, and keypoints and matches into it.

Everything is checked before it is written: an index out of range would later end the process.
"""

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.tables import MAX_NUM_IMAGES, damage_of
from colmap_affrect.errors import DatabaseError, Option, such_as
from colmap_affrect.geometry import conventions
from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices, Singles
from colmap_affrect.geometry.earth import why_not_on_earth
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.regular_files import NotAFileError, require_regular

logger = logging.getLogger(__name__)

BYTES_PER_ROW = 4096  # format: a page of SQLite
# What :func:`require_database_space` reckons with; measured
BYTES_OF_EMPTY_DATABASE = 1 << 19
# Free on the disk, below which a database that does not open is said to lack space: SQLite's files
# beside it take some. Measured: half a MB may not suffice
BYTES_TO_OPEN = 1 << 22
# How often a database is tried that others are using; resource
TRIES_TO_OPEN = 10
PAUSE_S = 0.1  # resource: before it is tried again


@contextmanager
def open_database(path: Path) -> Iterator[pycolmap.Database]:
    """Open a database and close it again; pycolmap's failures become errors of one line."""
    try:
        require_regular(path)
        database = _open_when_free(path)
    except NotAFileError as error:
        raise DatabaseError(
            f"not a usable COLMAP database ({error})", where=path
        ) from error
    except RuntimeError as error:
        require_space(path, BYTES_TO_OPEN)
        if path.exists() and not os.access(path, os.W_OK):
            raise DatabaseError(
                "cannot be written (it is read-only)",
                where=path,
                advice="permit that, and run the same command again",
            ) from error
        raise DatabaseError(
            f"not a usable COLMAP database, or in use by another program ({error})",
            where=path,
        ) from error
    try:
        with closing(database):
            yield database
    except RuntimeError as error:
        fault = damage_of(path)
        if fault:
            raise DatabaseError(fault, where=path, advice=_mend(path)) from error
        raise cannot_write(path, error) from error


def _open_when_free(path: Path) -> pycolmap.Database:
    """Open a database; one that another program just opens or closes is tried again soon.

    COLMAP locks a database for a moment when it opens and closes it, and does not wait for others.
    """
    for _ in range(TRIES_TO_OPEN - 1):
        try:
            # A Ctrl-C while pycolmap converts a Path would become a TypeError.
            return pycolmap.Database.open(str(path))
        except RuntimeError:
            if damage_of(path):
                break
            time.sleep(PAUSE_S)
    return pycolmap.Database.open(str(path))


def _mend(path: Path) -> str:
    """Say what mends a damaged database; those of runs are made again when they are next used."""
    if (path.parent / "config.toml").exists():
        return "run the same command again, which makes it again from what it was made from"
    return "restore it; 'sqlite3 FILE .recover' may save a part of it"


def write_frame(
    database: pycolmap.Database,
    image: pycolmap.Image,
    rigs: dict[pycolmap.sensor_t, int],
) -> None:
    """Give an image a frame of the rig of its camera.

    Args:
        database: gets the frame, and a rig where the camera has none.
        image: a row of the database.
        rigs: ids of rigs by their reference sensors; gets those that are made.
    """
    sensor = image.data_id.sensor_id
    if sensor not in rigs:
        rig = pycolmap.Rig()
        rig.add_ref_sensor(sensor)
        rigs[sensor] = database.write_rig(rig)
    frame = pycolmap.Frame(rig_id=rigs[sensor])
    frame.add_data_id(image.data_id)
    database.write_frame(frame)


def require_database_space(path: Path, num_new: int) -> None:
    """Make sure that a database has room for so many new rows, and its log for all its content.

    Functions of pycolmap that write end the process on a full disk; here it is a WorkspaceError.
    """
    size = path.stat().st_size if path.exists() else 0
    require_space(path, 2 * size + num_new * BYTES_PER_ROW + BYTES_OF_EMPTY_DATABASE)


def image_ids(path: Path) -> dict[str, int]:
    """Return the image ids by name; an empty database is made if the file is missing."""
    with open_database(path) as database:
        return ids_of_images(database)


def ids_of_images(database: pycolmap.Database) -> dict[str, int]:
    """Return the ids of the images of a database that is open, by name."""
    return {image.name: image.image_id for image in database.read_all_images()}


def names_of_images(database: pycolmap.Database) -> dict[int, str]:
    """Return the names of the images of a database that is open, by id."""
    return {image.image_id: image.name for image in database.read_all_images()}


def nearest_positions(
    path: Path, num_neighbors: int, max_distance_m: float
) -> list[tuple[str, str]]:
    """Return the pairs of images near to each other by pose priors; heights of GPS are rough.

    Args:
        path: the database.
        num_neighbors: of each image, at most.
        max_distance_m: between the positions of a pair, without heights.

    Returns:
        Pairs of image names, sorted.

    Raises:
        DatabaseError: fewer than two images have a position.
    """
    options = pycolmap.SpatialPairingOptions(
        max_num_neighbors=num_neighbors, max_distance=max_distance_m, ignore_z=True
    )
    return spatial_pairs(path, options)


def spatial_pairs(
    path: Path, options: pycolmap.SpatialPairingOptions
) -> list[tuple[str, str]]:
    """Return the pairs of COLMAP's spatial matcher whose positions are places on earth.

    DatabaseError without two such positions.
    """
    positions, wrong = read_positions(path)
    if wrong:
        reasons = [f"{name} ({why})" for name, why in sorted(wrong.items())]
        logger.warning("%s: positions that do not count: %s", path, such_as(reasons))
    if len(positions) < 2:
        raise DatabaseError(
            f"{len(positions)} images have a position (latitude, longitude and altitude in "
            "EXIF, or pose priors)",
            where=path,
            advice="choose pairs in another way",
        )
    pairs = generated_pairs(path, pycolmap.SpatialPairGenerator, options)
    return [pair for pair in pairs if wrong.keys().isdisjoint(pair)]


def read_positions(path: Path) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the (3,) positions of the pose priors by image, and why others are none on earth."""
    with open_database(path) as database:
        names = names_of_images(database)
        priors = database.read_all_pose_priors()
    positions = dict[str, Array]()
    wrong = dict[str, str]()
    for prior in priors:
        name = names.get(prior.corr_data_id.id)
        if name is None or not prior.has_position():
            continue
        position = np.array(prior.position).ravel()
        why = ""
        if prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84:
            why = why_not_on_earth(position)
        if why:
            wrong[name] = why
        else:
            positions[name] = position
    return positions, wrong


def generated_pairs(
    path: Path,
    kind: Callable[[Any, pycolmap.Database], pycolmap.PairGenerator],
    options: object,
) -> list[tuple[str, str]]:
    """Return the pairs of images that a generator of pycolmap makes.

    Args:
        path: the database.
        kind: the class of the generator.
        options: of pycolmap, for this class.

    Returns:
        Pairs of image names, the names of each and the pairs sorted.
    """
    pairs = set[tuple[str, str]]()
    with open_database(path) as database:
        names = names_of_images(database)
        for image_id1, image_id2 in kind(options, database).all_pairs():
            first, second = sorted((names[image_id1], names[image_id2]))
            pairs.add((first, second))
    return sorted(pairs)


def num_matched_pairs(path: Path) -> int:
    """Return the number of pairs that have raw matches or a two-view geometry with inliers."""
    matched = set[int]()
    with open_database(path) as database:
        geometries = database.read_two_view_geometry_num_inliers()
        for pair_ids, counts in (database.read_num_matches(), geometries):
            matched.update(np.asarray(pair_ids)[np.asarray(counts) > 0].tolist())
    return len(matched)


def num_inliers_of_pairs(
    database: pycolmap.Database, min_num_inliers: int = 1
) -> dict[tuple[int, int], int]:
    """Return the number of inliers of verified pairs of image ids, without reading these.

    Args:
        database: to read.
        min_num_inliers: of a pair; others are left out.
    """
    pair_ids, counts = database.read_two_view_geometry_num_inliers()
    found = {}
    for pair_id, count in zip(pair_ids, counts, strict=True):
        if count >= min_num_inliers:
            found[pycolmap.pair_id_to_image_pair(pair_id)] = int(count)
    return found


def unverified_pairs(path: Path) -> Indices:
    """Return the (N, 2) image ids with raw matches and no two-view geometry, good or bad."""
    with open_database(path) as database:
        return pairs_to_verify(database)


def pairs_to_verify(database: pycolmap.Database) -> Indices:
    """Return the (N, 2) image ids with raw matches and no two-view geometry, good or bad."""
    pair_ids, counts = map(np.asarray, database.read_num_matches())
    verified, _ = database.read_two_view_geometry_num_inliers()
    rest = np.setdiff1d(pair_ids[counts > 0].astype(np.int64), verified)
    pairs = np.stack(np.divmod(rest, MAX_NUM_IMAGES), axis=1)
    is_new = [not database.exists_two_view_geometry(*pair) for pair in pairs]
    return pairs[np.array(is_new, np.bool_)]


def lack_matches(database: pycolmap.Database, image_ids: NDArray[np.integer]) -> Bools:
    """Tell which of (N, 2) image ids have no row of raw matches; not those with an id of 0."""
    low, high = np.sort(image_ids, axis=1).T
    matched, _ = database.read_num_matches()
    lacking: Bools = (low > 0) & ~np.isin(low * MAX_NUM_IMAGES + high, matched)
    for row in np.flatnonzero(lacking):  # a row of none does not count there
        lacking[row] = not database.exists_matches(*image_ids[row])
    return lacking


def colmap_keypoints(lafs: Floats) -> Singles:
    """Turn (N, 2, 3) local affine frames into COLMAP's 6 columns x, y, a11, a12, a21, a22.

    The centre moves to COLMAP's corner origin; the shape maps the unit circle to one sigma.
    """
    centers = conventions.colmap_from_pixel(lafs[:, :, 2].astype(np.float32))
    shapes = lafs[:, :, :2] / conventions.MEASUREMENT_SIGMAS
    rows = shapes.astype(np.float32).reshape(-1, 4)
    return np.concatenate([centers, rows], axis=1)


def has_keypoints(database: pycolmap.Database, image_id: int, count: int) -> bool:
    """Tell whether an image has a number of keypoints on record.

    Args:
        database: is only read.
        image_id: of the image.
        count: the number; 0 is for an image that features were extracted of without finding any.
    """
    if not database.exists_keypoints(image_id):
        return False
    return database.num_keypoints_for_image(image_id) == count


def write_keypoints(
    database: pycolmap.Database,
    image_id: int,
    lafs: Floats,
    level_ends: Sequence[int] = (),
) -> None:
    """Write the keypoints of an image.

    Args:
        database: gets them.
        image_id: of the image.
        lafs: (N, 2, 3) local affine frames, in pixel-centre px.
        level_ends: numbers of keypoints that are replaced where the image has so many already:
            those of the levels before.

    Raises:
        DatabaseError: the image has others, or the keypoints are not finite.
    """
    if has_keypoints(database, image_id, len(lafs)):
        return
    count = database.num_keypoints_for_image(image_id)
    exists = database.exists_keypoints(image_id)
    if exists and count not in level_ends:
        name = database.read_image(image_id).name
        raise DatabaseError(
            f"{name} has {count} keypoints in the database and "
            f"{len(lafs)} in the feature file",
            advice=("run extract again with ", Option("overwrite")),
        )
    keypoints = colmap_keypoints(lafs)
    if not np.isfinite(keypoints).all():
        name = database.read_image(image_id).name
        raise DatabaseError("keypoints are not finite", where=name)
    if exists:
        database.update_keypoints(image_id, keypoints)
    else:
        database.write_keypoints(image_id, keypoints)


DESCRIPTOR_SIZE = 128  # COLMAP's SIFT
DESCRIPTOR_NORM = 512  # COLMAP's SIFT
# Added to signed descriptors: COLMAP's brute-force matcher needs cosines >= 0. Three
# deviations and more of the components of a row of 128 and of unit length; theory
SIGNED_SHIFT = 0.30


def read_descriptors(
    database: pycolmap.Database, image_id: int, num_keypoints: int, where: str
) -> Singles:
    """Return the (N, D) descriptors of an image, as its file has them.

    Args:
        database: where they are.
        image_id: of the image.
        num_keypoints: N, the number that there must be.
        where: the file and the image, for errors.

    Raises:
        DatabaseError: their number or their type is wrong.
    """
    descriptors = database.read_descriptors(image_id)
    count = len(descriptors.data)
    if count != num_keypoints:
        raise DatabaseError(
            f"{where} has {num_keypoints} keypoints and {count} descriptors"
        )
    try:
        return np.asarray(descriptors.to_float().data, np.float32)
    except ValueError as error:
        raise DatabaseError(f"{where} has descriptors of no known type") from error


def write_descriptors(
    database: pycolmap.Database, image_id: int, descriptors: Floats
) -> None:
    """Write the descriptors of an image as uint8 rows of length 512, as COLMAP's SIFT has them.

    Signed ones are shifted to positive values first, which makes all angles smaller and hardly
    changes their order.

    Args:
        database: gets them.
        image_id: of the image.
        descriptors: (N, 128), of unit length.

    Raises:
        DatabaseError: the descriptors have another size than 128.
    """
    if descriptors.shape[1] != DESCRIPTOR_SIZE:
        raise DatabaseError(
            f"descriptors have {descriptors.shape[1]} elements",
            advice=(
                f"COLMAP's matchers take those with {DESCRIPTOR_SIZE} only, leave out ",
                Option("database-descriptors"),
            ),
        )
    is_signed = descriptors.min(initial=0.0) < 0.0
    shift = SIGNED_SHIFT if is_signed else 0.0
    positive = np.maximum(descriptors.astype(np.float64) + shift, 0.0)
    lengths = np.linalg.norm(positive, axis=1, keepdims=True)
    scaled = DESCRIPTOR_NORM * positive / np.maximum(lengths, np.finfo(np.float64).tiny)
    rows = np.asarray(np.minimum(np.rint(scaled), 255), dtype=np.uint8)
    sift = pycolmap.FeatureExtractorType.SIFT
    database.write_descriptors(
        image_id, pycolmap.FeatureDescriptors(type=sift, data=rows)
    )


def fill_descriptors(path: Path, features: FeatureStore) -> None:
    """Write the descriptors of all images into a database as COLMAP's matchers take them."""
    ids = image_ids(path)
    counts = features.num_keypoints()
    names = [name for name in counts if name in ids]
    with open_database(path) as database:
        num_written = {}
        for name in names:
            num_written[name] = database.num_descriptors_for_image(ids[name])
        # Others are from before an escalation, and COLMAP cannot replace single ones.
        are_current = all(num_written[name] in (0, counts[name]) for name in names)
        if not are_current:
            database.clear_descriptors()
            num_written = dict.fromkeys(names, 0)
        for name in names:
            if counts[name] and not num_written[name]:
                write_descriptors(database, ids[name], features.read(name).descriptors)


def camera_matrix(camera: pycolmap.Camera) -> Array:
    """Return (3, 3) intrinsics in pixel-centre px, without distortion."""
    matrix = np.asarray(camera.calibration_matrix(), dtype=np.float64)
    matrix[:2, 2] = conventions.pixel_from_colmap(matrix[:2, 2])
    return matrix


def cameras_of_images(database: pycolmap.Database) -> dict[int, pycolmap.Camera]:
    """Return the camera of each image by image id."""
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    return {
        image.image_id: cameras[image.camera_id] for image in database.read_all_images()
    }


def write_matches(
    database: pycolmap.Database,
    image_id1: int,
    image_id2: int,
    indices: NDArray[np.integer],
) -> None:
    """Write the raw matches of a pair; every index is checked first.

    Different ones are replaced, and their two-view geometry is deleted.

    Args:
        database: has the keypoints, and gets the matches.
        image_id1: of one image.
        image_id2: of the other image.
        indices: (M, 2) numbers of keypoints of the two.

    Raises:
        DatabaseError: these cannot be matches of the two images.
    """
    _check_indices(database, (image_id1, image_id2), indices)
    if database.exists_matches(image_id1, image_id2):
        if np.array_equal(database.read_matches(image_id1, image_id2), indices):
            return
        database.delete_matches(image_id1, image_id2)
        if database.exists_two_view_geometry(image_id1, image_id2):
            database.delete_two_view_geometry(image_id1, image_id2)
    database.write_matches(image_id1, image_id2, indices.astype(np.uint32))


def _check_indices(
    database: pycolmap.Database,
    image_ids: tuple[int, int],
    indices: NDArray[np.integer],
) -> None:
    """Refuse matches that are not (M, 2) numbers of keypoints of two images."""
    image_id1, image_id2 = image_ids
    if image_id1 == image_id2:
        name = database.read_image(image_id1).name
        raise DatabaseError(f"{name} cannot be matched with itself")
    are_pairs = indices.ndim == 2 and indices.shape[1] == 2
    if not are_pairs or not np.issubdtype(indices.dtype, np.integer):
        raise DatabaseError(
            f"matches must be (M, 2) integers, not {indices.dtype}{indices.shape}"
        )
    if not indices.size:
        return
    counts = [
        database.num_keypoints_for_image(image_id1),
        database.num_keypoints_for_image(image_id2),
    ]
    largest = indices.max(axis=0)
    if indices.min() < 0 or (largest >= counts).any():
        names = f"{database.read_image(image_id1).name}, {database.read_image(image_id2).name}"
        raise DatabaseError(
            f"matches of {names} point at keypoints that do not exist (largest "
            f"{largest.tolist()}, keypoints {counts})",
            advice="match them again",
        )
