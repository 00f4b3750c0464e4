"""Features and matches in other programs' HDF5 files, into and out of COLMAP databases.

The layouts that are read and written are in :mod:`.hdf5_layouts`. Names must be those of images
in the folder, and every value is checked before it reaches COLMAP.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    DESCRIPTOR_NORM,
    colmap_keypoints,
    open_database,
    write_matches,
)
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.colmap.initial_cameras import InitialCameras, import_images
from colmap_affrect.colmap.useless_keypoints import left_out, useless, with_places
from colmap_affrect.colmap.verification import VerificationOptions, verified_pairs, verify
from colmap_affrect.conventions import MEASUREMENT_SIGMAS, colmap_from_pixel, pixel_from_colmap
from colmap_affrect.errors import DatabaseError, ImageError, OptionError, StoreError
from colmap_affrect.geometry.arrays import Bools, Singles
from colmap_affrect.images.photographs import CameraOptions, list_images
from colmap_affrect.interop.hdf5_layouts import (
    LAYOUTS,
    Datasets,
    ForeignFiles,
    Source,
    check_names,
    created,
    feature_key,
    keypoints_key,
    listed,
    match_datasets,
    noted,
    one_match_per_keypoint,
    open_files,
)
from colmap_affrect.pairs.base import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.stores import PairMatches, frame_datasets
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.pairs import listed_pairs

PIXEL_ORIGINS = ("center", "corner")


@dataclass(frozen=True)
class InterchangeReport:
    """What was imported or exported.

    Attributes:
        action: ``imported`` or ``exported``.
        layout: of the files, ``hloc`` or ``dim``.
        num_images: images in the database or the file, those without features included.
        num_verified: pairs with a two-view geometry; None where no verification was asked for.
        notes: what was left out, chosen or lost, one line each.
    """

    action: str
    layout: str
    num_images: int
    num_keypoints: int
    num_pairs: int
    num_matches: int
    num_verified: int | None
    notes: tuple[str, ...]

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
    pixel_origin: str = "center",
    skip_verification: bool = False,
    random_seed: int = 0,
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Make a new COLMAP database from the features and matches of another program.

    Keypoints get 6 columns where the file has ``lafs``, 4 where it has ``scales`` and ``oris``,
    else 2. All images of the folder are imported, with or without features. The database, which
    must not be there (OptionError), appears when it is complete; nothing else is written. Files
    that cannot be read, or contradict the photographs or each other, are a StoreError.

    ``layout`` is ``hloc``, ``dim``, or ``auto``: as the matches are stored. ``pixel_origin`` is
    where (0, 0) is, the ``center`` of the first pixel (both programs) or its ``corner``, which is
    COLMAP's. Pairs are verified by :func:`colmap_affrect.colmap.verification.verify` with
    ``random_seed``.
    """
    _check_choice("layout", layout, ("auto", *LAYOUTS))
    _check_choice("pixel_origin", pixel_origin, PIXEL_ORIGINS)
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
        counts, num_matches, unusable = _fill_database(new, files, pixel_origin, progress)
        without = sorted(set(names) - set(rejected) - counts.keys())
        notes = [
            *files.notes,
            *_rounded(files),
            *([unusable] if unusable else []),
            *noted("images without features are there without keypoints", without),
            *noted("images that COLMAP does not take are left out", rejected),
        ]
        num_verified = None
        if not skip_verification:
            options = VerificationOptions(random_seed=random_seed)
            with progress.stage("verify", len(files.pairs), "pairs") as advance:
                verify(new, options, advance=advance)
            num_verified = len(verified_pairs(new, options.min_num_inliers))
    return InterchangeReport(
        "imported", files.layout, len(names) - len(rejected), sum(counts.values()),
        len(files.pairs), num_matches, num_verified, tuple(notes),
    )  # fmt: skip


def _rounded(files: ForeignFiles) -> list[str]:
    """Say how far apart coordinates in float16 are, as deep-image-matching may write them."""
    keys = [keypoints_key(files.features, key) for key in files.keys.values()]
    half = [key for key in keys if files.features.file[key].dtype == np.float16]
    if not half:
        return []
    values = (files.features.read(key, (None, 2)) for key in half)
    largest = max(found[np.isfinite(found)].max(initial=0) for found in values)
    return [f"keypoints of {len(half)} images are float16, rounded to steps of "
            f"{np.spacing(np.float16(largest)):g} px"]  # fmt: skip


def _fill_database(
    path: Path, files: ForeignFiles, pixel_origin: str, progress: Progress
) -> tuple[dict[str, int], int, str]:
    """Write keypoints and matches; return the keypoints of each image, and how many matches.

    Keypoints that no model can use are left out; the last value says which.
    """
    counts, num_matches, num_lost, masks = {}, 0, 0, dict[str, Bools]()
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        images = {image.name: image for image in database.read_all_images()}
        with progress.stage("keypoints", len(files.keys), "images") as advance:
            for name, key in files.keys.items():
                camera = database.read_camera(images[name].camera_id)
                files.check_size(name, (camera.width, camera.height))
                keypoints = _read_keypoints(files.features, key, pixel_origin)
                if found := useless(keypoints, (camera.width, camera.height)):
                    masks[name] = np.logical_or.reduce(list(found.values()))
                database.write_keypoints(images[name].image_id, with_places(keypoints))
                counts[name] = len(keypoints)
                advance(1)
        with progress.stage("matches", len(files.pairs), "pairs") as advance:
            for pair in files.pairs:
                indices = files.read_indices(pair, counts[pair[0]])
                _check_range(files.matches.path, pair, indices, counts)
                id1, id2 = (images[name].image_id for name in pair)
                usable = np.ones(len(indices), np.bool_)
                for name, column in zip(pair, indices.T, strict=True):
                    if name in masks:
                        usable &= ~masks[name][column]
                write_matches(database, id1, id2, indices[usable])
                num_matches += int(usable.sum())
                num_lost += int((~usable).sum())
                advance(1)
    return counts, num_matches, left_out(masks, num_lost)


def export_h5(
    features_path: Path,
    matches_path: Path,
    *,
    output_path: Path | None = None,
    database_path: Path | None = None,
    layout: str = "hloc",
    half: bool = False,
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Write features and raw matches of an output folder of ours or a database.

    Features keep their indices. ``scales`` and ``oris`` are those of hloc: sigma in px, and degrees
    from x towards y. Descriptors are of unit length. Scores, which a database does not have, are 1
    then. The database is copied first and stays as it is.

    ``layout`` is ``hloc`` or ``dim``; with ``half`` all real numbers are float16, coordinates too.
    Raises OptionError when a file exists, StoreError when it cannot be written, or its layout
    cannot hold the content, DatabaseError when the database cannot be used.
    """
    _check_choice("layout", layout, LAYOUTS)
    if features_path.resolve() == matches_path.resolve():
        raise StoreError(f"{features_path}: features and matches need a file each")
    photographs = output_path and Workspace(output_path).photographs()
    counts: dict[str, int] = {}
    num_matches, num_lost = 0, 0
    with _content(output_path, database_path) as content:
        check_names(content.names, layout)
        targets, names = (features_path, matches_path), content.names
        with (
            new_results(*targets, photographs=photographs, names=names) as (new, new_matches),
            created(new, features_path) as features,
            created(new_matches, matches_path) as matches,
        ):
            with progress.stage("features", len(content.names), "images") as advance:
                for name in content.names:
                    size, data = content.features(name)
                    if half:
                        data = {key: values.astype(np.float16) for key, values in data.items()}
                    data["image_size"] = np.asarray(size if layout == "hloc" else size[::-1])
                    features.write(feature_key(name, layout), data)
                    counts[name] = len(data["keypoints"])
                    advance(1)
            with progress.stage("matches", content.num_pairs, "pairs") as advance:
                for pair in content.matches():
                    _check_range(content.where, pair.names, pair.indices, counts)
                    written = one_match_per_keypoint(pair) if layout == "hloc" else pair
                    matches.write(*match_datasets(written, layout))
                    num_matches += len(written.indices)
                    num_lost += len(pair.indices) - len(written.indices)
                    advance(1)
    notes = list(content.notes)
    if num_lost:
        notes.append(f"{num_lost} matches are left out: hloc's files hold one of each keypoint")
    if half:
        notes.append("coordinates are rounded: float16 has steps of 1 px from 1024 px on")
    return InterchangeReport(
        "exported", layout, len(counts), sum(counts.values()), content.num_pairs, num_matches,
        None, tuple(notes),
    )  # fmt: skip


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise OptionError(f"{name} {value!r}: not one of {', '.join(choices)}")


def _check_range(
    where: object, pair: Pair, indices: NDArray[np.integer], counts: Mapping[str, int]
) -> None:
    for name, column in zip(pair, indices.T, strict=True):
        wrong = column[(column < 0) | (column >= counts.get(name, 0))]
        if len(wrong):
            raise StoreError(
                f"{where}: the matches of {pair[0]} and {pair[1]} point at keypoint {wrong[0]} of "
                f"{name}, which has {counts.get(name, 0)}; match them again"
            )


def _read_keypoints(source: Source, key: str, pixel_origin: str) -> Singles:
    """Return the (N, 2), (N, 4) or (N, 6) keypoints of an image as COLMAP stores them."""
    path = keypoints_key(source, key)
    lafs, scales, oris = (f"{key}/{name}" for name in ("lafs", "scales", "oris"))
    with np.errstate(over="ignore"):  # what float32 cannot hold is left out
        points = source.read(path, (None, 2)).astype(np.float32)
        centers = colmap_from_pixel(points) if pixel_origin == "center" else points
        count = len(points)
        keypoints = np.asarray(centers)
        if lafs in source.shapes:
            frames = source.read(lafs, (count, 2, 3)).astype(np.float64)
            keypoints = np.column_stack([centers, colmap_keypoints(frames)[:, 2:]])
        elif {scales, oris} <= source.shapes.keys():
            sigmas = source.read(scales, (count,)).astype(np.float32)
            if (sigmas < 0).any():
                raise StoreError(f"{source.path}: {scales} holds negative values")
            angles = np.deg2rad(source.read(oris, (count,)).astype(np.float32))
            keypoints = np.column_stack([centers, sigmas, angles])
    return keypoints


class _WorkspaceContent:
    """Features and matches of an output folder, to be exported."""

    def __init__(self, workspace: Workspace) -> None:
        self.where = str(workspace.path)
        context = Context(workspace)
        self._features, self._matches = context.features, context.matches
        self._sizes = self._features.image_sizes()
        self._pairs = listed_pairs(context)
        self.names, self.num_pairs = sorted(self._sizes), len(self._pairs)
        self.notes: list[str] = []

    def features(self, name: str) -> tuple[tuple[int, int], Datasets]:
        found = self._features.read(name)
        data: Datasets = {
            "keypoints": found.keypoints.astype(np.float32),
            "descriptors": found.descriptors.T,
            "scores": found.responses,
        }
        return self._sizes[name], data | frame_datasets(found.lafs)

    def matches(self) -> Iterator[PairMatches]:
        return self._matches.read(self._pairs) if self._pairs else iter(())


class _DatabaseContent:
    """Features and matches of a COLMAP database; its members are those of an output folder's."""

    def __init__(self, database: pycolmap.Database, where: str) -> None:
        self.where = where
        self._database = database
        self._images = {image.name: image for image in database.read_all_images()}
        found = {n for n, i in self._images.items() if database.exists_keypoints(i.image_id)}
        pair_ids, _ = database.read_num_matches()
        self._pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
        self.names, self.num_pairs = sorted(found), len(self._pairs)
        self.notes = noted(
            "images without keypoints are left out", sorted(set(self._images) - found)
        )

    def features(self, name: str) -> tuple[tuple[int, int], Datasets]:
        image = self._images[name]
        camera = self._database.read_camera(image.camera_id)
        keypoints = np.asarray(self._database.read_keypoints(image.image_id), np.float32)
        points = np.asarray(pixel_from_colmap(keypoints[:, :2]))
        data: Datasets = {"keypoints": points, "scores": np.ones(len(points), np.float32)}
        columns = keypoints.shape[1]
        if columns == 6:
            shapes = keypoints[:, 2:].reshape(-1, 2, 2) * np.float32(MEASUREMENT_SIGMAS)
            data |= frame_datasets(np.concatenate([shapes, points[:, :, None]], axis=2))
        elif columns == 4:
            data |= {"scales": keypoints[:, 2], "oris": np.rad2deg(keypoints[:, 3])}
        if self._database.exists_descriptors(image.image_id):
            data["descriptors"] = self._descriptors(name, len(points)).T
        return (camera.width, camera.height), data

    def _descriptors(self, name: str, count: int) -> Singles:
        found = self._database.read_descriptors(self._images[name].image_id)
        if len(found.data) != count:
            raise DatabaseError(
                f"{self.where}: {name} has {count} keypoints and {len(found.data)} descriptors"
            )
        try:
            values = np.asarray(found.to_float().data, np.float32)
        except ValueError as error:
            raise DatabaseError(f"{self.where}: {name} has descriptors of no known type") from error
        sift = found.type == pycolmap.FeatureExtractorType.SIFT
        return values / np.float32(DESCRIPTOR_NORM if sift else 1)

    def matches(self) -> Iterator[PairMatches]:
        names = {image.image_id: name for name, image in self._images.items()}
        for id1, id2 in self._pairs:
            if not {id1, id2} <= names.keys():
                raise DatabaseError(f"{self.where}: has matches of images that are not in it")
            indices = np.asarray(self._database.read_matches(id1, id2), np.int64)
            count = self._database.num_keypoints_for_image(id1)
            scores = np.ones(len(indices), np.float32)
            yield PairMatches((names[id1], names[id2]), indices, scores, count)


@contextmanager
def _content(
    output_path: Path | None, database_path: Path | None
) -> Iterator[_WorkspaceContent | _DatabaseContent]:
    if output_path is not None and database_path is None:
        workspace = Workspace(output_path)
        workspace.require("match")
        with workspace.locked_or_read_only():
            yield _WorkspaceContent(workspace)
    elif database_path is not None and output_path is None:
        with open_copy(database_path) as database:
            yield _DatabaseContent(database, str(database_path))
    else:
        raise OptionError("give either an output folder or a database")
