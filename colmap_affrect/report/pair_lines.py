"""The matches of all pairs as the page of a run draws them at a click, and files beside it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.pair_matches import MatchedPair, MatchKind, PairReader
from colmap_affrect.report.pictures import base64_text

MAX_NUM_LINES = 24_000  # of all pairs, 9 bytes each, while each pair has some; resource
MAX_NUM_LINES_OF_PAIR = 120  # more hide what is below them
MIN_NUM_LINES_OF_PAIR = 20  # fewer show little
# That are in the page, the strongest: all of 100 photographs, 1.2 MB; resource
MAX_NUM_PAIRS = 5_000
# Of a file beside the page, 1.6 MB: a browser reads it in less than a second; resource
NUM_PAIRS_OF_FILE = 5_000
# In files, the strongest: 100 for each of 2,000 photographs, 32 MB; resource
MAX_NUM_PAIRS_IN_FILES = 100_000
MOST = 65_535  # of a uint16


@dataclass(frozen=True)
class PairLines:
    """Lines of pairs."""

    # Numbers of the two photographs, number of lines, what is known of the pair, and whether the
    # rest of the model speaks for it
    pairs: list[tuple[int, int, int, str, bool]] = field(default_factory=list)
    # Base64: (L, 4) uint16 x and y in both photographs, 65535 at the right and lower border, then
    # (L,) uint8 kinds
    lines: str = ""

    def script_data(self) -> dict[str, Any]:
        """Return what the script of the page reads, as JSON has it."""
        return {"pairs": self.pairs, "lines": self.lines}


@dataclass(frozen=True)
class PairFile:
    """A file of lines beside the page: a script, since a page on a disk can read nothing else."""

    name: str
    # Numbers of the photographs of its first pair, the lower one first; the pairs go on in this
    # order from file to file
    first: tuple[int, int]


class LinesOfRun:
    """The lines of a run: those of the strongest pairs in the page, of the others in files.

    Attributes:
        in_page: the strongest pairs.
        in_files: the next ones, in the order of the files.
        num_left_out: how many pairs are in neither.
    """

    def __init__(
        self, reader: PairReader, names: Sequence[str], num_inliers: Mapping[Pair, int]
    ) -> None:
        """Choose which pairs go where.

        Args:
            reader: of the matches of a run.
            names: of all photographs, in the order of their numbers.
            num_inliers: of the verified pairs.
        """
        self._reader = reader
        self._index = {name: number for number, name in enumerate(names)}
        known = [pair for pair in num_inliers if {*pair} <= self._index.keys()]
        known.sort(key=lambda pair: -num_inliers[pair])
        end = MAX_NUM_PAIRS + MAX_NUM_PAIRS_IN_FILES
        self.in_page = sorted(known[:MAX_NUM_PAIRS])
        self.in_files = sorted(known[MAX_NUM_PAIRS:end], key=self._numbers_in_order)
        self.num_left_out = len(known[end:])

    def of_page(self) -> PairLines:
        """Read the lines of the pairs that are in the page."""
        return self._read(self.in_page, num_lines_of_pair(len(self.in_page)))

    def write_files(self, workspace: Workspace) -> list[PairFile]:
        """Write the lines of the other pairs into files beside the page.

        Args:
            workspace: of the run; files of an earlier page are no longer there.

        Returns:
            The files in the order of their pairs, none where the page has all.

        Raises:
            WorkspaceError: a file cannot be written.
        """
        written = list[PairFile]()
        for start in range(0, len(self.in_files), NUM_PAIRS_OF_FILE):
            pairs = self.in_files[start : start + NUM_PAIRS_OF_FILE]
            path = workspace.page_file(len(written) + 1)
            found = self._read(pairs, MIN_NUM_LINES_OF_PAIR)
            content = json.dumps(found.script_data())
            replace_text(path, f"page.takePairs({content});\n")
            written.append(PairFile(path.name, self._numbers_in_order(pairs[0])))
        return written

    def _numbers_in_order(self, pair: Pair) -> tuple[int, int]:
        """Return the numbers of two photographs, the lower one first."""
        numbers = (self._index[pair[0]], self._index[pair[1]])
        return min(numbers), max(numbers)

    def _read(self, pairs: Sequence[Pair], max_num_lines: int) -> PairLines:
        """Read at most so many lines of each pair."""
        self._reader.look_up_levels(pairs)
        found = PairLines()
        ends = [np.empty((0, 4), dtype="<u2")]
        kinds = [np.empty(0, dtype=np.uint8)]
        for pair in pairs:
            try:
                matched = self._reader.read(pair)
            except AffrectError:  # of a store that is damaged: the others are shown
                continue
            rows = _some_inliers(matched, max_num_lines)
            ends.append(_ends(matched, rows))
            kinds.append(matched.kinds[rows].astype(np.uint8))
            numbers = (self._index[pair[0]], self._index[pair[1]])
            found.pairs.append((*numbers, len(rows), matched.text, matched.is_backed))
        data = np.concatenate(ends).tobytes() + np.concatenate(kinds).tobytes()
        return PairLines(found.pairs, base64_text(data))


def num_lines_of_pair(num_pairs: int) -> int:
    """Return how many lines each of some pairs has at most."""
    fitting = MAX_NUM_LINES // max(1, num_pairs)
    return max(MIN_NUM_LINES_OF_PAIR, min(MAX_NUM_LINES_OF_PAIR, fitting))


def _some_inliers(pair: MatchedPair, max_num: int) -> Indices:
    """Return the rows of some matches that are not rejected, those by hand first."""
    is_kept = pair.kinds != MatchKind.REJECTED
    by_hand = np.flatnonzero(pair.kinds == MatchKind.BY_HAND)[:max_num]
    others = np.flatnonzero(is_kept & (pair.kinds != MatchKind.BY_HAND))
    num_others = min(len(others), max_num - len(by_hand))
    spread = np.linspace(0, len(others) - 1, num_others).astype(np.int64)
    return np.concatenate([by_hand, others[spread]])


def _ends(pair: MatchedPair, rows: Indices) -> Indices:
    """Return (R, 4) ends of lines, as shares of the photographs in steps of a uint16."""
    sides = []
    for points, size in zip(pair.points, pair.sizes, strict=True):
        shares = points[rows] / np.array(size)
        sides.append(np.rint(np.clip(shares, 0.0, 1.0) * MOST))
    ends: Indices = np.hstack(sides).astype("<u2")
    return ends
