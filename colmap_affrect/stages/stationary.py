"""Matches that never move: captions, frames of scans, watermarks, dust on the sensor.

Such a thing is at the same place of many photographs, whatever they show. Its matches fit a
camera that does not move, and may be more than those of the scene.
"""

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from colmap_affrect.data import Mask
from colmap_affrect.geometry.arrays import Floats, Indices
from colmap_affrect.images.reading import grown
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.stores import STATIONARY, FeatureStore, MatchStore, PairMatches

logger = logging.getLogger(__name__)

MAX_MOTION_FRAC = 0.005  # of the longer side; less is no motion: scans are not cut to the pixel
NUM_CELLS = 48  # cells along the longer side
MIN_NUM_PAIRS = 3
MIN_NUM_IMAGES = 3
"""Two views of a camera that did not turn have places that stay where they are; more have none."""
MIN_SHARE = 0.5  # of the pairs that have a match in a cell
MAX_SHARE_OF_PHOTOGRAPH = 0.5  # where more of what is matched never moves, the camera stands still
MAX_SHARE_BESIDE = 0.2
"""Of all cells. Matches from beside one place to beside another are left out only where these cells
are so few: one in 25 of the scene's goes with them then, and of a watermark all over, all would."""

Size = tuple[int, int]


class StationaryFilter:
    """Drops the matches of pairs that lie where nothing moves.

    Where that is the file of matches knows, as long as it exists.
    """

    def __init__(self, features: FeatureStore, matches: MatchStore) -> None:
        """Name the files; what is known of places is read now."""
        self._features, self._matches = features, matches
        self._points = lru_cache(256)(lambda name: features.read_frames(name)[:, :, 2])
        kept = matches.note(STATIONARY) or []  # the (N, 2) cells, column and row, by size
        self._places: dict[Size, Mask] = {
            tuple(size): _mask(np.array(cells, np.int64).reshape(-1, 2)) for size, cells in kept
        }

    @cached_property
    def _sizes(self) -> dict[str, Size]:
        return self._features.image_sizes()

    def filtered(self, found: PairMatches) -> PairMatches:
        """Return the matches of a pair without those of captions, frames and watermarks."""
        left = self.left(found.names, found.indices)
        return replace(found, indices=found.indices[left], scores=found.scores[left])

    def left(self, names: Pair, indices: Indices) -> Mask:
        """Return which (M, 2) matches of a pair are kept.

        Left out is what does not move at a place where nothing does, or beside it, since what is
        faint matches less; and what goes from one such place to another, as of equal letters.
        """
        size = self._common_size(names) if self._places else None
        if size is None or size not in self._places:
            return np.ones(len(indices), bool)
        still, first, second = self._still(names, indices, size)
        places = self._places[size]
        near = grown(places, 1)
        both = near if near.mean() <= MAX_SHARE_BESIDE else places
        return ~(still & _at(near, first) | _at(both, first) & _at(both, second))

    def learn(self, pairs: Sequence[Pair]) -> str:
        """Look for places in all matches, and drop those there; return a line, empty if none.

        A call that was killed may have dropped some: what it found is on record and counts too.
        """
        for size, places in self._find(pairs).items():
            if places.any():
                self._places[size] = places | self._places.get(size, places)
        if not self._places:
            return ""
        kept = [(size, np.argwhere(found.T).tolist()) for size, found in self._places.items()]
        self._matches.keep_note(STATIONARY, kept)
        num_pairs = num_matches = 0
        for pair in pairs:
            (before,) = self._matches.read([pair])
            after = self.filtered(before)
            if len(after.indices) < len(before.indices):
                self._matches.write([after])
                num_pairs += 1
                num_matches += len(before.indices) - len(after.indices)
        if not num_pairs:
            return ""
        return (
            f"{num_matches} matches of {num_pairs} pairs never move (a caption, a frame or a "
            "watermark?) and were left out (--set matching.filter_stationary_matches=false keeps "
            "them)"
        )

    def _find(self, pairs: Sequence[Pair]) -> dict[Size, Mask]:
        """Return a mask of the cells in which nothing moves, by size."""
        numbers = {name: number for number, name in enumerate(self._sizes)}
        cells = NUM_CELLS, NUM_CELLS
        # By size and cell: numbers of pairs with a match, and with one that does not move; images.
        matched: dict[Size, Indices] = defaultdict(lambda: np.zeros(cells, np.int64))
        still: dict[Size, Indices] = defaultdict(lambda: np.zeros(cells, np.int64))
        images: dict[Size, Mask] = defaultdict(lambda: np.zeros((*cells, len(numbers)), bool))
        for found in self._matches.read([pair for pair in pairs if self._common_size(pair)]):
            size = self._sizes[found.names[0]]
            are_still, first, _ = self._still(found.names, found.indices, size)
            matched[size] += _mask(first)
            unmoved = _mask(first[are_still])
            still[size] += unmoved
            for name in found.names:
                images[size][unmoved, numbers[name]] = True
        return {size: _places(matched[size], still[size], images[size].sum(2)) for size in matched}

    def _still(self, names: Pair, indices: Indices, size: Size) -> tuple[Mask, Indices, Indices]:
        """Return which matches do not move; also the (M, 2) cells, column and row, of both ends."""
        first, second = (self._points(name)[indices[:, side]] for side, name in enumerate(names))
        motion = np.linalg.norm(second - first, axis=1)
        return motion <= MAX_MOTION_FRAC * max(size), _cells(first, size), _cells(second, size)

    def _common_size(self, pair: Pair) -> Size | None:
        size = self._sizes[pair[0]]
        return size if size == self._sizes[pair[1]] else None


def _cells(points: Floats, size: Size) -> Indices:
    """Return the (N, 2) cells, column and row, of (N, 2) points in pixel-centre px."""
    inside = np.clip(points, 0.0, np.array(size) - 1.0)
    return np.asarray(inside * (NUM_CELLS / max(size)), np.int64)


def _places(matched: Indices, still: Indices, num_images: Indices) -> Mask:
    """Return the cells that nothing moves in; none where that is most of a photograph."""
    found = (still >= MIN_NUM_PAIRS) & (still >= MIN_SHARE * matched)
    found &= num_images >= MIN_NUM_IMAGES
    num_matched = np.count_nonzero(matched >= MIN_NUM_PAIRS)
    is_most = np.count_nonzero(found) > MAX_SHARE_OF_PHOTOGRAPH * num_matched
    return np.zeros_like(found) if is_most else found


def _mask(cells: Indices) -> Mask:
    """Return a mask of (N, 2) cells, column and row."""
    mask = np.zeros((NUM_CELLS, NUM_CELLS), bool)
    mask[cells[:, 1], cells[:, 0]] = True
    return mask


def _at(mask: Mask, cells: Indices) -> Mask:
    """Look up (N, 2) cells, column and row."""
    return np.asarray(mask[cells[:, 1], cells[:, 0]])
