"""The matches of all pairs as the page of a run draws them at a click."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.report.pair_matches import MatchedPair, MatchKind, PairReader
from colmap_affrect.report.pictures import base64_text

MAX_NUM_LINES = 24_000  # of all pairs, 9 bytes each, while each pair has some; resource
MAX_NUM_LINES_OF_PAIR = 120  # more hide what is below them
MIN_NUM_LINES_OF_PAIR = 20  # fewer show little
# That a page draws, the strongest: all of 100 photographs, 1.2 MB and half a minute; resource
MAX_NUM_PAIRS = 5_000
MOST = 65_535  # of a uint16


@dataclass(frozen=True)
class PairLines:
    """Lines of pairs; the other pairs are drawn by ``colmap-affrect show-pair``."""

    # Numbers of the two photographs, number of lines, and what is known of the pair
    pairs: list[tuple[int, int, int, str]] = field(default_factory=list)
    # Base64: (L, 4) uint16 x and y in both photographs, 65535 at the right and lower border, then
    # (L,) uint8 kinds
    lines: str = ""

    def script_data(self) -> dict[str, Any]:
        """Return what the script of the page reads, as JSON has it."""
        return {"pairs": self.pairs, "lines": self.lines}


def lines_of_pairs(
    reader: PairReader, names: Sequence[str], num_inliers: Mapping[Pair, int]
) -> PairLines:
    """Read some inliers of each verified pair, or of the strongest ones where there are very many.

    Args:
        reader: of the matches of a run.
        names: of all photographs, in the order of their numbers.
        num_inliers: of the verified pairs.

    Returns:
        The lines, pair by pair.
    """
    index = {name: number for number, name in enumerate(names)}
    known = [pair for pair in num_inliers if {*pair} <= index.keys()]
    known.sort(key=lambda pair: -num_inliers[pair])
    shown = known[:MAX_NUM_PAIRS]
    num_lines = num_lines_of_pair(len(shown))
    reader.look_up_levels(shown)
    found = PairLines()
    ends = [np.empty((0, 4), dtype="<u2")]
    kinds = [np.empty(0, dtype=np.uint8)]
    for pair in sorted(shown):
        try:
            matched = reader.read(pair)
        except AffrectError:  # of a store that is damaged: the others are shown
            continue
        rows = _some_inliers(matched, num_lines)
        ends.append(_ends(matched, rows))
        kinds.append(matched.kinds[rows].astype(np.uint8))
        numbers = (index[pair[0]], index[pair[1]])
        found.pairs.append((*numbers, len(rows), matched.text))
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
