"""Features and matches in other programs' HDF5 files, into and out of COLMAP databases."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import CHECKS, USELESS_KEYPOINTS, keypoint_problems
from colmap_affrect.colmap.database import (
    DESCRIPTOR_NORM,
    colmap_keypoints,
    open_database,
    write_matches,
)
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.colmap.initial_cameras import InitialCameras, import_images
from colmap_affrect.colmap.verification import VerificationOptions, verified_pairs, verify
from colmap_affrect.errors import DatabaseError, ImageError, OptionError, StoreError
from colmap_affrect.geometry.arrays import Indices, Singles
from colmap_affrect.geometry.conventions import (
    MEASUREMENT_SIGMAS,
    colmap_from_pixel,
    pixel_from_colmap,
)
from colmap_affrect.images.photographs import CameraOptions, list_images
from colmap_affrect.interop.hdf5_layouts import (
    LAYOUTS,
    Datasets,
    ForeignFiles,
    check_names,
    created,
    listed,
    noted,
    open_files,
)
from colmap_affrect.pairs.base import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.stores import PairMatches, frame_datasets
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.pairs import listed_pairs


@dataclass(frozen=True)
class InterchangeReport:
    """What was imported or exported."""

    action: str  # ``imported`` or ``exported``
    layout: str  # of the files, ``hloc`` or ``dim``
    num_images: int  # in the database or the file, also those without features
    num_keypoints: int
    num_pairs: int
    num_matches: int
    num_verified: int | None  # pairs with a two-view geometry; None if not asked for
    notes: tuple[str, ...]  # what was left out, one line each

    def summary(self) -> str:
        """Return a line of numbers, and one for each note."""
        verified = "" if self.num_verified is None else f", {self.num_verified} verified"
        counts = (
            f"{self.action} ({self.layout}): {self.num_images} images, "
            f"{self.num_keypoints} keypoints, {self.num_pairs} pairs{verified}, "
            f"{self.num_matches} matches"
        )
        return "\n".join([counts, *(f"note: {note}" for note in self.notes)])


def import_h5(
    image_path: Path,
    features_path: Path,
    matches_path: Path,
    database_path: Path,
    *,
    cameras: CameraOptions | None = None,
    layout: str = "auto",
    skip_verification: bool = False,
    random_seed: int = 0,
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Make a new COLMAP database from the features and matches of another program.

    Keypoints get 6 columns where the file has ``lafs``, 4 where it has ``scales`` and ``oris``,
    else 2. All images of the folder are imported, with or without features. ``layout`` is ``hloc``,
    ``dim``, or ``auto``: as the matches are stored. ``random_seed`` is that of verification.

    Raises OptionError when the database exists, StoreError for files that cannot be read, or
    contradict the photographs or each other.
    """
    _check_layout(layout, ("auto", *LAYOUTS))
    cameras = cameras or CameraOptions()
    names = list_images(image_path)
    InitialCameras(image_path, cameras).check(names)
    with (
        # Verification may take hours, and half a database must not be left behind.
        new_results(database_path, photographs=image_path) as (new,),
        open_files(features_path, matches_path, layout, names, image_path) as files,
    ):
        rejected = import_images(new, image_path, names, cameras)
        if lost := sorted(files.keys.keys() & set(rejected)):
            raise ImageError(
                f"{image_path}: COLMAP does not take (damaged, or of another size than camera "
                f"mode {cameras.mode} allows): {listed(lost)}"
            )
        _fill_database(new, files, progress)
        with open_database(new) as database:
            counts = database.num_keypoints(), len(files.pairs), database.num_matches()
        without = sorted(set(names) - set(rejected) - files.keys.keys())
        notes = [
            *files.notes,
            *noted("images without features are there without keypoints", without),
            *noted("images that COLMAP does not take are left out", rejected),
        ]
        num_verified = None
        if not skip_verification:
            options = VerificationOptions(random_seed=random_seed)
            with progress.stage("verify", len(files.pairs), "pairs") as advance:
                verify(new, options, advance=advance)
            num_verified = len(verified_pairs(new, options.min_num_inliers))
    num_images = len(names) - len(rejected)
    return InterchangeReport(
        "imported", files.layout.name, num_images, *counts, num_verified, tuple(notes)
    )


def _fill_database(path: Path, files: ForeignFiles, progress: Progress) -> None:
    """Write keypoints and matches of images that the database has."""
    counts: dict[str, int] = {}
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        images = {image.name: image for image in database.read_all_images()}
        with progress.stage("keypoints", len(files.keys), "images") as advance:
            for name in files.keys:
                camera = database.read_camera(images[name].camera_id)
                files.check_size(name, (camera.width, camera.height))
                keypoints = _read_keypoints(files, name)
                for kind in USELESS_KEYPOINTS.intersection(keypoint_problems(keypoints, None)):
                    raise StoreError(f"{files.features.path}: {CHECKS[kind][1]}: {name}")
                database.write_keypoints(images[name].image_id, keypoints)
                counts[name] = len(keypoints)
                advance(1)
        with progress.stage("matches", len(files.pairs), "pairs") as advance:
            for pair in files.pairs:
                indices = files.read_indices(pair, counts[pair[0]])
                _require_in_range(files.matches.path, pair, indices, counts)
                id1, id2 = (images[name].image_id for name in pair)
                write_matches(database, id1, id2, indices)
                advance(1)


def _require_in_range(path: Path, pair: Pair, indices: Indices, counts: Mapping[str, int]) -> None:
    for name, column in zip(pair, indices.T, strict=True):
        wrong = column[(column < 0) | (column >= counts[name])]
        if len(wrong):
            raise StoreError(
                f"{path}: the matches of {pair[0]} and {pair[1]} point at keypoint {wrong[0]} of "
                f"{name}, which has {counts[name]}; match them again"
            )


def _read_keypoints(files: ForeignFiles, name: str) -> Singles:
    """Return the (N, 2), (N, 4) or (N, 6) keypoints of an image as COLMAP stores them."""
    source, key = files.features, files.keys[name]
    lafs, scales, oris = (f"{key}/{dataset}" for dataset in ("lafs", "scales", "oris"))
    with np.errstate(over="ignore"):  # what float32 cannot hold is refused later
        points = source.read(files.keypoints_key(name), (None, 2)).astype(np.float32)
        centers = np.asarray(colmap_from_pixel(points))
        count = len(points)
        if lafs in source.shapes:
            frames = source.read(lafs, (count, 2, 3)).astype(np.float64)
            return np.column_stack([centers, colmap_keypoints(frames)[:, 2:]])
        if not {scales, oris} <= source.shapes.keys():
            return centers
        sigmas = source.read(scales, (count,)).astype(np.float32)
        if (sigmas < 0).any():
            raise StoreError(f"{source.path}: {scales} holds negative values")
        angles = np.deg2rad(source.read(oris, (count,)).astype(np.float32))
        return np.column_stack([centers, sigmas, angles])


def export_h5(
    features_path: Path,
    matches_path: Path,
    *,
    output_path: Path | None = None,
    database_path: Path | None = None,
    layout: str = "hloc",
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Write features and raw matches of an output folder or a database, which stay as they are.

    Features keep their indices. Descriptors are of unit length. Scores, which a database does not
    have, are 1. ``layout`` is ``hloc`` or ``dim``. Raises OptionError when a file exists,
    StoreError when the layout cannot hold the content.
    """
    _check_layout(layout, tuple(LAYOUTS))
    if features_path.resolve() == matches_path.resolve():
        raise StoreError(f"{features_path}: features and matches need a file each")
    photographs = output_path and Workspace(output_path).photographs()
    form = LAYOUTS[layout]
    num_keypoints = num_matches = num_lost = 0
    with _content(output_path, database_path) as content:
        names = content.names
        check_names(names, form)
        targets = features_path, matches_path
        with new_results(*targets, photographs=photographs, names=names) as (new, new_matches):
            with (
                created(new, features_path) as write,
                progress.stage("features", len(names), "images") as advance,
            ):
                for name in names:
                    size, data = content.features(name)
                    data["image_size"] = np.asarray(size)[:: form.size_step]
                    write(form.feature_key(name), data)
                    num_keypoints += len(data["keypoints"])
                    advance(1)
            with (
                created(new_matches, matches_path) as write,
                progress.stage("matches", content.num_pairs, "pairs") as advance,
            ):
                for pair in content.matches():
                    num_written = form.write_matches(write, pair)
                    num_matches += num_written
                    num_lost += len(pair.indices) - num_written
                    advance(1)
    notes = list(content.notes)
    if num_lost:
        notes.append(f"{num_lost} matches are left out: hloc's files hold one of each keypoint")
    return InterchangeReport(
        "exported", layout, len(names), num_keypoints, content.num_pairs, num_matches,
        None, tuple(notes),
    )  # fmt: skip


def _check_layout(layout: str, choices: Sequence[str]) -> None:
    if layout not in choices:
        raise OptionError(f"layout {layout!r}: not one of {', '.join(choices)}")


@dataclass(frozen=True)
class _Content:
    """Features and matches to be exported."""

    names: list[str]
    num_pairs: int
    features: Callable[[str], tuple[tuple[int, int], Datasets]]  # (width, height), and datasets
    matches: Callable[[], Iterator[PairMatches]]
    notes: list[str]


@contextmanager
def _content(output_path: Path | None, database_path: Path | None) -> Iterator[_Content]:
    if output_path is not None and database_path is None:
        workspace = Workspace(output_path)
        workspace.require("match")
        with workspace.locked_or_read_only():
            yield _content_of_folder(workspace)
    elif database_path is not None and output_path is None:
        with open_copy(database_path) as database:
            yield _content_of_database(database, database_path)
    else:
        raise OptionError("give either an output folder or a database")


def _content_of_folder(workspace: Workspace) -> _Content:
    context = Context(workspace)
    sizes, pairs = context.features.image_sizes(), listed_pairs(context)

    def features(name: str) -> tuple[tuple[int, int], Datasets]:
        stored = context.features.read(name)
        data: Datasets = {
            "keypoints": stored.keypoints.astype(np.float32),
            "descriptors": stored.descriptors.T,
            "scores": stored.responses,
        }
        return sizes[name], data | frame_datasets(stored.lafs)

    def matches() -> Iterator[PairMatches]:
        return context.matches.read(pairs) if pairs else iter(())

    return _Content(sorted(sizes), len(pairs), features, matches, [])


def _content_of_database(database: pycolmap.Database, path: Path) -> _Content:
    images = {image.name: image for image in database.read_all_images()}
    known = {n for n, image in images.items() if database.exists_keypoints(image.image_id)}
    pairs = list(map(pycolmap.pair_id_to_image_pair, database.read_num_matches()[0]))

    def features(name: str) -> tuple[tuple[int, int], Datasets]:
        image = images[name]
        camera = database.read_camera(image.camera_id)
        keypoints = np.asarray(database.read_keypoints(image.image_id), np.float32)
        points = np.asarray(pixel_from_colmap(keypoints[:, :2]))
        data: Datasets = {"keypoints": points, "scores": np.ones(len(points), np.float32)}
        if keypoints.shape[1] == 6:
            shapes = keypoints[:, 2:].reshape(-1, 2, 2) * np.float32(MEASUREMENT_SIGMAS)
            data |= frame_datasets(np.concatenate([shapes, points[:, :, None]], axis=2))
        elif keypoints.shape[1] == 4:
            data |= {"scales": keypoints[:, 2], "oris": np.rad2deg(keypoints[:, 3])}
        if database.exists_descriptors(image.image_id):
            descriptors = database.read_descriptors(image.image_id)
            data["descriptors"] = _real(descriptors, len(points), f"{path}: {name}").T
        return (camera.width, camera.height), data

    def matches() -> Iterator[PairMatches]:
        names = {image.image_id: name for name, image in images.items()}
        for id1, id2 in pairs:
            indices = np.asarray(database.read_matches(id1, id2), np.int64)
            count = database.num_keypoints_for_image(id1)
            scores = np.ones(len(indices), np.float32)
            yield PairMatches((names[id1], names[id2]), indices, scores, count)

    notes = noted("images without keypoints are left out", sorted(images.keys() - known))
    return _Content(sorted(known), len(pairs), features, matches, notes)


def _real(descriptors: pycolmap.FeatureDescriptors, count: int, where: str) -> Singles:
    """Return (N, D) descriptors of unit length; DatabaseError unless there are ``count``."""
    if len(descriptors.data) != count:
        raise DatabaseError(
            f"{where} has {count} keypoints and {len(descriptors.data)} descriptors"
        )
    try:
        values = np.asarray(descriptors.to_float().data, np.float32)
    except ValueError as error:
        raise DatabaseError(f"{where} has descriptors of no known type") from error
    sift = descriptors.type == pycolmap.FeatureExtractorType.SIFT
    return values / np.float32(DESCRIPTOR_NORM if sift else 1)
