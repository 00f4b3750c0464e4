"""Matches by descriptors of other programs: of arrays, files, and databases; given ones, too.

What a run matches are its own features (:mod:`colmap_affrect.stages.match`). Here nothing is known
of an image but where its keypoints are, and their descriptors.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import CHECKS, keypoint_problems
from colmap_affrect.data import LocalFeatures
from colmap_affrect.errors import DatabaseError, OptionError, StoreError
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.arrays import Floats, Singles
from colmap_affrect.geometry.conventions import pixel_from_colmap
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext, Matches
from colmap_affrect.matchers.nearest import NearestNeighbors, NearestOptions
from colmap_affrect.pairs.given_matches import GivenMatches, MatchType
from colmap_affrect.pairs.lists import Pair, exhaustive_pairs, ordered_for_reuse
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import SILENT, GivenProgress, Progress
from colmap_affrect.project.argument_types import checks_arguments

# Values of the one kind of descriptors that whole numbers stand for; COLMAP's
SIFT_SIZE = 128
IMAGES_IN_MEMORY = 60  # resource
USUAL_FEATURES = 8000  # of an image, to tell how much there is to compare; resource

Arrays = tuple[Floats, Any]
"""(N, 2) keypoints in px, and the (N, D) descriptors of an image."""


def match_descriptors(
    keypoints1: Floats,
    descriptors1: Any,
    keypoints2: Floats,
    descriptors2: Any,
    options: NearestOptions | None = None,
) -> Matches:
    """Match the features of two images that any program has found.

    Args:
        keypoints1: (N1, 2) places in the first image in px, with any origin.
        descriptors1: (N1, D) floats, or whole numbers of SIFT with D = 128.
        keypoints2: (N2, 2) places in the second image in px.
        descriptors2: (N2, D) of the same kind.
        options: of the matcher, mutual nearest neighbours with a ratio test.

    Returns:
        Matches with ``indices`` (M, 2), rising in the first column, and ``scores`` (M,).

    Raises:
        OptionError: for arrays that do not fit.
    """
    sets = {
        "image 1": (keypoints1, descriptors1),
        "image 2": (keypoints2, descriptors2),
    }
    pair = ("image 1", "image 2")
    found = match_feature_sets(sets, pairs=[pair], options=options, progress=False)
    return found[pair]


@checks_arguments
def match_feature_sets(
    features: Mapping[str, Arrays],
    pairs: Iterable[Pair] | None = None,
    options: NearestOptions | None = None,
    *,
    progress: GivenProgress = None,
) -> dict[Pair, Matches]:
    """Match the features of several images that any program has found.

    Args:
        features: keypoints (N, 2) in px and descriptors (N, D) of each image, by its name.
        pairs: names of the images to match; None: all pairs.
        options: of the matcher, mutual nearest neighbours with a ratio test.
        progress: True, False, or None for where somebody looks at it.

    Returns:
        Matches by pair, see :func:`match_descriptors`.

    Raises:
        OptionError: for arrays that do not fit, or pairs of other images.
    """
    if pairs is None:
        listed = exhaustive_pairs(list(features))
    else:
        listed = list(map(_two, pairs))
    unknown = set().union(*listed).difference(features)
    if unknown:
        raise OptionError("is in a pair, and has no features", where=min(unknown))
    found = dict[Pair, Matches]()
    with Progress.given(progress).stage("match", len(listed), "pairs") as advance:
        matched = iterate_descriptor_matches(
            listed, lambda name: features[name], options
        )
        for pair, matches in matched:
            found[pair] = matches
            advance(1)
    return found


def iterate_descriptor_matches(
    pairs: Sequence[Pair],
    read: Callable[[str], Arrays],
    options: NearestOptions | None = None,
) -> Iterator[tuple[Pair, Matches]]:
    """Yield the matches of pairs; the arrays of images are read in the calling thread.

    Args:
        pairs: names of images.
        read: returns (N, 2) keypoints and (N, D) descriptors of an image.
        options: of the matcher.
    """
    matcher = NearestNeighbors(
        options or NearestOptions(),
        MatcherContext(num_comparisons=len(pairs) * USUAL_FEATURES**2),
    )
    sizes = dict[int, str]()

    @lru_cache(maxsize=IMAGES_IN_MEMORY)
    def prepared(name: str) -> Any:
        image = _as_features(name, read(name))
        sizes.setdefault(image.features.descriptors.shape[1], name)
        if len(sizes) > 1:
            first, second = sizes.items()
            raise OptionError(
                f"{first[1]} has descriptors of {first[0]} values and {second[1]} of "
                f"{second[0]}",
                advice="match images of one kind of features",
            )
        return matcher.prepare(image)

    ordered = list(ordered_for_reuse(pairs, IMAGES_IN_MEMORY // 2))
    found = map_ordered(
        lambda both: matcher.match(*both),
        tasks=((prepared(first), prepared(second)) for first, second in ordered),
        num_threads=available_cores(),
    )
    yield from zip(ordered, found, strict=True)


def _two(pair: Iterable[str]) -> Pair:
    names = tuple(pair)
    if len(names) != 2:
        raise OptionError(f"{names!r} is not two names of images", where="pairs")
    return names


def _as_features(name: str, given: Arrays) -> ImageFeatures:
    """Check the arrays of an image, and return them as a matcher takes them."""
    try:
        points, rows = map(_as_array, given)
    except (TypeError, ValueError, RuntimeError) as error:  # numpy's, torch's, or not 2
        why = " ".join(str(error).split())
        raise OptionError(
            f"give keypoints and descriptors as two arrays ({why})", where=name
        ) from error
    _check_arrays(name, points, rows)
    unit = unit_rows(rows)
    if not np.isfinite(unit).all():
        raise OptionError("descriptors are not finite", where=name)
    places = points[:, :2].astype(np.float64)
    for kind in keypoint_problems(places, None):
        check = CHECKS[kind]
        fault = f"{check['what']}: {name}"
        raise OptionError(fault, advice=check["advice"])
    count = len(places)
    lafs = lafs_from_keypoints(
        places, radii_px=np.ones(count), angles_rad=np.zeros(count)
    )
    features = LocalFeatures(
        lafs=lafs, responses=np.ones(count, np.float32), descriptors=unit
    )
    return ImageFeatures(features=features, image_size=(0, 0), extractor="")


def _check_arrays(name: str, points: NDArray[Any], rows: NDArray[Any]) -> None:
    """Refuse arrays that cannot be keypoints and descriptors of an image; OptionError."""
    are_points = points.ndim == 2 and points.shape[1] >= 2
    if not are_points or rows.ndim != 2 or len(rows) != len(points):
        raise OptionError(
            f"keypoints {points.shape} and descriptors {rows.shape} do not fit",
            where=name,
            advice="give (N, 2) places and (N, D) descriptors",
        )
    if points.dtype.kind not in "fiu":
        raise OptionError(
            f"keypoints are {points.dtype}", where=name, advice="give numbers of px"
        )
    is_sift = rows.dtype.kind in "iu" and rows.shape[1] == SIFT_SIZE
    if rows.dtype.kind != "f" and not is_sift:
        raise OptionError(
            f"descriptors are {rows.dtype} of {rows.shape[1]} values",
            where=name,
            advice="whole numbers are taken for SIFT of 128 values, of others give floats "
            "(of bits -1.0 and 1.0)",
        )


def _as_array(given: Any) -> NDArray[Any]:
    """Return an array; ValueError where some of its values are masked."""
    if np.ma.is_masked(given):
        raise ValueError("some values are masked")
    return np.asarray(given)


def unit_rows(descriptors: Floats) -> Singles:
    """Return (N, D) descriptors of unit length; those of length 0 stay, and match nothing."""
    exact = descriptors.astype(np.float64)
    with np.errstate(all="ignore"):  # what is not finite stays so
        _, exponents = np.frexp(np.abs(exact).max(axis=1, keepdims=True, initial=0.0))
        # Squares of these are neither 0 nor infinity.
        rows = np.ldexp(exact, -exponents).astype(np.float32)
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        return np.asarray(rows / np.maximum(lengths, np.finfo(np.float32).tiny))


def described_images(path: Path) -> list[str]:
    """Return the sorted names of the images of a database that have descriptors."""
    with colmap_database.open_database(path) as database:
        return sorted(
            image.name
            for image in database.read_all_images()
            if database.num_descriptors_for_image(image.image_id)
        )


def match_database(
    path: Path,
    pairs: Iterable[Pair] | None = None,
    options: NearestOptions | None = None,
    *,
    progress: Progress = SILENT,
) -> int:
    """Match images of a database by the descriptors in it, and write the raw matches into it.

    Args:
        path: database of COLMAP, which is changed.
        pairs: names of the images to match; None: all pairs. Those that are on record are passed
            over.
        options: of the matcher, mutual nearest neighbours with a ratio test.
        progress: where to show progress.

    Returns:
        How many pairs were matched.

    Raises:
        DatabaseError: when descriptors do not fit keypoints, or are of different kinds.
    """
    names = described_images(path)
    listed = exhaustive_pairs(names) if pairs is None else list(pairs)
    known = set(names)
    with colmap_database.open_database(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        todo = _unmatched(
            database, pairs=[p for p in listed if known.issuperset(p)], ids=ids
        )

        def read(name: str) -> Arrays:
            return _read_arrays(database, image_id=ids[name], where=f"{path}: {name}")

        with progress.stage("match", len(todo), "pairs") as advance:
            try:
                for (first, second), found in iterate_descriptor_matches(
                    todo, read, options
                ):
                    colmap_database.write_matches(
                        database, ids[first], ids[second], found.indices
                    )
                    advance(1)
            except OptionError as error:
                raise DatabaseError(error, where=path) from error
    return len(todo)


def _unmatched(
    database: pycolmap.Database, pairs: Sequence[Pair], ids: Mapping[str, int]
) -> list[Pair]:
    """Return the pairs of which no matches are on record, not even none."""
    ids_of_pairs = [(ids[first], ids[second]) for first, second in pairs]
    numbers = np.array(ids_of_pairs, np.int64).reshape(-1, 2)
    lacking = colmap_database.lack_matches(database, numbers)
    return [pairs[row] for row in np.flatnonzero(lacking).tolist()]


def _read_arrays(database: pycolmap.Database, image_id: int, where: str) -> Arrays:
    """Return the keypoints, in pixel-centre px, and the descriptors of an image."""
    points = np.asarray(database.read_keypoints(image_id), np.float64)[:, :2]
    values = colmap_database.read_descriptors(
        database, image_id, num_keypoints=len(points), where=where
    )
    return np.asarray(pixel_from_colmap(points)), values


def write_given_matches(
    database: pycolmap.Database,
    given: GivenMatches,
    match_type: MatchType,
    advance: Callable[[int], None],
) -> None:
    """Write matches into a database; inliers as two-view geometries, too.

    Args:
        database: with the keypoints that the matches are of.
        given: the matches.
        match_type: what they are.
        advance: called with the number of pairs written.

    Raises:
        StoreError: when a match points at no keypoint.
    """
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    ids = dict[str, int]()
    counts = dict[str, int]()
    are_calibrated = dict[str, bool]()
    for image in database.read_all_images():
        ids[image.name] = image.image_id
        counts[image.name] = database.num_keypoints_for_image(image.image_id)
        is_calibrated = cameras[image.camera_id].has_prior_focal_length
        are_calibrated[image.name] = is_calibrated
    kinds = pycolmap.TwoViewGeometryConfiguration
    for (first, second), indices in given.read(counts):
        try:
            colmap_database.write_matches(database, ids[first], ids[second], indices)
        except DatabaseError as error:
            raise StoreError(f"{first}, {second}: {error}", where=given.path) from error
        if match_type == "inliers":
            is_calibrated = are_calibrated[first] and are_calibrated[second]
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = kinds.CALIBRATED if is_calibrated else kinds.UNCALIBRATED
            geometry.inlier_matches = indices.astype(np.uint32)
            database.write_two_view_geometry(ids[first], ids[second], geometry)
        advance(1)
