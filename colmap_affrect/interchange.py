"""Features and matches in other programs' HDF5 files, into and out of COLMAP databases.

Three layouts are read, two are written; in all of them (0, 0) is the centre of the first pixel.

``hloc``
    Features: a group per image name, nested at '/', with ``keypoints`` (N, 2), ``descriptors``
    (D, N), ``scores`` (N,), ``image_size`` (width, height), and perhaps ``scales`` (N,) in sigmas,
    ``oris`` (N,) in degrees from x towards y, ``lafs`` (N, 2, 3). Matches: a group per pair with
    ``matches0`` (N0,), -1 where unmatched, and ``matching_scores0`` (N0,); in its key each '/'
    of a name is '-', and '/' stands between the names ('_' in old files).
``dim`` (deep-image-matching)
    The same features by file name without folders, ``image_size`` as (height, width); matches
    [name 1][name 2] (M, 2). Also read without groups, as in the notebooks of the Image Matching
    Challenge: keypoints [name] (N, 2) and matches.

Files of others are not trusted: links and data in other files are refused, names must be those of
images in the folder, and every value is checked before it reaches COLMAP.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.copies import open_copy
from colmap_affrect.colmap.database import (
    DESCRIPTOR_NORM,
    check_cameras,
    colmap_keypoints,
    import_images,
    open_database,
    write_matches,
)
from colmap_affrect.colmap.verification import verified_pairs, verify
from colmap_affrect.conventions import MEASUREMENT_SIGMAS, colmap_from_pixel, pixel_from_colmap
from colmap_affrect.errors import DatabaseError, ImageError, OptionError, StoreError
from colmap_affrect.files import require_space
from colmap_affrect.matching.pairs import Pair
from colmap_affrect.options import CameraOptions, VerificationOptions
from colmap_affrect.photographs import list_images, refuse_colliding_keys
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.stages import feature_store, listed_pairs, match_store
from colmap_affrect.store import PairMatches, hloc_matches, pair_key
from colmap_affrect.workspace import Workspace

LAYOUTS = ("hloc", "dim")
PIXEL_ORIGINS = ("center", "corner")

MAX_VALUES = 1 << 28
"""More than this in one array is taken for damage, and not read."""

MAX_NAMES_IN_MESSAGE = 10

SPARE_BYTES = 8 << 20
"""What HDF5 may need beside the data that it is given: its index, and what it has not written."""

KEYPOINTS, HLOC_MATCHES = "/keypoints", "/matches0"

UNREADABLE = (OSError, RuntimeError, KeyError, ValueError, TypeError, SystemError)
"""What h5py raises for a damaged file."""


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
    verification: VerificationOptions | None = None,
    skip_verification: bool = False,
    random_seed: int = 0,
    progress: Progress = SILENT,
) -> InterchangeReport:
    """Make a new COLMAP database from the features and matches of another program.

    Keypoints get 6 columns where the file has ``lafs``, 4 where it has ``scales`` and ``oris``,
    else 2. All images of the folder are imported, with or without features. The database appears
    when it is complete; nothing else is written.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        features_path: HDF5 file of keypoints.
        matches_path: HDF5 file of matches.
        database_path: where the database is made.
        cameras: which images share a camera, and known intrinsics.
        layout: ``hloc``, ``dim``, or ``auto``: as the matches are stored.
        pixel_origin: where (0, 0) is, the ``center`` of the first pixel (both programs) or its
            ``corner``, which is COLMAP's.
        verification: of the raw matches, by :func:`colmap_affrect.colmap.verification.verify`.
        skip_verification: leave the database without two-view geometries.
        random_seed: of the verification.
        progress: where to show progress.

    Raises:
        StoreError: when a file cannot be read, or contradicts the photographs or the other file.
        DatabaseError: when the database exists already.
    """
    _check_choice("layout", layout, ("auto", *LAYOUTS))
    _check_choice("pixel_origin", pixel_origin, PIXEL_ORIGINS)
    _refuse_existing(database_path, DatabaseError)
    cameras, verification = cameras or CameraOptions(), verification or VerificationOptions()
    check_cameras(cameras)
    names = list_images(image_path)
    with ExitStack() as stack:
        features = stack.enter_context(_opened(features_path))
        matches = stack.enter_context(_opened(matches_path))
        layout = _layout(matches) if layout == "auto" else layout
        keys = _name_features(features, names, layout, image_path)
        pairs, notes = _name_pairs(matches, keys, layout)
        # Verification may take hours, and half a database must not be left behind.
        folder = tempfile.TemporaryDirectory(prefix=".import-h5-", dir=database_path.parent)
        new = Path(stack.enter_context(folder)) / "new.db"
        rejected = import_images(new, image_path, names, cameras)
        _refuse_rejected(sorted(set(rejected) & set(keys.values())), image_path, cameras)
        with open_database(new) as database, pycolmap.DatabaseTransaction(database):
            images = {image.name: image for image in database.read_all_images()}
            counts = {}
            with progress.stage("keypoints", len(keys), "images") as advance:
                for key, name in keys.items():
                    camera = database.read_camera(images[name].camera_id)
                    size = _read_size(features, key, layout)
                    _check_size(features.path, name, size, (camera.width, camera.height))
                    keypoints = _read_keypoints(features, key, pixel_origin)
                    database.write_keypoints(images[name].image_id, keypoints)
                    counts[name] = len(keypoints)
                    advance(1)
            num_matches = 0
            with progress.stage("matches", len(pairs), "pairs") as advance:
                for pair, key in pairs.items():
                    indices = _read_matches(matches, key, layout, pair, counts)
                    id1, id2 = (images[name].image_id for name in pair)
                    write_matches(database, id1, id2, indices)
                    num_matches += len(indices)
                    advance(1)
        num_verified = None
        if not skip_verification:
            with progress.stage("verify", len(pairs), "pairs") as advance:
                verify(new, verification, random_seed)
                advance(len(pairs))
            num_verified = len(verified_pairs(new, verification.min_num_inliers))
        new.replace(database_path)
    without = sorted(set(images) - set(counts))
    if without:
        notes.append(f"images without features are there without keypoints: {_listed(without)}")
    if rejected:
        notes.append(f"images that COLMAP does not take are left out: {_listed(rejected)}")
    return InterchangeReport(
        "imported",
        layout,
        len(images),
        sum(counts.values()),
        len(pairs),
        num_matches,
        num_verified,
        tuple(notes),
    )


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
    """Write features and raw matches of an output folder or a database for another program.

    Features keep their indices. ``scales`` and ``oris`` are those of hloc: sigma in px, and
    degrees from x towards y. Descriptors are of unit length. Scores, which a database does not
    have, are 1 then.

    Args:
        features_path: new HDF5 file of features.
        matches_path: new HDF5 file of matches.
        output_path: an output folder of ours in which matching is done; or
        database_path: any COLMAP database, which is copied first and stays as it is.
        layout: ``hloc`` or ``dim``.
        half: write all real numbers as float16, coordinates too.
        progress: where to show progress.

    Raises:
        StoreError: when a file exists, cannot be written, or its layout cannot hold the content.
        DatabaseError: when the database cannot be used.
    """
    _check_choice("layout", layout, LAYOUTS)
    if features_path.resolve() == matches_path.resolve():
        raise StoreError(f"{features_path}: features and matches need a file each")
    for path in (features_path, matches_path):
        _refuse_existing(path, StoreError)
    with ExitStack() as stack:
        content = stack.enter_context(_content(output_path, database_path))
        _check_names(content.names, layout)
        features_file = stack.enter_context(_created(features_path))
        matches_file = stack.enter_context(_created(matches_path))
        counts = {}
        with progress.stage("features", len(content.names), "images") as advance:
            for name in content.names:
                size, data = content.features(name)
                datasets = _feature_datasets(size, data, layout, half=half)
                features_file.write(_feature_key(name, layout), datasets)
                counts[name] = len(data["keypoints"])
                advance(1)
        num_matches, num_lost = 0, 0
        with progress.stage("matches", content.num_pairs, "pairs") as advance:
            for found in content.matches():
                _check_range(content.where, found.names, found.indices, counts)
                pair = _one_match_per_keypoint(found) if layout == "hloc" else found
                matches_file.write(*_match_datasets(pair, layout))
                num_matches += len(pair.indices)
                num_lost += len(found.indices) - len(pair.indices)
                advance(1)
    notes = list(content.notes)
    if num_lost:
        notes.append(f"{num_lost} matches are left out: hloc's files hold one of each keypoint")
    if half:
        notes.append("coordinates are rounded: float16 has steps of 1 px from 1024 px on")
    return InterchangeReport(
        "exported",
        layout,
        len(counts),
        sum(counts.values()),
        content.num_pairs,
        num_matches,
        None,
        tuple(notes),
    )


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise OptionError(f"{name} {value!r}: not one of {', '.join(choices)}")


def _refuse_existing(path: Path, error: type[StoreError | DatabaseError]) -> None:
    if path.exists():
        raise error(f"{path}: exists already and is not overwritten; give another name")
    if not path.parent.is_dir():
        raise error(f"{path.parent}: no such folder; make it first")


def _listed(names: Iterable[str]) -> str:
    names = list(names)
    more = len(names) - MAX_NAMES_IN_MESSAGE
    shown = ", ".join(names[:MAX_NAMES_IN_MESSAGE])
    return f"{shown}, and {more} more" if more > 0 else shown


@dataclass(frozen=True)
class _Source:
    """An open HDF5 file of another program, and the shapes of its datasets by their paths."""

    path: Path
    file: Any
    shapes: dict[str, tuple[int, ...]]

    def read(self, key: str, shape: tuple[int | None, ...], kinds: str = "fiu") -> NDArray[Any]:
        """Read a dataset of finite numbers after its shape was checked; None stands for any size.

        Args:
            key: path of the dataset.
            shape: expected shape.
            kinds: of numpy's types that are taken.
        """
        found = self.shapes[key]
        same = [size in (expected, None) for size, expected in zip(shape, found, strict=False)]
        if len(found) != len(shape) or not all(same):
            wanted = str(shape).replace("None", "N")
            raise StoreError(f"{self.path}: {key} has shape {found}, expected {wanted}")
        if np.prod([float(size) for size in found]) > MAX_VALUES:
            raise StoreError(f"{self.path}: {key} of shape {found} is too large to be true")
        with _reading(self.path):
            kind = self.file[key].dtype.kind
            values = np.asarray(self.file[key][()]) if kind in kinds else None
        if values is None:
            what = "numbers" if "f" in kinds else "integers"
            raise StoreError(f"{self.path}: {key} does not hold {what}")
        if not np.isfinite(values).all():
            raise StoreError(f"{self.path}: {key} holds values that are not finite")
        return values


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except UNREADABLE as error:
        raise StoreError(f"{path}: damaged ({_first_line(error)})") from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


@contextmanager
def _opened(path: Path) -> Iterator[_Source]:
    """Open a file for reading and look through it; what points out of it is refused."""
    if not path.is_file():
        raise StoreError(f"{path}: no such file")
    try:
        file = h5py.File(path, "r")
    except BlockingIOError as error:
        raise StoreError(
            f"{path}: another program is writing it; wait until it has ended"
        ) from error
    except OSError as error:
        if "already open for write" in str(error):
            raise StoreError(
                f"{path}: is being written, or its writer was killed; in the second case "
                f"'h5clear --status {path.name}' mends it"
            ) from error
        raise StoreError(f"{path}: not an HDF5 file, or damaged ({_first_line(error)})") from error
    with file:
        yield _Source(path, file, _shapes(path, file))


def _shapes(path: Path, file: h5py.File) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    outside: list[str] = []

    def visit(key: str, link: object) -> None:
        if not isinstance(link, h5py.HardLink):
            outside.append(key)
        elif isinstance(item := file[key], h5py.Dataset):
            if item.external or item.is_virtual:
                outside.append(key)
            else:
                shapes[key] = item.shape or ()

    with _reading(path):
        file.visititems_links(visit)
    if outside:
        raise StoreError(
            f"{path}: soft and external links and data in other files are not followed: "
            f"{_listed(outside)}"
        )
    return shapes


def _layout(matches: _Source) -> str:
    """Tell the layout by the matches; a file without any is taken for hloc's."""
    columns = [s for key, s in matches.shapes.items() if key.endswith(HLOC_MATCHES) and len(s) == 1]
    return "hloc" if columns or not matches.shapes else "dim"


def _is_plain(name: str) -> bool:
    """Tell whether a name is a relative path as it is written, without '.' and '..'."""
    path = PurePosixPath(name)
    return path.as_posix() == name and not path.is_absolute() and ".." not in path.parts


def _name_features(
    source: _Source, names: Sequence[str], layout: str, image_path: Path
) -> dict[str, str]:
    """Return the image name of each group with keypoints, or dataset of them at the top."""
    keys = [key.removesuffix(KEYPOINTS) for key in source.shapes if key.endswith(KEYPOINTS)]
    keys += [key for key in source.shapes if "/" not in key]
    if not keys:
        raise StoreError(f"{source.path}: holds no keypoints; is it a file of local features?")
    unsafe = [key for key in keys if not _is_plain(key)]
    if unsafe:
        raise StoreError(f"{source.path}: names that lead elsewhere: {_listed(unsafe)}")
    known = {name: [name] for name in names}
    if layout == "dim":
        known |= _by_file_name(names)
    found = {key: known.get(key, []) for key in sorted(keys)}
    unknown = [key for key, candidates in found.items() if not candidates]
    if unknown:
        raise StoreError(
            f"{source.path}: has features of images that are not in {image_path}: "
            f"{_listed(unknown)}"
        )
    for key, candidates in found.items():
        if len(candidates) > 1:
            raise StoreError(f"{source.path}: {key} may be any of {_listed(candidates)}")
    named = {key: candidates[0] for key, candidates in found.items()}
    by_name = {name: key for key, name in named.items()}
    twice = [key for key, name in named.items() if by_name[name] != key]
    if twice:
        raise StoreError(f"{source.path}: has features of {named[twice[0]]} twice")
    if layout == "hloc":
        refuse_colliding_keys(list(by_name))
    return named


def _by_file_name(names: Iterable[str]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(PurePosixPath(name).name, []).append(name)
    return groups


def _name_pairs(
    source: _Source, named: Mapping[str, str], layout: str
) -> tuple[dict[Pair, str], list[str]]:
    """Return the key of each pair of image names, and notes on pairs that were passed over."""
    if layout == "hloc":
        keys = [k.removesuffix(HLOC_MATCHES) for k in source.shapes if k.endswith(HLOC_MATCHES)]
        parts = {name.replace("/", "-"): name for name in named.values()}
    else:
        keys, parts = list(source.shapes), dict(named)
    if source.shapes and not keys:
        raise StoreError(f"{source.path}: holds no 'matches0'; is it of another layout?")
    pairs: dict[Pair, str] = {}
    unknown, selves, again = [], [], []
    for key in sorted(keys, key=lambda key: ("/" not in key, key)):
        found = _split_key(key, "/" if "/" in key else "_", parts)
        if len(found) > 1:
            raise StoreError(
                f"{source.path}: {key} may be any of {_listed(map(' + '.join, found))}"
            )
        if not found:
            unknown.append(key)
        elif found[0][0] == found[0][1]:
            selves.append(key)
        elif found[0] in pairs or found[0][::-1] in pairs:
            again.append(key)
        else:
            pairs[found[0]] = key
    if unknown:
        raise StoreError(
            f"{source.path}: has matches of images that have no features: {_listed(unknown)}"
        )
    notes = []
    if again:
        notes.append(f"pairs that are there twice, the second is left out: {_listed(again)}")
    if selves:
        notes.append(f"images matched with themselves are left out: {_listed(selves)}")
    return pairs, notes


def _split_key(key: str, separator: str, names: Mapping[str, str]) -> list[Pair]:
    """Return every way to read a key as two names."""
    parts = key.split(separator)
    halves = (
        (separator.join(parts[:count]), separator.join(parts[count:]))
        for count in range(1, len(parts))
    )
    return [(names[a], names[b]) for a, b in halves if a in names and b in names]


def _refuse_rejected(names: Sequence[str], image_path: Path, cameras: CameraOptions) -> None:
    if names:
        raise ImageError(
            f"{image_path}: COLMAP does not take (damaged, or of another size than camera mode "
            f"{cameras.mode} allows): {_listed(names)}"
        )


def _read_size(source: _Source, key: str, layout: str) -> tuple[float, float] | None:
    """Return the (width, height) of the image that features were made of, if it is there."""
    if f"{key}/image_size" not in source.shapes:
        return None
    first, second = source.read(f"{key}/image_size", (2,)).tolist()
    return (first, second) if layout == "hloc" else (second, first)


def _check_size(
    path: Path, name: str, size: tuple[float, float] | None, expected: tuple[int, int]
) -> None:
    if size not in (None, expected):
        turned = " (turned by its EXIF orientation?)" if size == expected[::-1] else ""
        raise StoreError(
            f"{path}: {name} was {size[0]:g} x {size[1]:g} px for the features{turned}, and "
            f"the photograph is {expected[0]} x {expected[1]} px; use the same photographs"
        )


def _read_keypoints(source: _Source, key: str, pixel_origin: str) -> NDArray[np.float32]:
    """Return the (N, 2), (N, 4) or (N, 6) keypoints of an image as COLMAP stores them."""
    path = f"{key}/keypoints" if f"{key}/keypoints" in source.shapes else key
    lafs, scales, oris = (f"{key}/{name}" for name in ("lafs", "scales", "oris"))
    with np.errstate(over="ignore"):  # what float32 cannot hold is refused at the end
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
    if not np.isfinite(keypoints).all():
        raise StoreError(f"{source.path}: {path} or its shapes hold values that are too large")
    return keypoints


def _read_matches(
    source: _Source, key: str, layout: str, pair: Pair, counts: Mapping[str, int]
) -> NDArray[np.int64]:
    """Return the (M, 2) matches of a pair, all in range."""
    if layout == "hloc":
        column = source.read(f"{key}/matches0", (counts[pair[0]],), "iu").astype(np.int64)
        rows = np.flatnonzero(column != -1)
        indices = np.stack([rows, column[rows]], axis=1)
    else:
        indices = source.read(key, (None, 2), "iu").astype(np.int64)
    _check_range(f"{source.path}", pair, indices, counts)
    return indices


def _check_range(
    where: str, pair: Pair, indices: NDArray[np.integer], counts: Mapping[str, int]
) -> None:
    for name, column in zip(pair, indices.T, strict=True):
        wrong = column[(column < 0) | (column >= counts.get(name, 0))]
        if len(wrong):
            raise StoreError(
                f"{where}: the matches of {pair[0]} and {pair[1]} point at keypoint {wrong[0]} of "
                f"{name}, which has {counts.get(name, 0)}; match them again"
            )


class _Content(Protocol):
    """What is exported.

    Attributes:
        where: the file or folder it comes from.
        names: of the images with features.
        num_pairs: number of pairs that :meth:`matches` yields.
        notes: what was left out.
    """

    where: str
    names: list[str]
    num_pairs: int
    notes: list[str]

    def features(self, name: str) -> tuple[tuple[int, int], dict[str, NDArray[np.float32]]]:
        """Return the (width, height) of an image and its datasets as in hloc's layout."""
        ...

    def matches(self) -> Iterator[PairMatches]:
        """Yield the raw matches of all pairs."""
        ...


@contextmanager
def _content(output_path: Path | None, database_path: Path | None) -> Iterator[_Content]:
    if output_path is not None and database_path is None:
        workspace = Workspace(output_path)
        workspace.require("match")
        with workspace.locked():
            yield _WorkspaceContent(workspace)
    elif database_path is not None and output_path is None:
        with open_copy(database_path) as database:
            yield _DatabaseContent(database, str(database_path))
    else:
        raise OptionError("give either an output folder or a database")


class _WorkspaceContent:
    """Features and matches of an output folder."""

    def __init__(self, workspace: Workspace) -> None:
        self.where = str(workspace.path)
        self._features, self._matches = feature_store(workspace), match_store(workspace)
        self._sizes = self._features.image_sizes()
        self._pairs = listed_pairs(workspace)
        self.names = sorted(self._sizes)
        self.num_pairs = len(self._pairs)
        self.notes: list[str] = []

    def features(self, name: str) -> tuple[tuple[int, int], dict[str, NDArray[np.float32]]]:
        """See :class:`_Content`."""
        found = self._features.read(name)
        data = {
            "keypoints": found.keypoints.astype(np.float32),
            "descriptors": found.descriptors.T,
            "scores": found.responses,
            **_frame_datasets(found.lafs),
        }
        return self._sizes[name], data

    def matches(self) -> Iterator[PairMatches]:
        """See :class:`_Content`."""
        return self._matches.read(self._pairs) if self._pairs else iter(())


class _DatabaseContent:
    """Features and matches of a COLMAP database."""

    def __init__(self, database: pycolmap.Database, where: str) -> None:
        self.where = where
        self._database = database
        self._images = {image.name: image for image in database.read_all_images()}
        found = {n for n, i in self._images.items() if database.exists_keypoints(i.image_id)}
        self.names = sorted(found)
        pair_ids, _ = database.read_num_matches()
        self._pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
        self.num_pairs = len(self._pairs)
        without = sorted(set(self._images) - found)
        self.notes = [f"images without keypoints are left out: {_listed(without)}"] * bool(without)

    def features(self, name: str) -> tuple[tuple[int, int], dict[str, NDArray[np.float32]]]:
        """See :class:`_Content`."""
        image = self._images[name]
        camera = self._database.read_camera(image.camera_id)
        keypoints = np.asarray(self._database.read_keypoints(image.image_id), np.float32)
        data = {
            "keypoints": np.asarray(pixel_from_colmap(keypoints[:, :2])),
            "scores": np.ones(len(keypoints), np.float32),
        }
        columns = keypoints.shape[1]
        if columns == 6:
            shapes = keypoints[:, 2:].reshape(-1, 2, 2) * np.float32(MEASUREMENT_SIGMAS)
            data |= _frame_datasets(np.concatenate([shapes, data["keypoints"][:, :, None]], axis=2))
        elif columns == 4:
            data |= {"scales": keypoints[:, 2], "oris": np.rad2deg(keypoints[:, 3])}
        elif len(keypoints) and columns != 2:
            raise DatabaseError(f"{self.where}: {name} has keypoints of {columns} columns")
        if self._database.exists_descriptors(image.image_id):
            data["descriptors"] = self._descriptors(name, len(keypoints)).T
        return (camera.width, camera.height), data

    def _descriptors(self, name: str, count: int) -> NDArray[np.float32]:
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
        """See :class:`_Content`."""
        names = {image.image_id: name for name, image in self._images.items()}
        for id1, id2 in self._pairs:
            if not {id1, id2} <= names.keys():
                raise DatabaseError(f"{self.where}: has matches of images that are not in it")
            indices = np.asarray(self._database.read_matches(id1, id2), np.int64)
            count = self._database.num_keypoints_for_image(id1)
            scores = np.ones(len(indices), np.float32)
            yield PairMatches((names[id1], names[id2]), indices, scores, count)


def _frame_datasets(lafs: NDArray[np.floating]) -> dict[str, NDArray[np.float32]]:
    """Return (N, 2, 3) frames, and their scales in sigmas and orientations in degrees."""
    shapes = lafs[:, :, :2].astype(np.float64)
    scales = np.sqrt(np.abs(np.linalg.det(shapes))) / MEASUREMENT_SIGMAS
    angles = np.rad2deg(np.arctan2(shapes[:, 1, 0], shapes[:, 0, 0]))
    datasets = {"lafs": lafs, "scales": scales, "oris": angles}
    return {name: values.astype(np.float32) for name, values in datasets.items()}


def _feature_key(name: str, layout: str) -> str:
    return name if layout == "hloc" else PurePosixPath(name).name


def _check_names(names: Sequence[str], layout: str) -> None:
    """Refuse names that the keys of a layout cannot hold, or not tell apart."""
    unsafe = [name for name in names if not _is_plain(name) or "\0" in name]
    if unsafe:
        raise StoreError(f"names that are no plain relative paths: {_listed(unsafe)}")
    if layout == "dim":
        groups = _by_file_name(names).values()
        same = [name for group in groups if len(group) > 1 for name in group]
        if same:
            raise StoreError(
                f"deep-image-matching knows images by file name only, which these share: "
                f"{_listed(same)}; use --layout hloc"
            )
        return
    refuse_colliding_keys(names)
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    both = sorted(folders & set(names))
    if both:
        raise StoreError(f"{both[0]}: is an image and the folder of another; rename it")


def _feature_datasets(
    size: tuple[int, int], data: Mapping[str, NDArray[np.float32]], layout: str, *, half: bool
) -> dict[str, NDArray[Any]]:
    reals = {name: values.astype(np.float16) if half else values for name, values in data.items()}
    return {**reals, "image_size": np.asarray(size if layout == "hloc" else size[::-1])}


def _match_datasets(pair: PairMatches, layout: str) -> tuple[str, dict[str, NDArray[Any]]]:
    """Return the group of a pair and its datasets."""
    if layout == "hloc":
        return pair_key(*pair.names), hloc_matches(pair)
    first, second = (_feature_key(name, layout) for name in pair.names)
    return first, {second: pair.indices}


def _one_match_per_keypoint(pair: PairMatches) -> PairMatches:
    """Keep the first match of each keypoint of the first image."""
    _, kept = np.unique(pair.indices[:, 0], return_index=True)
    return replace(pair, indices=pair.indices[kept], scores=pair.scores[kept])


@dataclass(frozen=True)
class _Target:
    """An HDF5 file in writing. Room is made sure of: a full disk can end the process in HDF5."""

    path: Path
    file: Any

    def write(self, key: str, datasets: Mapping[str, NDArray[Any]]) -> None:
        """Add datasets to a group."""
        require_space(self.path, sum(values.nbytes for values in datasets.values()) + SPARE_BYTES)
        with _writing(self.path):
            group = self.file.require_group(key)
            for name, values in datasets.items():
                group.create_dataset(name, data=values)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise StoreError(
            f"{path}: cannot be written ({_first_line(error)}); free space or give another name"
        ) from error


@contextmanager
def _created(path: Path) -> Iterator[_Target]:
    """Make a file, under another name until it is complete."""
    new = path.with_name(path.name + ".partial")
    require_space(path, SPARE_BYTES)
    try:
        with _writing(path):
            file = h5py.File(new, "w")
        try:
            yield _Target(path, file)
        finally:
            with _writing(path):
                file.close()
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
