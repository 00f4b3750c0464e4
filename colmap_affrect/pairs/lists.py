"""Lists of pairs: all, by sequence or position, the most similar; their order, and their files."""

import difflib
import io
import itertools
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TextIO, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from colmap_affrect.errors import OptionError, clipped, not_utf_8
from colmap_affrect.geometry.arrays import Bools, Indices, Singles
from colmap_affrect.options import Options, within
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.record import stamp_of
from colmap_affrect.project.regular_files import open_regular

Pair = tuple[str, str]  # names of two photographs, in order

# At the end of a line; in the time of its length, however many blanks or digits it has.
SCORE = re.compile(r"(?<![\s,])[\s,]+[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?$")
# Lines that are none, after which no more are looked for; resource
MAX_PROBLEMS = 1000
# Words of a line for which names that are like them are looked for; display
MAX_SUGGESTIONS = 8
# Characters: systems have no longer paths than half of it; format
LONGEST_LINE = 1 << 13
MAX_SHOWN = 200  # characters of a line that an error shows; display
AT_ONCE = 1 << 16  # pairs that are given names together; resource
# With 13,000 features each, while pairs are gone through; resource
USUAL_IMAGES_IN_MEMORY = 40


class PairList(Sequence[Pair]):
    """Pairs as (N, 2) int32 ``numbers`` of their images in the sorted ``names``."""

    def __init__(self, names: Sequence[str], numbers: NDArray[np.integer]) -> None:
        self.names = names
        self.numbers = numbers.astype(np.int32, copy=False).reshape(-1, 2)

    @classmethod
    def of(cls, pairs: Iterable[Pair]) -> "PairList":
        """Make a list of any pairs, in their order."""
        if isinstance(pairs, PairList):
            return pairs
        listed = list(pairs)
        names = sorted(set(itertools.chain.from_iterable(listed)))
        number = {name: index for index, name in enumerate(names)}
        numbers = [(number[first], number[second]) for first, second in listed]
        return cls(names, np.array(numbers, np.int32))

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, index: int) -> Pair: ...
    @overload
    def __getitem__(self, index: slice) -> "PairList": ...
    def __getitem__(self, index: int | slice) -> "Pair | PairList":
        if isinstance(index, slice):
            return PairList(self.names, self.numbers[index])
        first, second = self.numbers[index].tolist()
        return self.names[first], self.names[second]

    def __iter__(self) -> Iterator[Pair]:
        for start in range(0, len(self), AT_ONCE):
            for first, second in self.numbers[start : start + AT_ONCE].tolist():
                yield self.names[first], self.names[second]

    def at(self, which: Bools | NDArray[np.integer] | slice) -> "PairList":
        """Return the pairs of a slice, of a mask (N,), or at indices in their order."""
        return PairList(self.names, self.numbers[which])


class PairOptions(Options):
    """Which images are matched: the pairs of several methods together."""

    methods: Annotated[
        tuple[Literal["exhaustive", "retrieval", "gps", "sequence"], ...],
        Field(strict=False, min_length=1),
    ] = ("exhaustive",)
    """``exhaustive``: all pairs. ``retrieval``: images whose descriptors are alike as a whole.
    ``gps``: images taken near to each other. ``sequence``: images that follow
    each other by name."""
    num_neighbors: Annotated[int, within(1, 1_000_000)] = 20  # resource
    """Of each image: on average, by retrieval, and half as many at least; at most, by gps; before
    and after it, in a sequence."""
    max_distance_m: Annotated[float, within(0.0, 1e9)] = 100.0  # COLMAP's
    """Between positions of ``gps``; in their own unit where they are not longitude and latitude."""
    match_list_path: str = ""
    """List of pairs, two names per line; takes the place of ``exhaustive``."""


# Times as many may an image have as images have on average; resource
CANDIDATES_PER_NEIGHBOR = 5


def exhaustive_pairs(names: Sequence[str]) -> list[Pair]:
    """Return every unordered pair of the names, sorted."""
    return list(itertools.combinations(sorted(names), 2))


def sequence_pairs(names: Sequence[str], num_neighbors: int) -> list[Pair]:
    """Return the sorted pairs of each name and the next ones; frame 9 comes before frame 10."""
    ordered = sorted(names, key=_by_numbers)
    pairs = []
    for index, first in enumerate(ordered):
        for second in ordered[index + 1 : index + 1 + num_neighbors]:
            pairs.append((min(first, second), max(first, second)))
    return sorted(pairs)


def _by_numbers(name: str) -> tuple[list[Any], str]:
    """Return what names are sorted by: their numbers count as such."""
    parts: list[Any] = re.split(r"([0-9]+)", name)
    parts[1::2] = map(int, parts[1::2])
    return parts, name


def most_similar_pairs(
    names: Sequence[str], similarities: Iterable[NDArray[np.number]], num_neighbors: int
) -> list[Pair]:
    """Choose pairs so that images have as many neighbours as wanted on average.

    Each image is paired with half as many that are most similar to it; the rest goes to the most
    similar pairs of all.

    Args:
        names: of N images.
        similarities: for each image its (N,) similarities with all, itself included.
        num_neighbors: of an image on average, 1 or more.

    Returns:
        The pairs, sorted.
    """
    candidates = _candidate_pairs(similarities, CANDIDATES_PER_NEIGHBOR * num_neighbors)
    if candidates is None:
        return []
    is_extra = candidates.ranks >= (num_neighbors + 1) // 2
    best_first = np.lexsort((-candidates.similarities, is_extra))
    codes = candidates.lower * len(names) + candidates.higher
    _, found_first = np.unique(codes[best_first], return_index=True)
    ranked = best_first[np.sort(found_first)]  # each pair once
    num_of_images = np.count_nonzero(~is_extra[ranked])
    num_wanted = len(names) * num_neighbors // 2
    pairs = []
    for chosen in ranked[: max(num_wanted, num_of_images)]:
        one = names[candidates.lower[chosen]]
        other = names[candidates.higher[chosen]]
        pairs.append((min(one, other), max(one, other)))
    return sorted(pairs)


@dataclass(frozen=True)
class _CandidatePairs:
    """Each image with those that are most similar to it, as (M,) arrays."""

    lower: Indices  # smaller index of the two images
    higher: Indices
    similarities: Singles
    ranks: Indices  # how many images are more similar to the one


def _candidate_pairs(
    similarities: Iterable[NDArray[np.number]], num_of_image: int
) -> _CandidatePairs | None:
    """Pair each image with so many that are most similar to it; None without images.

    Args:
        similarities: for each image its (N,) similarities with all, itself included.
        num_of_image: pairs of each image, at most.
    """
    lower = []
    higher = []
    found_similarities = []
    ranks = []
    for index, row in enumerate(similarities):
        values = row.astype(np.float32)
        order = np.argsort(-values, kind="stable")
        others = order[order != index][:num_of_image]
        lower.append(np.minimum(others, index))
        higher.append(np.maximum(others, index))
        found_similarities.append(values[others])
        ranks.append(np.arange(len(others)))
    if not lower:
        return None
    return _CandidatePairs(
        lower=np.concatenate(lower),
        higher=np.concatenate(higher),
        similarities=np.concatenate(found_similarities),
        ranks=np.concatenate(ranks),
    )


def ordered_for_reuse(pairs: Iterable[Pair], num_images: int) -> PairList:
    """Order pairs so that those of the same images come close together.

    They come in blocks of ``num_images``, in the order of their names, with as many others.
    """
    listed = PairList.of(pairs)
    low, high = np.sort(listed.numbers, axis=1).T
    return listed.at(np.lexsort((high, low, high // num_images, low // num_images)))


def read_pairs(
    path: Path, names: Sequence[str], image_path: Path | None = None
) -> PairList:
    """Read a pair list as COLMAP and hloc write it: two names per line.

    Separated by spaces, a tab or a comma; names may contain spaces. A number behind them, a score,
    has no effect; names may have backslashes for slashes, or be paths into the folder of the
    photographs. Empty lines and lines with # are skipped, repeated pairs count once, in either
    order.

    Args:
        path: the list.
        names: of the images that may be in it.
        image_path: folder of the photographs; None: paths are refused.

    Returns:
        The pairs, sorted.

    Raises:
        OptionError: when there is no such file.
        AffrectError: when it is unreadable, or a name is not among ``names``.
    """
    ordered = sorted(set(names))
    folders = spellings(image_path) if image_path else ()
    found = _read_codes(path, ordered, folders)
    found.sort()  # np.unique takes seven times as much memory
    found = found[np.flatnonzero(np.diff(found, prepend=-1))]
    if not len(found):
        raise OptionError("holds no pair of two different images", where=path)
    numbers = np.empty((len(found), 2), np.int32)
    np.divmod(found, len(ordered), out=(numbers[:, 0], numbers[:, 1]), casting="unsafe")
    return PairList(ordered, numbers)


def read_pairs_once(
    path: Path, names: Sequence[str], image_path: Path | None = None
) -> PairList:
    """Return a pair list, read once while its size and times stay as they are.

    Args:
        path: the list.
        names: as for :func:`read_pairs`.
        image_path: as for :func:`read_pairs`.

    Returns:
        The pairs, sorted.

    Raises:
        AffrectError: as :func:`read_pairs` does.
    """
    return _read_once(path, stamp_of([path]), tuple(names), image_path)


@lru_cache(maxsize=4)
def _read_once(
    path: Path, _: str, names: tuple[str, ...], image_path: Path | None
) -> PairList:
    return read_pairs(path, names, image_path)


def _read_codes(path: Path, names: Sequence[str], folders: Sequence[str]) -> Indices:
    """Return each pair of a list as one number, as :func:`_codes` says, (N,).

    OptionError names the first line that is none.
    """
    problems: list[tuple[int, str]] = []
    try:
        with io.TextIOWrapper(open_regular(path), encoding="utf-8-sig") as file:
            lines = _lines(file)
            found = np.fromiter(_codes(lines, names, folders, problems), np.int64)
    except OSError as error:
        raise OptionError(f"cannot be read ({error.strerror})", where=path) from error
    except UnicodeDecodeError as error:
        raise not_utf_8(path) from error
    if problems:
        (line_number, line) = problems[0]
        more = len(problems) - 1
        least = "at least " if more == MAX_PROBLEMS else ""
        others = f", nor are {least}{more} more lines" if more else ""
        raise OptionError(
            f"line {line_number}: {clipped(repr(line), MAX_SHOWN)} is not two names "
            f"of images{_suggestion(line, names)}{others}",
            where=path,
        )
    return found


def _lines(file: TextIO) -> Iterator[str]:
    """Yield the lines of a list, of one that is too long for two names its beginning, and no more.

    A file without line ends may have any size. Long comments are gone over.
    """
    is_rest = False  # of a long comment
    line = file.readline(LONGEST_LINE + 1)
    while line:
        is_long = len(line) > LONGEST_LINE and not line.endswith("\n")
        says_nothing = not line.strip() or line.lstrip().startswith("#")
        if not is_rest and (not is_long or not says_nothing):
            yield line
            if is_long:
                return
        elif not is_long:
            yield "\n"
        is_rest = is_long
        line = file.readline(LONGEST_LINE + 1)


def _codes(
    lines: Iterable[str],
    names: Sequence[str],
    folders: Sequence[str],
    problems: list[tuple[int, str]],
) -> Iterator[int]:
    """Yield the pair of each line as one number, which takes little memory.

    That is the smaller index among N ``names`` times N, plus the larger one. ``problems`` gets the
    number and text of lines that are no pair.
    """
    number = {name: index for index, name in enumerate(names)}
    for line_number, line in _without_comments(lines, [*names, *folders]):
        pair = _pair_of_line(line, number, folders)
        if pair:
            low, high = sorted((number[pair[0]], number[pair[1]]))
            if low < high:
                yield low * len(names) + high
        elif line.strip() and not line.lstrip().startswith("#"):
            problems.append((line_number, line.strip()))
            if len(problems) > MAX_PROBLEMS:
                return


def _pair_of_line(
    line: str, number: Mapping[str, int], folders: Sequence[str]
) -> Pair | None:
    """Return the names of a line by any of the ways in which lists are written.

    Args:
        line: With its end.
        number: Has the names.
        folders: That paths may begin with.
    """
    pair = _two_words(line, number)
    pair = pair or split_line(line.rstrip("\n"), number)
    pair = pair or split_line(line.strip(), number)
    return pair or split_of_others(line, number, folders)


def _without_comments(
    lines: Iterable[str], beginnings: Iterable[str]
) -> Iterator[tuple[int, str]]:
    """Yield lines with their numbers, those with # only if one of some texts begins so, too."""
    are_told_apart = not any(text.lstrip().startswith("#") for text in beginnings)
    for line_number, line in enumerate(lines, start=1):
        if not (are_told_apart and line.lstrip().startswith("#")):
            yield line_number, line


def write_pairs(path: Path, pairs: Iterable[Pair], names: Iterable[str] = ()) -> None:
    """Write a line of two names for each pair, with a tab between if a name has white space.

    Args:
        path: the list, which is replaced as a whole.
        pairs: that are written in their order.
        names: of all images; needed where ``pairs`` is an iterator, which can be read only once.
    """
    if not names:
        pairs = list(pairs)
        names = set(itertools.chain.from_iterable(pairs))
    has_blanks = any(re.search(r"\s", name) for name in names)
    separator = "\t" if has_blanks else " "
    replace_text(path, (f"{first}{separator}{second}\n" for first, second in pairs))
    _read_once.cache_clear()  # it may have changed within one tick of the clock


def _two_words(line: str, known: Collection[str]) -> Pair | None:
    """Return the names of a line as most are, which can be split in one way only."""
    words = line.split()
    if len(words) != 2 or "," in line:
        return None
    first, second = words
    is_bare = line == f"{first} {second}\n"
    return (first, second) if is_bare and first in known and second in known else None


def split_line(line: str, known: Collection[str]) -> Pair | None:
    """Return the two names of a line, either of which may hold separators."""
    if len(line) > LONGEST_LINE:
        return None
    for separator in (r"\t", r"\s*[\t,]\s*|\s+", " "):
        for match in re.finditer(separator, line):
            first = line[: match.start()]
            second = line[match.end() :]
            if first in known and second in known:
                return first, second
    return None


def split_of_others(
    line: str, known: Collection[str], folders: Sequence[str]
) -> Pair | None:
    """Return the two names of a line that has a score, backslashes, or paths into a folder.

    Args:
        line: of a list.
        known: names that it may have.
        folders: how paths into the folder of the photographs begin (:func:`spellings`).
    """
    if len(line) > LONGEST_LINE:
        return None
    text = line.strip().replace("\\", "/")
    for folder in folders:
        text = re.sub(rf"(^|[\s,]){re.escape(folder)}/+", r"\1", text)
    text = re.sub(r"(^|[\s,])(?:\./+)+", r"\1", text)
    return split_line(text, known) or split_line(SCORE.sub("", text), known)


def spellings(folder: Path) -> tuple[str, ...]:
    """Return how the path of a folder may begin those of the files in it, the longest first."""
    paths = {folder, folder.absolute(), resolved(folder)}
    with suppress(FileNotFoundError):  # the current folder may have been removed
        here = Path.cwd()
        for path in tuple(paths):
            if path.is_relative_to(here):  # as a shell lists its files
                paths.add(path.relative_to(here))
    found = {path.as_posix() for path in paths} - {".", "/"}
    return tuple(sorted(found, key=len, reverse=True))


def _suggestion(line: str, names: Sequence[str]) -> str:
    known = set(names)
    words = line[:LONGEST_LINE].replace(",", " ").split()
    unknown = [word for word in words if word not in known]
    close = list[str]()
    for word in unknown[:MAX_SUGGESTIONS]:
        close += difflib.get_close_matches(word, names, n=1)
    return f" (did you mean {', '.join(close)}?)" if close else ""
