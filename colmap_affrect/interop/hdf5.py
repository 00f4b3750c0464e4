"""Features and matches in HDF5 files, into and out of COLMAP databases.

Features: a group per image name, nested at '/', with ``keypoints`` (N, 2), ``descriptors`` (D, N),
``scores`` (N,), ``image_size`` (width, height), and perhaps ``scales`` (N,) in sigmas, ``oris``
(N,) in degrees from x towards y, ``lafs`` (N, 2, 3). deep-image-matching's files are read, too.
Matches: see :mod:`colmap_affrect.pairs.given_matches`. (0, 0) is the centre of the first pixel.

Links and data in other files are not followed, and arrays are checked.
"""

import logging
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
    DESCRIPTOR_SIZE,
    open_database,
    read_descriptors,
    write_descriptors,
)
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.colmap.database_verification import verified_pairs, verify
from colmap_affrect.colmap.image_import import import_images
from colmap_affrect.colmap.initial_cameras import InitialCameras
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import (
    ImageError,
    Logged,
    Option,
    OptionError,
    StoreError,
    such_as,
)
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.geometry.conventions import (
    MEASUREMENT_SIGMAS,
    pixel_from_colmap,
)
from colmap_affrect.images.photographs import (
    CameraOptions,
    list_images,
    refuse_colliding_keys,
)
from colmap_affrect.interop.given_features import (
    given_descriptors,
    keypoint_rows,
    keys_of,
    require_size,
)
from colmap_affrect.options import Summarized, documented
from colmap_affrect.pairs.given_matches import (
    GivenMatches,
    MatchType,
    given_matches,
)
from colmap_affrect.pairs.lists import Pair, exhaustive_pairs, read_pairs
from colmap_affrect.progress import Advance, GivenProgress, Progress
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.feature_store import frame_datasets
from colmap_affrect.project.given_h5 import GivenFile, open_given_file
from colmap_affrect.project.match_store import PairMatches, hloc_matches, pair_key
from colmap_affrect.project.outputs import leads_outside, new_results
from colmap_affrect.project.paths import PathLike, as_path, as_path_or_none, resolved
from colmap_affrect.stages.descriptors import (
    Arrays,
    iterate_descriptor_matches,
    unit_rows,
    write_given_matches,
)

logger = logging.getLogger(__name__)

Datasets = dict[str, NDArray[Any]]

SPARE_BYTES = 8 << 20  # for HDF5's index, and for what it has not written yet; resource


@documented
@dataclass(frozen=True)
class InterchangeReport(Summarized):
    """What was imported or exported."""

    action: str
    """``imported`` or ``exported``."""
    num_images: int
    """Images in the database or the file, also those without features."""
    num_keypoints: int
    """Keypoints of all images."""
    num_pairs: int
    """Pairs of images with matches."""
    num_matches: int
    """Matches of all pairs."""
    num_verified: int | None
    """Pairs with a two-view geometry; None if not asked for."""
    left_out: Mapping[str, Sequence[str]]
    """Names by what happened to them."""

    def summary(self) -> str:
        """Return a line of numbers, and one for each note."""
        verified = (
            "" if self.num_verified is None else f", {self.num_verified} verified"
        )
        lines = [
            f"{self.action}: {self.num_images} images, {self.num_keypoints} keypoints, "
            f"{self.num_pairs} pairs{verified}, {self.num_matches} matches"
        ]
        for what, names in self.left_out.items():
            if names:
                lines.append(f"note: {what}: {such_as(names)}")
        return "\n".join(lines)


@dataclass(frozen=True)
class _Wanted:
    """What is imported beside keypoints."""

    matches_path: Path | None  # None: images are matched by their descriptors
    match_type: MatchType
    match_list_path: Path | None  # pairs to match; None: all
    image_path: Path
    verification: VerificationOptions | None  # None: pairs stay unverified


@checks_arguments
def import_h5(  # noqa: PLR0913 (all but three are keywords)
    image_path: PathLike,
    features_path: PathLike,
    matches_path: PathLike | None,
    database_path: PathLike,
    *,
    match_type: MatchType = "raw",
    match_list_path: PathLike | None = None,
    cameras: CameraOptions | Mapping[str, Any] | None = None,
    skip_verification: bool = False,
    random_seed: int = 0,
    progress: GivenProgress = None,
) -> InterchangeReport:
    """Make a new COLMAP database from features and matches of other programs.

    Keypoints get 6 columns where the file has ``lafs``, 4 where it has ``scales`` and ``oris``,
    else 2. All images of the folder are imported, with or without features. Descriptors of 128
    values are kept, as 8-bit SIFT.

    Args:
        image_path: folder of the photographs.
        features_path: HDF5 file of features.
        matches_path: file of matches (:mod:`colmap_affrect.pairs.given_matches`); None: images are
            matched by their descriptors.
        database_path: the database to make.
        match_type: ``inliers`` are taken for verified.
        match_list_path: without matches, the pairs to match; None: all.
        cameras: who shares a camera, and what is known of it.
        skip_verification: leave pairs unverified.
        random_seed: of verification.
        progress: where to show progress.

    Returns:
        Counts, and the names of what was left out.

    Raises:
        OptionError: when the database exists.
        StoreError: for files that cannot be read, or contradict the photographs or each other.
    """
    features_path = as_path(features_path, "features_path")
    image_path = as_path(image_path, "image_path")
    database_path = as_path(database_path, "database_path")
    cameras = CameraOptions.given(cameras, "cameras")
    progress = Progress.given(progress)
    if matches_path and match_list_path:
        raise OptionError(
            ("only without ", Option("matches-path"), ": it says what to match"),
            where=Option("match-list-path"),
        )
    wanted = _Wanted(
        matches_path=as_path_or_none(matches_path, "matches_path"),
        match_type=match_type,
        match_list_path=as_path_or_none(match_list_path, "match_list_path"),
        image_path=image_path,
        verification=None
        if skip_verification
        else VerificationOptions(random_seed=random_seed),
    )
    return _import(
        image_path=image_path,
        features_path=features_path,
        database_path=database_path,
        cameras=cameras,
        wanted=wanted,
        progress=progress,
    )


def _import(
    image_path: Path,
    features_path: Path,
    database_path: Path,
    cameras: CameraOptions,
    wanted: _Wanted,
    progress: Progress,
) -> InterchangeReport:
    names = list_images(image_path)
    for warning in InitialCameras(image_path, cameras).check(names):
        logger.warning("%s", Logged(warning.line))
    with (
        # Verification may take hours, and half a database must not be left behind.
        new_results(database_path, names=names) as (new,),
        open_given_file(features_path) as features,
    ):
        keys = keys_of(features, names, image_path)
        refuse_colliding_keys(list(keys))
        with _matches(wanted, features, keys) as found:
            rejected = import_images(
                path=new, image_path=image_path, names=names, options=cameras
            )
            lost = sorted(keys.keys() & set(rejected))
            if lost:
                raise ImageError(
                    "COLMAP does not take (damaged, or of another size than camera mode "
                    f"{cameras.mode} allows): {such_as(lost)}",
                    where=image_path,
                )
            unkept = _fill(new, features, keys, progress)
            _fill_matches(path=new, given=found, wanted=wanted, progress=progress)
        counts, num_verified = _verified(new, wanted, progress)
        _, problems = check_database(new)
    without = sorted(set(names) - set(rejected) - keys.keys())
    left_out: dict[str, Sequence[str]] = {
        "images without features are there without keypoints": without,
        "images that COLMAP does not take are left out": rejected,
    }
    for kind in sorted(WARNED):
        left_out[CHECKS[kind]["what"]] = problems.get(kind, [])
    left_out["descriptors are not kept, a database takes those of 128 values"] = unkept
    num_images = len(names) - len(rejected)
    return InterchangeReport("imported", num_images, *counts, num_verified, left_out)


@contextmanager
def _matches(
    wanted: _Wanted, features: GivenFile, keys: Mapping[str, str]
) -> Iterator[GivenMatches]:
    """Open the matches that are given, or those that the descriptors of a file make."""
    if wanted.matches_path:
        with given_matches(wanted.matches_path, keys, wanted.image_path) as found:
            yield found
        return
    lacking = [
        name
        for name, key in keys.items()
        if f"{key}/descriptors" not in features.shapes
    ]
    if lacking:
        raise StoreError(
            (
                "has no descriptors to match by (give ",
                Option("matches-path"),
                f"): {such_as(lacking)}",
            ),
            where=features.path,
        )
    names = sorted(keys)
    if wanted.match_list_path:
        pairs: Sequence[Pair] = read_pairs(
            wanted.match_list_path, names, wanted.image_path
        )
    else:
        pairs = exhaustive_pairs(names)

    def read(name: str) -> Arrays:
        points = features.read(f"{keys[name]}/keypoints", (None, 2))
        return points, given_descriptors(features, keys[name], len(points))

    def matched_pairs(_: Mapping[str, int]) -> Iterator[tuple[Pair, Indices]]:
        try:
            for pair, matches in iterate_descriptor_matches(pairs, read):
                yield pair, matches.indices
        except OptionError as error:
            raise StoreError(error, where=features.path) from error

    yield GivenMatches(path=features.path, pairs=tuple(pairs), read=matched_pairs)


def _fill(
    path: Path, features: GivenFile, keys: Mapping[str, str], progress: Progress
) -> list[str]:
    """Write keypoints and descriptors; return the images whose descriptors are not kept."""
    unkept = []
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        images = {image.name: image for image in database.read_all_images()}
        with progress.stage("keypoints", len(keys), "images") as advance:
            for name, key in keys.items():
                _write_keypoints(
                    database=database, image=images[name], source=features, key=key
                )
                if not _keep_descriptors(
                    database, images[name].image_id, features, key
                ):
                    unkept.append(name)
                advance(1)
    return unkept


def _keep_descriptors(
    database: pycolmap.Database, image_id: int, features: GivenFile, key: str
) -> bool:
    """Write descriptors that a database has a place for; tell if none were left out."""
    if f"{key}/descriptors" not in features.shapes:
        return True
    count = database.num_keypoints_for_image(image_id)
    values = given_descriptors(features, key, count)
    if not count:
        return True
    if values.shape[1] != DESCRIPTOR_SIZE or not np.isfinite(values).all():
        return False
    write_descriptors(database, image_id, unit_rows(values))
    return True


def _fill_matches(
    path: Path, given: GivenMatches, wanted: _Wanted, progress: Progress
) -> None:
    with (
        open_database(path) as database,
        pycolmap.DatabaseTransaction(database),
        progress.stage("matches", len(given.pairs), "pairs") as advance,
    ):
        write_given_matches(database, given, wanted.match_type, advance)


def _verified(
    path: Path, wanted: _Wanted, progress: Progress
) -> tuple[tuple[int, int, int], int | None]:
    """Verify, if that is wanted; return numbers of keypoints, pairs, matches; verified pairs."""
    with open_database(path) as database:
        pair_ids, _ = database.read_num_matches()
        counts = (database.num_keypoints(), len(pair_ids), database.num_matches())
    options = wanted.verification
    if options is None:
        return counts, None
    with progress.stage("verify", len(pair_ids), "pairs") as advance:
        verify(path, options, advance=advance)
    return counts, len(verified_pairs(path, options.min_num_inliers))


def _write_keypoints(
    database: pycolmap.Database, image: pycolmap.Image, source: GivenFile, key: str
) -> None:
    """Write the keypoints of an image, if it is as large as the features were found in."""
    name = image.name
    camera = database.read_camera(image.camera_id)
    expected = (camera.width, camera.height)
    require_size(source, key, name, expected)
    keypoints = keypoint_rows(source, key)
    for kind in USELESS_KEYPOINTS.intersection(keypoint_problems(keypoints, expected)):
        check = CHECKS[kind]
        raise StoreError(
            f"{check['what']}: {name}", where=source.path, advice=check["advice"]
        )
    database.write_keypoints(image.image_id, keypoints)


@checks_arguments
def export_h5(
    database_path: PathLike,
    features_path: PathLike,
    matches_path: PathLike,
    *,
    progress: GivenProgress = None,
) -> InterchangeReport:
    """Write features and raw matches of a COLMAP database, which stays as it is, for hloc.

    Features keep their indices. Descriptors are of unit length. Scores, which a database does not
    have, are 1. Of several matches of a keypoint of the first image one is kept.

    Args:
        database_path: the database.
        features_path: HDF5 file to make, of features.
        matches_path: HDF5 file to make, of matches.
        progress: where to show progress.

    Returns:
        Counts, and the names of what was left out.

    Raises:
        OptionError: when a file exists.
        StoreError: for names that hloc's layout cannot hold.
    """
    database_path = as_path(database_path, "database_path")
    features_path = as_path(features_path, "features_path")
    matches_path = as_path(matches_path, "matches_path")
    progress = Progress.given(progress)
    if resolved(features_path) == resolved(matches_path):
        raise OptionError("features and matches need a file each", where=features_path)
    with open_copy(database_path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        known = [image for image in images if database.exists_keypoints(image.image_id)]
        names = [image.name for image in known]
        _check_names(names)
        pair_ids, _ = database.read_num_matches()
        features = (
            (i.name, _feature_datasets(database, i, database_path)) for i in known
        )
        matches = _match_groups(database, known, pair_ids)
        with new_results(features_path, matches_path, names=names) as made:
            with progress.stage("features", len(names), "images") as advance:
                _write_file(
                    new=made[0], path=features_path, groups=features, advance=advance
                )
            with progress.stage("matches", len(pair_ids), "pairs") as advance:
                _write_file(
                    new=made[1], path=matches_path, groups=matches, advance=advance
                )
        counts = (database.num_keypoints(), len(pair_ids), database.num_matches())
    without = [image.name for image in images if image.name not in names]
    left_out = {"images without keypoints are left out": without}
    return InterchangeReport("exported", len(names), *counts, None, left_out)


def _match_groups(
    database: pycolmap.Database,
    images: Sequence[pycolmap.Image],
    pair_ids: Sequence[int],
) -> Iterator[tuple[str, Datasets]]:
    """Yield key and datasets of each pair."""
    names = {image.image_id: image.name for image in images}
    for pair_id in pair_ids:
        id1, id2 = pycolmap.pair_id_to_image_pair(pair_id)
        indices = np.asarray(database.read_matches(id1, id2), np.int64)
        _, one_each = np.unique(indices[:, 0], return_index=True)
        scores = np.ones(len(one_each), np.float32)
        count = database.num_keypoints_for_image(id1)
        pair = PairMatches(
            names=(names[id1], names[id2]),
            indices=indices[one_each],
            scores=scores,
            num_keypoints1=count,
        )
        yield pair_key(*pair.names), hloc_matches(pair)


def _feature_datasets(
    database: pycolmap.Database, image: pycolmap.Image, path: Path
) -> Datasets:
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
        values = read_descriptors(database, image.image_id, len(points), where)
        sift = (
            database.read_descriptors(image.image_id).type
            == pycolmap.FeatureExtractorType.SIFT
        )
        data["descriptors"] = (values / np.float32(DESCRIPTOR_NORM if sift else 1)).T
    return data


def _check_names(names: Sequence[str]) -> None:
    """Refuse image names that the keys of files cannot hold or tell apart."""
    unsafe = [name for name in names if not _is_plain(name)]
    if unsafe:
        raise StoreError(f"names that are no plain relative paths: {such_as(unsafe)}")
    refuse_colliding_keys(names)
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    both = sorted(folders.intersection(names))
    if both:
        raise StoreError(
            "is an image and the folder of another", where=both[0], advice="rename it"
        )


def _is_plain(name: str) -> bool:
    """Tell whether a name is a relative path in its shortest form."""
    return (
        not leads_outside(name)
        and PurePosixPath(name).as_posix() == name
        and "\0" not in name
    )


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
