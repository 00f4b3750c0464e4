"""Features and matches in hloc's HDF5 files, into and out of COLMAP databases.

Features: a group per image name, nested at '/', with ``keypoints`` (N, 2), ``descriptors`` (D, N),
``scores`` (N,), ``image_size`` (width, height), and perhaps ``scales`` (N,) in sigmas, ``oris``
(N,) in degrees from x towards y, ``lafs`` (N, 2, 3). Matches: a group per pair with ``matches0``
(N0,), -1 where unmatched, and ``matching_scores0`` (N0,); in its key each '/' of a name is '-', and
'/' stands between the names. (0, 0) is the centre of the first pixel.

Links and data in other files are not followed, and arrays are checked.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import (
    CHECKS,
    USELESS_KEYPOINTS,
    WARNED,
    check_database,
    keypoint_problems,
)
from colmap_affrect.colmap.database import (
    DESCRIPTOR_NORM,
    colmap_keypoints,
    open_database,
    write_matches,
)
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.colmap.initial_cameras import InitialCameras, import_images
from colmap_affrect.colmap.verification import VerificationOptions, verified_pairs, verify
from colmap_affrect.errors import (
    DatabaseError,
    ImageError,
    OptionError,
    StoreError,
    damage,
    such_as,
)
from colmap_affrect.geometry.arrays import Singles
from colmap_affrect.geometry.conventions import (
    MEASUREMENT_SIGMAS,
    colmap_from_pixel,
    pixel_from_colmap,
)
from colmap_affrect.images.photographs import CameraOptions, list_images, refuse_colliding_keys
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.progress import SILENT, Advance, Progress
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.outputs import leads_outside, new_results
from colmap_affrect.project.paths import PathLike, as_path
from colmap_affrect.project.stores import PairMatches, frame_datasets, hloc_matches, pair_key

Datasets = dict[str, NDArray[Any]]

MAX_VALUES = 1 << 28  # an array of more values is taken for damage, and not read
SPARE_BYTES = 8 << 20  # for HDF5's index, and for what it has not written yet
MEND = "make it again with the program that wrote it"


@dataclass(frozen=True)
class InterchangeReport:
    """What was imported or exported."""

    action: str  # ``imported`` or ``exported``
    num_images: int  # in the database or the file, also those without features
    num_keypoints: int
    num_pairs: int
    num_matches: int
    num_verified: int | None  # pairs with a two-view geometry; None if not asked for
    left_out: Mapping[str, Sequence[str]]  # names by what happened to them

    def summary(self) -> str:
        """Return a line of numbers, and one for each note."""
        verified = "" if self.num_verified is None else f", {self.num_verified} verified"
        counts = (
            f"{self.action}: {self.num_images} images, {self.num_keypoints} keypoints, "
            f"{self.num_pairs} pairs{verified}, {self.num_matches} matches"
        )
        notes = [f"note: {what}: {such_as(of)}" for what, of in self.left_out.items() if of]
        return "\n".join([counts, *notes])


@dataclass(frozen=True)
class _Source:
    """An open HDF5 file of another program, and the shapes of its datasets by their paths."""

    path: Path
    file: h5py.File
    shapes: dict[str, tuple[int, ...]]

    def groups_with(self, dataset: str) -> list[str]:
        """Return the sorted paths of the groups that have a dataset."""
        ending = f"/{dataset}"
        found = sorted(key.removesuffix(ending) for key in self.shapes if key.endswith(ending))
        if self.shapes and not found:
            raise StoreError(f"{self.path}: holds no '{dataset}' of images; is it a file of hloc?")
        return found

    def read(self, key: str, shape: tuple[int | None, ...], kinds: str = "fiu") -> NDArray[Any]:
        """Read numbers of some of numpy's kinds, of a shape in which None is any size."""
        stored = self.shapes[key]
        expected = tuple(stored[:1]) if shape[0] is None else shape[:1]
        if stored != expected + shape[1:]:
            wanted = str(shape).replace("None", "N")
            raise StoreError(f"{self.path}: {key} has shape {stored}, expected {wanted}")
        if np.prod([float(size) for size in stored]) > MAX_VALUES:
            raise StoreError(f"{self.path}: {key} of shape {stored} is too large to be true")
        with damage(self.path, MEND):
            if self.file[key].dtype.kind not in kinds:
                raise ValueError(f"{key} does not hold numbers, or no whole ones")
            return np.asarray(self.file[key][()])


@contextmanager
def _opened(path: Path) -> Iterator[_Source]:
    """Open a file for reading; of links nothing is seen, data that are elsewhere are refused."""
    if not path.is_file():
        raise OptionError(f"{path}: no such file")
    shapes: dict[str, tuple[int, ...]] = {}

    def visit(key: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise StoreError(f"{path}: data in other files are not followed: {key}")
            shapes[key] = item.shape or ()

    with damage(path, f"or still being written; {MEND}"):
        file = h5py.File(path, "r")
        try:
            file.visititems(visit)
        except SystemError as error:  # h5py's, for a name that is no UTF-8
            raise ValueError(error) from error
    with file:
        yield _Source(path, file, shapes)


def import_h5(
    image_path: PathLike,
    features_path: PathLike,
    matches_path: PathLike,
    database_path: PathLike,
    *,
    cameras: CameraOptions | None = None,
    skip_verification: bool = False,
    random_seed: int = 0,
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Make a new COLMAP database from features and matches in hloc's layout.

    Keypoints get 6 columns where the file has ``lafs``, 4 where it has ``scales`` and ``oris``,
    else 2. All images of the folder are imported, with or without features. ``random_seed`` is that
    of verification.

    Raises OptionError when the database exists, StoreError for files that cannot be read, or
    contradict the photographs or each other.
    """
    features_path, matches_path = map(as_path, (features_path, matches_path))
    image_path, database_path = map(as_path, (image_path, database_path))
    cameras = cameras or CameraOptions()
    names = list_images(image_path)
    InitialCameras(image_path, cameras).check(names)
    with (
        # Verification may take hours, and half a database must not be left behind.
        new_results(database_path, names=names) as (new,),
        _opened(features_path) as features,
        _opened(matches_path) as matches,
    ):
        described = features.groups_with("keypoints")
        if unknown := sorted(set(described) - set(names)):
            raise StoreError(
                f"{features_path}: has features of images that are not in {image_path}: "
                f"{such_as(unknown)}"
            )
        refuse_colliding_keys(described)
        pairs = _pairs(matches, described)
        rejected = import_images(new, image_path, names, cameras)
        if lost := sorted(set(described) & set(rejected)):
            raise ImageError(
                f"{image_path}: COLMAP does not take (damaged, or of another size than camera "
                f"mode {cameras.mode} allows): {such_as(lost)}"
            )
        counts = _fill(new, features, described, matches, pairs, progress)
        odd = _odd_keypoints(new)
        num_verified = None
        if not skip_verification:
            num_verified = _verify(new, len(pairs), random_seed, progress)
    without = sorted(set(names) - set(rejected) - set(described))
    left_out = {
        "images without features are there without keypoints": without,
        "images that COLMAP does not take are left out": rejected,
        **odd,
    }
    num_images = len(names) - len(rejected)
    return InterchangeReport("imported", num_images, *counts, num_verified, left_out)


def _verify(path: Path, num_pairs: int, random_seed: int, progress: Progress) -> int:
    """Verify all matched pairs; return how many are."""
    options = VerificationOptions(random_seed=random_seed)
    with progress.stage("verify", num_pairs, "pairs") as advance:
        verify(path, options, advance=advance)
    return len(verified_pairs(path, options.min_num_inliers))


def _odd_keypoints(path: Path) -> dict[str, list[str]]:
    """Return images whose keypoints are allowed, and may be wrong all the same, by what is odd."""
    problems = check_database(path)[1]
    return {CHECKS[kind]["what"]: problems[kind] for kind in sorted(WARNED & problems.keys())}


def _fill(
    path: Path,
    features: _Source,
    described: Sequence[str],
    matches: _Source,
    pairs: Mapping[Pair, str],
    progress: Progress,
) -> tuple[int, int, int]:
    """Write keypoints and matches of images that a database has; return how many of each."""
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        images = {image.name: image for image in database.read_all_images()}
        with progress.stage("keypoints", len(described), "images") as advance:
            for name in described:
                _write_keypoints(database, images[name], features)
                advance(1)
        with progress.stage("matches", len(pairs), "pairs") as advance:
            for pair, key in pairs.items():
                _write_matches(database, [images[name] for name in pair], matches, key)
                advance(1)
        return database.num_keypoints(), len(pairs), database.num_matches()


def _pairs(source: _Source, described: Sequence[str]) -> dict[Pair, str]:
    """Return the key of the matches of each pair of two images."""
    names = {name.replace("/", "-"): name for name in described}
    pairs: dict[Pair, str] = {}
    unknown = []
    for key in source.groups_with("matches0"):
        first, _, second = key.partition("/")
        if first not in names or second not in names:
            unknown.append(key)
        elif first != second and (names[second], names[first]) not in pairs:
            pairs[names[first], names[second]] = key
    if unknown:
        raise StoreError(
            f"{source.path}: has matches of images that have no features: {such_as(unknown)}"
        )
    return pairs


def _write_keypoints(database: pycolmap.Database, image: pycolmap.Image, source: _Source) -> None:
    """Write the keypoints of an image, if it is as large as the features were found in."""
    name, camera = image.name, database.read_camera(image.camera_id)
    expected = (camera.width, camera.height)
    if f"{name}/image_size" in source.shapes:
        size = tuple(source.read(f"{name}/image_size", (2,)).tolist())
        if size != expected:
            turned = " (turned by its EXIF orientation?)" if size == expected[::-1] else ""
            raise StoreError(
                f"{source.path}: {name} was {size[0]:g} x {size[1]:g} px for the features{turned}, "
                f"and the photograph is {expected[0]} x {expected[1]} px; use the same photographs"
            )
    keypoints = _keypoint_rows(source, name)
    for kind in USELESS_KEYPOINTS.intersection(keypoint_problems(keypoints, expected)):
        check = CHECKS[kind]
        raise StoreError(f"{source.path}: {check['what']}: {name}; {check['advice']}")
    database.write_keypoints(image.image_id, keypoints)


def _keypoint_rows(source: _Source, name: str) -> Singles:
    """Return the (N, 2), (N, 4) or (N, 6) keypoints of an image as COLMAP stores them."""
    lafs, scales, oris = (f"{name}/{dataset}" for dataset in ("lafs", "scales", "oris"))
    with np.errstate(over="ignore"):  # what float32 cannot hold is refused later
        points = source.read(f"{name}/keypoints", (None, 2)).astype(np.float32)
        centers = np.asarray(colmap_from_pixel(points))
        count = len(points)
        if lafs in source.shapes:
            frames = source.read(lafs, (count, 2, 3)).astype(np.float64)
            return np.column_stack([centers, colmap_keypoints(frames)[:, 2:]])
        if not {scales, oris} <= source.shapes.keys():
            return centers
        sigmas = source.read(scales, (count,)).astype(np.float32)
        angles = np.deg2rad(source.read(oris, (count,)).astype(np.float32))
        return np.column_stack([centers, sigmas, angles])


def _write_matches(
    database: pycolmap.Database, images: Sequence[pycolmap.Image], source: _Source, key: str
) -> None:
    id1, id2 = (image.image_id for image in images)
    num_keypoints1 = database.num_keypoints_for_image(id1)
    column = source.read(f"{key}/matches0", (num_keypoints1,), "iu").astype(np.int64)
    rows = np.flatnonzero(column != -1)
    try:
        write_matches(database, id1, id2, np.stack([rows, column[rows]], axis=1))
    except DatabaseError as error:
        raise StoreError(f"{source.path}: {key}: {error}") from error


def export_h5(
    database_path: PathLike,
    features_path: PathLike,
    matches_path: PathLike,
    *,
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Write features and raw matches of a COLMAP database, which stays as it is, for hloc.

    Features keep their indices. Descriptors are of unit length. Scores, which a database does not
    have, are 1. Of several matches of a keypoint of the first image one is kept. Raises OptionError
    when a file exists, StoreError for names that hloc's layout cannot hold.
    """
    paths = database_path, features_path, matches_path
    database_path, features_path, matches_path = map(as_path, paths)
    if features_path.resolve() == matches_path.resolve():
        raise OptionError(f"{features_path}: features and matches need a file each")
    with open_copy(database_path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        known = [image for image in images if database.exists_keypoints(image.image_id)]
        names = [image.name for image in known]
        _check_names(names)
        pairs = list(map(pycolmap.pair_id_to_image_pair, database.read_num_matches()[0]))
        features = ((i.name, _feature_datasets(database, i, database_path)) for i in known)
        matches = _match_groups(database, known, pairs)
        with new_results(features_path, matches_path, names=names) as made:
            with progress.stage("features", len(names), "images") as advance:
                _write_file(made[0], features_path, features, advance)
            with progress.stage("matches", len(pairs), "pairs") as advance:
                _write_file(made[1], matches_path, matches, advance)
        counts = database.num_keypoints(), len(pairs), database.num_matches()
    without = [image.name for image in images if image.name not in names]
    left_out = {"images without keypoints are left out": without}
    return InterchangeReport("exported", len(names), *counts, None, left_out)


def _match_groups(
    database: pycolmap.Database, images: Sequence[pycolmap.Image], pairs: Sequence[tuple[int, int]]
) -> Iterator[tuple[str, Datasets]]:
    """Yield key and datasets of each pair of image ids."""
    names = {image.image_id: image.name for image in images}
    for id1, id2 in pairs:
        indices = np.asarray(database.read_matches(id1, id2), np.int64)
        _, one_each = np.unique(indices[:, 0], return_index=True)
        scores, count = np.ones(len(one_each), np.float32), database.num_keypoints_for_image(id1)
        pair = PairMatches((names[id1], names[id2]), indices[one_each], scores, count)
        yield pair_key(*pair.names), hloc_matches(pair)


def _feature_datasets(database: pycolmap.Database, image: pycolmap.Image, path: Path) -> Datasets:
    """Return the datasets of an image with keypoints."""
    camera = database.read_camera(image.camera_id)
    keypoints = np.asarray(database.read_keypoints(image.image_id), np.float32)
    points = np.asarray(pixel_from_colmap(keypoints[:, :2]))
    data: Datasets = {
        "keypoints": points,
        "scores": np.ones(len(points), np.float32),
        "image_size": np.array([camera.width, camera.height]),
    }
    if keypoints.shape[1] == 6:
        shapes = keypoints[:, 2:].reshape(-1, 2, 2) * np.float32(MEASUREMENT_SIGMAS)
        data |= frame_datasets(np.concatenate([shapes, points[:, :, None]], axis=2))
    elif keypoints.shape[1] == 4:
        data |= {"scales": keypoints[:, 2], "oris": np.rad2deg(keypoints[:, 3])}
    if database.exists_descriptors(image.image_id):
        where = f"{path}: {image.name}"
        descriptors = database.read_descriptors(image.image_id)
        if len(descriptors.data) != len(points):
            raise DatabaseError(
                f"{where} has {len(points)} keypoints and {len(descriptors.data)} descriptors"
            )
        try:
            values = np.asarray(descriptors.to_float().data, np.float32)
        except ValueError as error:
            raise DatabaseError(f"{where} has descriptors of no known type") from error
        sift = descriptors.type == pycolmap.FeatureExtractorType.SIFT
        data["descriptors"] = (values / np.float32(DESCRIPTOR_NORM if sift else 1)).T
    return data


def _check_names(names: Sequence[str]) -> None:
    """Refuse image names that the keys of files cannot hold or tell apart."""
    unsafe = [
        name
        for name in names
        if leads_outside(name) or PurePosixPath(name).as_posix() != name or "\0" in name
    ]
    if unsafe:
        raise StoreError(f"names that are no plain relative paths: {such_as(unsafe)}")
    refuse_colliding_keys(names)
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    if both := sorted(folders.intersection(names)):
        raise StoreError(f"{both[0]}: is an image and the folder of another; rename it")


def _write_file(
    new: Path, path: Path, groups: Iterable[tuple[str, Datasets]], advance: Advance
) -> None:
    """Write groups of datasets to ``new``, of which an error says that it is ``path``.

    The disk must have room for them: else HDF5 may end the process.
    """
    require_space(path, SPARE_BYTES)
    try:
        with h5py.File(new, "w") as file:
            for key, datasets in groups:
                needed = sum(values.nbytes for values in datasets.values())
                require_space(path, needed + SPARE_BYTES)
                for name, values in datasets.items():
                    file.create_dataset(f"{key}/{name}", data=values)
                advance(1)
    except (OSError, RuntimeError) as error:
        raise cannot_write(path, error) from error
