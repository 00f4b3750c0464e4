"""Files of matches of other programs: those of hloc and deep-image-matching, and COLMAP's lists.

- hloc: a group for each pair with ``matches0`` (N0,), -1 where unmatched. In its key each '/' of a
  name is '-', and '/' stands between the names; older files have '_' there. A run's own
  ``matches.h5`` is such a file.
- deep-image-matching, and notebooks of the image matching challenge: a group for the first image,
  in it for the second one the (M, 2) matches.
- COLMAP's text lists, as ``matches_importer`` takes them: a line of two names, a line of two
  numbers for each match, and an empty line. Names may be paths into the folder of the photographs,
  also with backslashes, as in lists of pairs.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from colmap_affrect.errors import (
    OptionError,
    StoreError,
    damage,
    not_utf_8,
    such_as,
)
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import (
    Pair,
    spellings,
    split_line,
    split_of_others,
)
from colmap_affrect.project.given_h5 import GivenFile, open_given_file
from colmap_affrect.project.regular_files import read_regular_text

MatchType = Literal["raw", "inliers"]
"""As COLMAP has it: matches to be verified, or verified ones."""

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
HLOC = "matches0"
OWN_FORMAT = "colmap_affrect/matches"  # attribute of a run's matches.h5
COMPLETE = "write it anew with the program that made it"


@dataclass(frozen=True)
class GivenMatches:
    """Matches of pairs of images."""

    path: Path
    pairs: tuple[Pair, ...]
    read: Callable[[Mapping[str, int]], Iterator[tuple[Pair, Indices]]]
    """Returns each pair with its (M, 2) features, in any order; takes how many each image has."""


@contextmanager
def given_matches(
    path: Path, names: Collection[str], image_path: Path | None = None
) -> Iterator[GivenMatches]:
    """Open a file of matches of named images.

    Args:
        path: HDF5 file, or text.
        names: of the images that have features.
        image_path: folder of the photographs, into which paths in text may lead; None: they are
            refused.

    Raises:
        OptionError: when there is no such file, or it is text in another encoding than UTF-8.
        StoreError: when it is damaged, or names other images.
    """
    if not path.is_file():
        raise OptionError("no such file", where=path)
    with path.open("rb") as file:
        has_signature = file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE
    if not has_signature and path.suffix != ".h5":
        folders = spellings(image_path) if image_path else ()
        yield _read_list(path, names, folders)
        return
    with open_given_file(path) as source:
        yield _of_hdf5(source, names)


def _of_hdf5(source: GivenFile, names: Collection[str]) -> GivenMatches:
    if any(key.endswith(f"/{HLOC}") for key in source.shapes) or not source.shapes:
        keys = _once(_hloc_pairs(source, names))
    else:
        keys = _once(_nested_pairs(source, names))

    def read(num_features: Mapping[str, int]) -> Iterator[tuple[Pair, Indices]]:
        for pair, key in keys.items():
            if key in source.shapes:
                yield pair, source.read(key, (None, 2), "iu").astype(np.int64)
                continue
            column = _column(source, f"{key}/{HLOC}", num_features[pair[0]])
            rows = np.flatnonzero(column != -1)
            yield pair, np.stack([rows, column[rows]], axis=1)

    return GivenMatches(path=source.path, pairs=tuple(keys), read=read)


def _column(source: GivenFile, key: str, num_features: int) -> Indices:
    """Return the match of each feature of a first image, -1 where it has none.

    In a file of ours there may be fewer than features: what escalation has added
    to the image since then follows those that there were.

    Args:
        source: the file.
        key: of the dataset.
        num_features: of the first image.
    """
    expected: int | None = num_features
    is_own = source.file.attrs.get("format") == OWN_FORMAT
    shape = source.shapes[key]
    if is_own and len(shape) == 1 and shape[0] <= num_features:
        expected = None
    return source.read(key, (expected,), "iu").astype(np.int64)


def _once(found: Iterator[tuple[Pair, str]]) -> dict[Pair, str]:
    """Keep each pair once, in either order, and none of an image with itself."""
    keys: dict[Pair, str] = {}
    for (first, second), key in found:
        is_known = (first, second) in keys or (second, first) in keys
        if first != second and not is_known:
            keys[first, second] = key
    return keys


def _hloc_pairs(
    source: GivenFile, names: Collection[str]
) -> Iterator[tuple[Pair, str]]:
    """Yield the pairs of a file of hloc with their keys."""
    by_key: dict[str, str] = {}
    for written, name in _as_written(names).items():
        by_key[written.replace("/", "-")] = name
    for name in names:  # whole names come before others that look like them
        by_key[name.replace("/", "-")] = name
    unknown = []
    for key in source.groups_with(HLOC):
        found = list(_splits(key, "/", by_key)) or list(_splits(key, "_", by_key))
        if len(found) > 1:
            one = ", ".join(found[0])
            other = ", ".join(found[1])
            raise StoreError(
                f"{key} may stand for {one} and {other}",
                where=source.path,
                advice="rename the images",
            )
        if found:
            yield found[0], key
        else:
            unknown.append(key)
    _refuse_unknown(source.path, unknown)


def _nested_pairs(
    source: GivenFile, names: Collection[str]
) -> Iterator[tuple[Pair, str]]:
    """Yield the pairs of a file with a group for each first image."""
    by_key = _as_written(names)
    unknown = []
    has_matches = False
    for key, shape in sorted(source.shapes.items()):
        if len(shape) != 2 or shape[1] != 2:
            continue
        has_matches = True
        found = list(_splits(key, "/", by_key))
        if found:
            yield found[0], key
        else:
            unknown.append(key)
    if not has_matches:
        source.groups_with(HLOC)  # which says what is missing
    _refuse_unknown(source.path, unknown)


def _as_written(names: Collection[str]) -> dict[str, str]:
    """Return images by their names, and without folders where only one image is called so."""
    count = Counter(PurePosixPath(name).name for name in names)
    images: dict[str, str] = {}
    for name in names:
        without_folder = PurePosixPath(name).name
        if count[without_folder] == 1:
            images[without_folder] = name
        images[name] = name
    return images


def _splits(key: str, separator: str, by_key: Mapping[str, str]) -> Iterator[Pair]:
    """Yield the pairs of names that a separator in a key may stand between."""
    parts = key.split(separator)
    for end in range(1, len(parts)):
        first = separator.join(parts[:end])
        second = separator.join(parts[end:])
        if first in by_key and second in by_key:
            yield by_key[first], by_key[second]


def _refuse_unknown(path: Path, keys: Collection[str]) -> None:
    if keys:
        raise StoreError(
            f"has matches of images that have no features: {such_as(keys)}", where=path
        )


def _read_list(
    path: Path, names: Collection[str], folders: Sequence[str]
) -> GivenMatches:
    """Read a text list of COLMAP.

    Args:
        path: the list.
        names: of the images that have features.
        folders: how paths into the folder of the photographs begin.
    """
    known = _as_written(names)
    found: dict[Pair, Indices] = {}
    with damage(path, COMPLETE):
        lines = _lines(path)
        number = 0
        while number < len(lines):
            line = lines[number].strip()
            number += 1
            if not line or line.startswith("#"):
                continue
            written = split_line(line, known) or split_of_others(line, known, folders)
            if not written:
                raise StoreError(
                    f"line {number}: {line!r} is not two names of images that have "
                    "features, nor two numbers of features",
                    where=path,
                )
            pair = (known[written[0]], known[written[1]])
            end = _end_of_matches(lines, number)
            is_known = pair in found or pair[::-1] in found
            if pair[0] != pair[1] and not is_known:
                numbers = " ".join(lines[number:end]).split()
                found[pair] = np.array(numbers, np.int64).reshape(-1, 2)
            number = end
    if not found:
        raise StoreError(
            "holds no matches",
            where=path,
            advice="give an HDF5 file, or a list of COLMAP",
        )
    return GivenMatches(
        path=path, pairs=tuple(found), read=lambda _: iter(found.items())
    )


def _lines(path: Path) -> list[str]:
    try:
        return read_regular_text(path, "utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise not_utf_8(path) from error


def _end_of_matches(lines: Sequence[str], begin: int) -> int:
    """Return the number of the first line, from one on, that is no match."""
    end = begin
    while end < len(lines) and _is_match(lines[end]):
        end += 1
    return end


def _is_match(line: str) -> bool:
    """Tell whether a line is of two whole numbers."""
    parts = line.split()
    return len(parts) == 2 and parts[0].isdecimal() and parts[1].isdecimal()
