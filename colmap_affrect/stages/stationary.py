"""Matches that never move: captions, frames of scans, watermarks, dust on the sensor, backgrounds.

Such a thing is at the same place of many photographs, whatever they show. Its matches fit a
camera that does not move, and may be more than those of the scene. So may those of the background
where an object turns before a camera that stands still. What a camera turns about is also at the
same place, but not to the pixel: see :mod:`colmap_affrect.geometry.stationary`.
"""

import logging
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from colmap_affrect.colmap.database_verification import NUM_CACHED_IMAGES
from colmap_affrect.data import Mask
from colmap_affrect.errors import damage, how_to_make_again
from colmap_affrect.geometry.arrays import Array, Floats, Indices
from colmap_affrect.geometry.stationary import (
    means_of_regions,
    num_moving_together,
    stationary_log_ratios,
)
from colmap_affrect.images.masks import grow_mask
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_state import Size
from colmap_affrect.project.match_store import MatchStore, PairMatches
from colmap_affrect.project.stage_warnings import StageWarning

logger = logging.getLogger(__name__)

# Of the longer side; less is no motion: scans are not cut to the pixel; judged
MAX_MOTION_FRAC = 0.005
NUM_CELLS = 48  # cells along the longer side; resource
MIN_NUM_PAIRS = 3  # theory
# Theory
MIN_NUM_IMAGES = 3
"""Two views of a camera that did not turn have places that stay where they are; more have none."""
MIN_SHARE = 0.5  # of the pairs that have a match in a cell; theory
MIN_PX = 1.0  # theory
MIN_FRAC = 0.001
"""Error of what stands still, px, or part of the longer side if that is more: large photographs are
shrunk before features are found in them; judged."""
CONNECTED = 1  # cells by which those are grown that are looked at together; theory
# Nats, twenty to one, that a place stands still to the pixel; theory
MIN_EVIDENCE = 3.0
# Where more of what is matched never moves, the camera stands still; theory
MAX_SHARE_OF_PHOTOGRAPH = 0.5
# Matches of a pair that move together elsewhere, which may make a model; COLMAP's min_num_matches
MIN_MOVING = 15
MAX_SHARE_BESIDE = 0.2
"""Of all cells. Matches from beside one place to beside another, or from one to another, are left
out only where these cells are so few: one in 25 of the scene's goes with them then, and of a
watermark all over, or before a background, all would; judged."""

MIN_SHARE_OF_BACKGROUND = 0.8
"""Matches that stand still, of all matches of one photograph in a cell that shows the background
there, four in five: where something turns before it, they move (judged)."""

SUBJECT = "matches"  # of the warnings


@dataclass(frozen=True)
class _StillCells:
    """Cells of photographs of one size."""

    still: Mask  # nothing moves there, to the pixel
    # Whether most cells with matches are such, or cells where nothing moves far
    still_are_most: bool
    nearly_still_are_most: bool


@dataclass(frozen=True)
class _Votes:
    """Matches of one photograph by cell, in which it shows what stands still, or something else."""

    still: Indices
    moving: Indices

    @classmethod
    def none(cls) -> "_Votes":
        """Return no votes."""
        return cls(*np.zeros((2, NUM_CELLS, NUM_CELLS), np.int64))

    def background(self, places: Mask) -> Mask:
        """Return the cells, of places where nothing moves, that show what stands still."""
        is_most = self.still >= MIN_SHARE_OF_BACKGROUND * (self.still + self.moving)
        has_enough = self.still >= MIN_NUM_PAIRS  # matches: as many as pairs elsewhere
        return places & is_most & has_enough


@dataclass(frozen=True)
class _MatchedCells:
    """Where M matches of a pair of photographs of one size are, and which of them move."""

    are_still: Mask  # (M,) move next to nothing
    first: Indices  # (M, 2) cells, column and row, in the first photograph
    second: Indices  # (M, 2) cells in the second one


class StationaryFilter:
    """Drops the matches of pairs that lie where nothing moves.

    Where that is, it reads from the file of matches when it is made; `learn` finds it and puts it
    on record there.
    """

    def __init__(self, features: FeatureStore, matches: MatchStore) -> None:
        """Name the files; what is known of places is read now."""
        self._features = features
        self._matches = matches
        self._points = lru_cache(NUM_CACHED_IMAGES)(self._read_points)
        self._still_masks = dict[Size, Mask]()
        self._backgrounds = dict[str, Mask]()
        state = matches.state
        self._of_still_cameras = set(state.still_cameras)
        with damage(matches.path, how_to_make_again("match", matches.path.parent)):
            for size, cells in state.stationary:
                self._still_masks[size] = _mask(
                    np.array(cells, np.int64).reshape(-1, 2)
                )
            for name, packed in state.backgrounds:
                self._backgrounds[name] = _unpacked(packed)

    @cached_property
    def _sizes(self) -> dict[str, Size]:
        return self._features.image_sizes()

    def _read_points(self, name: str) -> Floats:
        """Return the (N, 2) keypoints of an image in pixel-centre px."""
        return self._features.read_frames(name)[:, :, 2]

    def without_stationary(self, found: PairMatches) -> PairMatches:
        """Return the matches of a pair without those of captions, frames and watermarks."""
        left = self.keep_mask(found.names, found.indices)
        return replace(found, indices=found.indices[left], scores=found.scores[left])

    def keep_mask(self, names: Pair, indices: Indices) -> Mask:
        """Return which matches of a pair are kept.

        Left out is what does not move at a place where nothing does, or beside it, since what is
        faint matches less; and what goes from one such place to another, as of equal letters. Of a
        pair that shows the same background, also what begins or ends on it, as of equal windows;
        and what does not move to the pixel, where the camera stood still.

        Args:
            names: of both images.
            indices: (M, 2) int64 numbers of their features.

        Returns:
            (M,) bool.
        """
        size = self._common_size(names) if self._still_masks else None
        if size is None or size not in self._still_masks:
            return np.ones(len(indices), bool)
        matched = self._matched_cells(names, indices, size)
        places = self._still_masks[size]
        near = grow_mask(places, 1)
        begins_near = _at(near, matched.first)
        dropped = matched.are_still & begins_near
        dropped |= _goes_between(matched, places, near)
        of_background = self._of_background(names, matched)
        num_at_rest = np.count_nonzero(of_background & matched.are_still)
        num_moving = np.count_nonzero(of_background & ~matched.are_still)
        if num_at_rest > num_moving:
            dropped |= of_background
            if size in self._of_still_cameras:
                dropped |= self._motions(names, indices) <= _tolerance_px(size)
        return ~dropped

    def _of_background(self, names: Pair, matched: _MatchedCells) -> Mask:
        """Return which matches have an end where its photograph shows what stands still."""
        found = np.zeros(len(matched.first), bool)
        for name, cells in zip(names, (matched.first, matched.second), strict=True):
            background = self._backgrounds.get(name)
            if background is not None:
                found |= _at(background, cells)
        return found

    def learn(self, pairs: Sequence[Pair]) -> list[StageWarning]:
        """Look for places in all matches, and drop those there; return a warning, or none.

        A call that was killed may have dropped some: what it found is on record and counts too.
        """
        found = self._find(pairs)
        still_camera = list[StageWarning]()
        for size, places in found.items():
            if not places.still.any():
                continue
            if places.nearly_still_are_most and not self._moves_elsewhere(
                pairs, size, places=places.still
            ):
                still_camera = [StageWarning("camera_stands_still", SUBJECT)]
            else:
                self._still_masks[size] = places.still | self._still_masks.get(
                    size, places.still
                )
                if places.still_are_most:
                    self._of_still_cameras.add(size)
        if not self._still_masks:
            return still_camera
        self._learn_backgrounds(pairs)
        self._record()
        num_pairs = num_matches = 0
        for pair in pairs:
            (before,) = self._matches.read([pair])
            after = self.without_stationary(before)
            if len(after.indices) < len(before.indices):
                self._matches.write([after])
                num_pairs += 1
                num_matches += len(before.indices) - len(after.indices)
        if not num_pairs:
            return still_camera
        values: dict[str, int | str] = {
            "num_matches": num_matches,
            "num_pairs": num_pairs,
        }
        return [StageWarning("stationary_matches", SUBJECT, values)]

    def _learn_backgrounds(self, pairs: Sequence[Pair]) -> None:
        """Find where each photograph shows what stands still, and nothing that hides it."""
        votes: dict[str, _Votes] = defaultdict(_Votes.none)
        of_sizes = [
            pair for pair in pairs if self._common_size(pair) in self._still_masks
        ]
        for found in self._matches.read(of_sizes):
            size = self._sizes[found.names[0]]
            matched = self._matched_cells(found.names, found.indices, size)
            both = (matched.first, matched.second)
            for name, cells in zip(found.names, both, strict=True):
                votes[name].still[:] += _counts(cells[matched.are_still])
                votes[name].moving[:] += _counts(cells[~matched.are_still])
        for name, of_image in votes.items():
            background = of_image.background(self._still_masks[self._sizes[name]])
            if background.any():
                self._backgrounds[name] = background | self._backgrounds.get(
                    name, background
                )

    def _record(self) -> None:
        """Put what is known on record."""
        kept = []
        for size, mask in self._still_masks.items():
            kept.append((size, tuple(map(tuple, np.argwhere(mask.T).tolist()))))
        packed = []
        for name, background in self._backgrounds.items():
            packed.append((name, _packed(background)))
        self._matches.update_state(
            stationary=tuple(kept),
            still_cameras=tuple(sorted(self._of_still_cameras)),
            backgrounds=tuple(packed),
        )

    def _find(self, pairs: Sequence[Pair]) -> dict[Size, "_StillCells"]:
        """Return the cells in which nothing moves, by size."""
        numbers = dict[str, int]()
        num_images = Counter[Size]()
        for name, size in self._sizes.items():
            numbers[name] = num_images[size]
            num_images[size] += 1
        cells = NUM_CELLS, NUM_CELLS
        # By size and cell: numbers of pairs with a match, and with one that does not move; images.
        num_matched: dict[Size, Indices] = defaultdict(
            lambda: np.zeros(cells, np.int64)
        )
        num_still: dict[Size, Indices] = defaultdict(lambda: np.zeros(cells, np.int64))
        images = dict[Size, Mask]()
        for found in self._matches.read(list(filter(self._common_size, pairs))):
            size = self._sizes[found.names[0]]
            matched = self._matched_cells(found.names, found.indices, size)
            num_matched[size] += _mask(matched.first)
            unmoved = _mask(matched.first[matched.are_still])
            num_still[size] += unmoved
            if size not in images:
                images[size] = np.zeros((*cells, num_images[size]), bool)
            for name in found.names:
                images[size][unmoved, numbers[name]] = True
        places = {}
        for size, counts in num_matched.items():
            likely = num_still[size] >= MIN_NUM_PAIRS
            likely &= num_still[size] >= MIN_SHARE * counts
            likely &= images[size].sum(2) >= MIN_NUM_IMAGES
            if likely.any():
                exact = self._evidence(pairs, size, likely) >= MIN_EVIDENCE
                limit = MAX_SHARE_OF_PHOTOGRAPH * (counts >= MIN_NUM_PAIRS).sum()
                places[size] = _StillCells(
                    still=likely & exact,
                    still_are_most=bool((likely & exact).sum() > limit),
                    nearly_still_are_most=bool(likely.sum() > limit),
                )
        return places

    def _evidence(self, pairs: Sequence[Pair], size: Size, likely: Mask) -> Array:
        """Return for each likely cell how much speaks for what does not move at all, in nats.

        It is the less of what the cell says, and all that moves little in connection with it: a
        camera that turns about an upright line has a narrow strip that hardly moves, and beside it
        what moves more and more. Each counts once in a pair: matches there err together.
        """
        limit_px = MAX_MOTION_FRAC * max(size)
        tolerance_px = _tolerance_px(size)
        of_cells: Array = np.zeros((NUM_CELLS, NUM_CELLS))
        of_regions: Array = np.zeros((NUM_CELLS, NUM_CELLS))
        for found in self._matches_of_size(pairs, size):
            matched = self._matched_cells(found.names, found.indices, size)
            cells = matched.first[matched.are_still]
            if not _at(likely, cells).any():
                continue
            still_indices = found.indices[matched.are_still]
            points, others = self._ends(found.names, still_indices)
            ratios = stationary_log_ratios(
                points,
                motions=others - points,
                tolerance_px=tolerance_px,
                limit_px=limit_px,
            )
            of_cells += _means(cells, ratios)
            connected = means_of_regions(
                cells, values=ratios, num_cells=NUM_CELLS, reach=CONNECTED
            )
            of_regions += _means(cells, connected)
        return np.minimum(of_cells, of_regions)

    def _moves_elsewhere(self, pairs: Sequence[Pair], size: Size, places: Mask) -> bool:
        """Tell whether enough matches of some pairs move together outside of places."""
        num_pairs = 0
        names = set[str]()
        for found in self._matches_of_size(pairs, size):
            matched = self._matched_cells(found.names, found.indices, size)
            in_places = _at(places, matched.first) | _at(places, matched.second)
            are_moving = ~(matched.are_still | in_places)
            points, others = self._ends(found.names, found.indices[are_moving])
            num_together = num_moving_together(
                points, motions=others - points, radius_px=max(size) / NUM_CELLS
            )
            if num_together >= MIN_MOVING:
                num_pairs += 1
                names.update(found.names)
        return num_pairs >= MIN_NUM_PAIRS and len(names) >= MIN_NUM_IMAGES

    def _matches_of_size(
        self, pairs: Sequence[Pair], size: Size
    ) -> Iterator[PairMatches]:
        """Return the matches of the pairs whose photographs both have a size."""
        of_size = [pair for pair in pairs if self._common_size(pair) == size]
        return self._matches.read(of_size)

    def _matched_cells(
        self, names: Pair, indices: Indices, size: Size
    ) -> _MatchedCells:
        """Return where (M, 2) matches of photographs of one size are, and which of them move."""
        first, second = self._ends(names, indices)
        motions = self._motions(names, indices)
        return _MatchedCells(
            are_still=motions <= MAX_MOTION_FRAC * max(size),
            first=_cells(first, size),
            second=_cells(second, size),
        )

    def _motions(self, names: Pair, indices: Indices) -> Array:
        """Return the (M,) px by which matches move."""
        first, second = self._ends(names, indices)
        return np.asarray(np.linalg.norm(second - first, axis=1))

    def _ends(self, names: Pair, indices: Indices) -> tuple[Floats, Floats]:
        """Return the (M, 2) px of matches in both images."""
        first = self._points(names[0])[indices[:, 0]]
        second = self._points(names[1])[indices[:, 1]]
        return first, second

    def _common_size(self, pair: Pair) -> Size | None:
        size = self._sizes[pair[0]]
        return size if size == self._sizes[pair[1]] else None


def _goes_between(matched: _MatchedCells, places: Mask, near: Mask) -> Mask:
    """Return which matches go from one place, or beside it, to another one; none of large places.

    Args:
        matched: The matches.
        places: Cells where nothing moves.
        near: These, and the cells beside them.
    """
    share_near = near.mean()
    if share_near <= MAX_SHARE_BESIDE:
        return _at(near, matched.first) & _at(near, matched.second)
    if places.mean() <= MAX_SHARE_BESIDE:
        return _at(places, matched.first) & _at(places, matched.second)
    return np.zeros(len(matched.first), bool)


def _tolerance_px(size: Size) -> float:
    """Return the error of what stands still."""
    return max(MIN_PX, MIN_FRAC * max(size))


def _cells(points: Floats, size: Size) -> Indices:
    """Return the (N, 2) cells, column and row, of (N, 2) points in pixel-centre px."""
    inside = np.clip(points, 0.0, np.array(size) - 1.0)
    return np.asarray(inside * (NUM_CELLS / max(size)), np.int64)


def _means(cells: Indices, values: Array) -> Array:
    """Return the mean of (N,) values by cell, 0 where there are none.

    Cells are (N, 2) columns and rows; what is returned has a row and a column for each.
    """
    numbers = cells[:, 1] * NUM_CELLS + cells[:, 0]
    sums = np.bincount(numbers, values, minlength=NUM_CELLS**2)
    counts = np.bincount(numbers, minlength=NUM_CELLS**2)
    return np.asarray((sums / np.maximum(counts, 1)).reshape(NUM_CELLS, NUM_CELLS))


def _counts(cells: Indices) -> Indices:
    """Return how many of (N, 2) cells, column and row, are the same; a row and column for each."""
    numbers = cells[:, 1] * NUM_CELLS + cells[:, 0]
    return np.bincount(numbers, minlength=NUM_CELLS**2).reshape(NUM_CELLS, NUM_CELLS)


def _packed(mask: Mask) -> str:
    """Return a mask as hexadecimal digits, a bit for each cell."""
    return np.packbits(mask).tobytes().hex()


def _unpacked(digits: str) -> Mask:
    """Return what :func:`_packed` made into digits."""
    packed = np.frombuffer(bytes.fromhex(digits), np.uint8)
    bits = np.unpackbits(packed, count=NUM_CELLS**2)
    return bits.astype(bool).reshape(NUM_CELLS, NUM_CELLS)


def _mask(cells: Indices) -> Mask:
    """Return a mask of (N, 2) cells, column and row."""
    mask = np.zeros((NUM_CELLS, NUM_CELLS), bool)
    mask[cells[:, 1], cells[:, 0]] = True
    return mask


def _at(mask: Mask, cells: Indices) -> Mask:
    """Look up (N, 2) cells, column and row."""
    return np.asarray(mask[cells[:, 1], cells[:, 0]])
