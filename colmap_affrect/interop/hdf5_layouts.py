"""HDF5 files of other programs: safe access, and which image or pair each of their keys means.

In all layouts (0, 0) is the centre of the first pixel.

``hloc``
    Features: a group per image name, nested at '/', with ``keypoints`` (N, 2), ``descriptors``
    (D, N), ``scores`` (N,), ``image_size`` (width, height), and perhaps ``scales`` (N,) in sigmas,
    ``oris`` (N,) in degrees from x towards y, ``lafs`` (N, 2, 3). Matches: a group per pair with
    ``matches0`` (N0,), -1 where unmatched, and ``matching_scores0`` (N0,); in its key each '/'
    of a name is '-', and '/' stands between the names.
``dim`` (deep-image-matching)
    The same features by file name without folders, ``image_size`` as (height, width); matches
    [name 1][name 2] (M, 2). Also read without groups, as in the notebooks of the Image Matching
    Challenge: keypoints [name] (N, 2) and matches.

These files are not trusted: links and data in other files are refused, and arrays are checked.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import OptionError, StoreError, damage, such_as
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.images.photographs import refuse_colliding_keys
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.outputs import leads_outside
from colmap_affrect.project.stores import PairMatches, hloc_matches, pair_key

Datasets = dict[str, NDArray[Any]]

MAX_VALUES = 1 << 28  # an array of more values is taken for damage, and not read
MAX_NAMES_IN_MESSAGE = 10
SPARE_BYTES = 8 << 20  # for HDF5's index, and for what it has not written yet
KEYPOINTS, MATCHES = "/keypoints", "/matches0"
MEND = "make it again with the program that wrote it"


@dataclass(frozen=True)
class Layout:
    """How a program names and stores what it knows of images and pairs."""

    name: str
    feature_key: Callable[[str], str]  # group of the features of an image
    pair_part: Callable[[str], str]  # what stands for that group in the key of a pair
    matches: str  # dataset in the group of a pair; empty where the key itself is a dataset
    size_step: int  # 1 where image_size is (width, height), -1 where it is (height, width)

    def write_matches(self, write: Callable[[str, Datasets], None], pair: PairMatches) -> int:
        """Write the matches of a pair, in hloc's files one of each keypoint; return how many."""
        if not self.matches:
            first, second = map(self.feature_key, pair.names)
            write(first, {second: pair.indices})
            return len(pair.indices)
        _, kept = np.unique(pair.indices[:, 0], return_index=True)
        one = replace(pair, indices=pair.indices[kept], scores=pair.scores[kept])
        write(pair_key(*pair.names), hloc_matches(one))
        return len(kept)


LAYOUTS = {
    "hloc": Layout("hloc", str, lambda key: key.replace("/", "-"), MATCHES, 1),
    "dim": Layout("dim", lambda name: PurePosixPath(name).name, str, "", -1),
}


def listed(names: Iterable[str]) -> str:
    """Return names for a message, the first of them if there are many."""
    return such_as(names, MAX_NAMES_IN_MESSAGE)


def noted(what: str, names: Collection[str]) -> list[str]:
    """Return a note about names, if there are any."""
    return [f"{what}: {listed(names)}"] if names else []


@dataclass(frozen=True)
class Source:
    """An open HDF5 file of another program, and the shapes of its datasets by their paths."""

    path: Path
    file: Any
    shapes: dict[str, tuple[int, ...]]

    def read(self, key: str, shape: tuple[int | None, ...], kinds: str = "fiu") -> NDArray[Any]:
        """Read numbers of some of numpy's kinds, of a shape in which None is any size."""
        stored = self.shapes[key]
        same = [size in (expected, None) for size, expected in zip(shape, stored, strict=False)]
        if len(stored) != len(shape) or not all(same):
            wanted = str(shape).replace("None", "N")
            raise StoreError(f"{self.path}: {key} has shape {stored}, expected {wanted}")
        if np.prod([float(size) for size in stored]) > MAX_VALUES:
            raise StoreError(f"{self.path}: {key} of shape {stored} is too large to be true")
        with damage(self.path, MEND):
            if self.file[key].dtype.kind in kinds:
                return np.asarray(self.file[key][()])
        what = "numbers" if "f" in kinds else "integers"
        raise StoreError(f"{self.path}: {key} does not hold {what}")


@contextmanager
def _opened(path: Path) -> Iterator[Source]:
    """Open a file for reading; links and data that lead out of it are refused."""
    if not path.is_file():
        raise OptionError(f"{path}: no such file")
    with damage(path, f"or still being written; {MEND}"):
        file = h5py.File(path, "r")
    with file:
        yield Source(path, file, _shapes(path, file))


def _shapes(path: Path, file: h5py.File) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    outside: list[str] = []

    def visit(key: str, link: object) -> None:
        item = file[key] if isinstance(link, h5py.HardLink) else None
        if item is None or (isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)):
            outside.append(key)
        elif isinstance(item, h5py.Dataset):
            shapes[key] = item.shape or ()

    with damage(path, MEND):
        try:
            file.visititems_links(visit)
        except SystemError as error:  # h5py's, for a name that is no UTF-8
            raise ValueError(error) from error
    if outside:
        raise StoreError(
            f"{path}: soft and external links and data in other files are not followed: "
            f"{listed(outside)}"
        )
    return shapes


@dataclass(frozen=True)
class ForeignFiles:
    """Features and matches of another program, by the names of photographs."""

    features: Source
    matches: Source
    layout: Layout  # of both files
    keys: dict[str, str]  # of the features of each image that has some
    pairs: dict[Pair, str]  # key of the matches of each pair
    notes: list[str]  # which pairs were passed over

    def check_size(self, name: str, expected: tuple[int, int]) -> None:
        """Refuse features of an image of another (width, height) than the photograph has."""
        key = f"{self.keys[name]}/image_size"
        if key not in self.features.shapes:
            return
        stored = self.features.read(key, (2,))[:: self.layout.size_step]
        size = tuple(stored.tolist())
        # deep-image-matching writes float16, which rounds sizes from 2049 px on.
        if not np.array_equal(stored, np.asarray(expected).astype(stored.dtype)):
            turned = " (turned by its EXIF orientation?)" if size == expected[::-1] else ""
            raise StoreError(
                f"{self.features.path}: {name} was {size[0]:g} x {size[1]:g} px for the features"
                f"{turned}, and the photograph is {expected[0]} x {expected[1]} px; use the same "
                "photographs"
            )

    def keypoints_key(self, name: str) -> str:
        """Return the dataset with the keypoints of an image, in its group or without one."""
        key = self.keys[name]
        return key + KEYPOINTS if key + KEYPOINTS in self.features.shapes else key

    def read_indices(self, pair: Pair, num_keypoints1: int) -> Indices:
        """Read the (M, 2) matches of a pair, the range of which is not checked here."""
        key = self.pairs[pair] + self.layout.matches
        if not self.layout.matches:
            return self.matches.read(key, (None, 2), "iu").astype(np.int64)
        column = self.matches.read(key, (num_keypoints1,), "iu").astype(np.int64)
        rows = np.flatnonzero(column != -1)
        return np.stack([rows, column[rows]], axis=1)


@contextmanager
def open_files(
    features_path: Path, matches_path: Path, layout: str, names: Sequence[str], image_path: Path
) -> Iterator[ForeignFiles]:
    """Open files of features and matches of named photographs; see ``import_h5``."""
    with _opened(features_path) as features, _opened(matches_path) as matches:
        if layout == "auto":  # a file without any matches is taken for hloc's
            columns = [k for k, s in matches.shapes.items() if len(s) == 1]
            is_hloc = any(key.endswith(MATCHES) for key in columns) or not matches.shapes
            layout = "hloc" if is_hloc else "dim"
        chosen = LAYOUTS[layout]
        keys = _name_features(features, names, chosen, image_path)
        pairs, notes = _name_pairs(matches, keys, chosen)
        yield ForeignFiles(features, matches, chosen, keys, pairs, notes)


def _name_features(
    source: Source, names: Sequence[str], layout: Layout, image_path: Path
) -> dict[str, str]:
    """Return the group with keypoints of each image, or the dataset of them at the top."""
    keys = [key.removesuffix(KEYPOINTS) for key in source.shapes if key.endswith(KEYPOINTS)]
    keys += [key for key in source.shapes if "/" not in key]
    if not keys:
        raise StoreError(f"{source.path}: holds no keypoints; is it a file of local features?")
    known = {name: [name] for name in names} | _by_key(names, layout)
    if unknown := sorted(set(keys) - known.keys()):
        raise StoreError(
            f"{source.path}: has features of images that are not in {image_path}: {listed(unknown)}"
        )
    key_of: dict[str, str] = {}
    for key in sorted(keys):
        name, *others = known[key]
        if others:
            raise StoreError(f"{source.path}: {key} may be any of {listed(known[key])}")
        if name in key_of:
            raise StoreError(f"{source.path}: has features of {name} twice")
        key_of[name] = key
    if layout.matches:
        refuse_colliding_keys(list(key_of))
    return key_of


def _name_pairs(
    source: Source, feature_keys: Mapping[str, str], layout: Layout
) -> tuple[dict[Pair, str], list[str]]:
    """Return the key of each pair of images, and notes on pairs that were passed over."""
    ending = layout.matches
    keys = [key.removesuffix(ending) for key in source.shapes if key.endswith(ending)]
    names = {layout.pair_part(key): name for name, key in feature_keys.items()}
    if source.shapes and not keys:
        raise StoreError(f"{source.path}: holds no 'matches0'; is it of another layout?")
    pairs: dict[Pair, str] = {}
    unknown, selves, again = [], [], []
    for key in sorted(keys):
        parts = key.split("/")
        if len(parts) != 2 or not names.keys() >= set(parts):
            unknown.append(key)
            continue
        pair = names[parts[0]], names[parts[1]]
        if pair[0] == pair[1]:
            selves.append(key)
        elif pair in pairs or pair[::-1] in pairs:
            again.append(key)
        else:
            pairs[pair] = key
    if unknown:
        raise StoreError(
            f"{source.path}: has matches of images that have no features: {listed(unknown)}"
        )
    notes = noted("pairs that are there twice, the second is left out", again)
    return pairs, notes + noted("images matched with themselves are left out", selves)


def _by_key(names: Iterable[str], layout: Layout) -> dict[str, list[str]]:
    groups: defaultdict[str, list[str]] = defaultdict(list)
    for name in names:
        groups[layout.feature_key(name)].append(name)
    return groups


def check_names(names: Sequence[str], layout: Layout) -> None:
    """Refuse image names that the keys of a layout cannot hold or tell apart."""
    unsafe = [
        name
        for name in names
        if leads_outside(name) or PurePosixPath(name).as_posix() != name or "\0" in name
    ]
    if unsafe:
        raise StoreError(f"names that are no plain relative paths: {listed(unsafe)}")
    groups = _by_key(names, layout)
    if same := [name for group in groups.values() if len(group) > 1 for name in group]:
        raise StoreError(
            f"deep-image-matching knows images by file name only, which these share: "
            f"{listed(same)}; use --layout hloc"
        )
    if layout.matches:
        refuse_colliding_keys(names)
    folders = {str(parent) for key in groups for parent in PurePosixPath(key).parents}
    if both := sorted(folders & groups.keys()):
        raise StoreError(f"{both[0]}: is an image and the folder of another; rename it")


@contextmanager
def created(new: Path, path: Path) -> Iterator[Callable[[str, Datasets], None]]:
    """Make a file in a temporary place; yield what adds datasets to one of its groups.

    The disk must have room for them: else HDF5 may end the process. WorkspaceError names ``path``.
    """
    require_space(path, SPARE_BYTES)
    with _writing(path):
        file = h5py.File(new, "w")

    def write(key: str, datasets: Datasets) -> None:
        require_space(path, sum(values.nbytes for values in datasets.values()) + SPARE_BYTES)
        with _writing(path):
            group = file.require_group(key)
            for name, values in datasets.items():
                group.create_dataset(name, data=values)

    try:
        yield write
    finally:
        with _writing(path):
            file.close()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise cannot_write(path, error) from error
