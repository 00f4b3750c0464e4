"""Short lists for the ratio test, by cosines of descriptors in 8 bits.

Cosines of rounded descriptors say which features may pass the test, and what their neighbours may
be; only these are compared exactly. Six standard deviations of the rounding error are allowed for,
so that matches are those of exact cosines. torch is loaded where there is enough to match.
"""

import importlib
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bools, Bytes, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists
from colmap_affrect.parallel.executor import available_cores

# With fewer, loading torch takes longer than it saves (measured)
MIN_COMPARISONS_PER_CORE = 6e8
ERROR_SIGMAS = 6.0  # of the rounding error, allowed for on each side; theory
MAX_CODE = 127  # largest signed code; format
ZERO_CODE = 128  # signed code 0 as an unsigned one; format
# Of cosines: negative ones become 0, errors exceed 1 a little; numeric
CODE_STEP = 1.0 / 250
NUM_ROWS = 512  # compared at once, a multiple of ``SIZE_MULTIPLE``; resource
SIZE_MULTIPLE = 256
"""Both factors of a product are padded to a multiple of it: oneDNN prepares and keeps a program
for every size, and many sizes take memory and time; resource."""


@dataclass(frozen=True)
class ShortList:
    """Features that may pass the ratio test, and what may be their two nearest neighbours.

    Attributes:
        rows: (R,) int64 which of the features asked for may pass, rising.
        runners_up: (R,) int64 the second neighbour of each by coarse cosines.
        is_doubtful: (R,) bool whether its neighbours may not all be listed.
        entry_rows: (E,) int64 indices into ``rows``, rising.
        entry_columns: (E,) int64 features of the second image, rising in each row.
    """

    rows: Indices
    runners_up: Indices
    is_doubtful: Bools
    entry_rows: Indices
    entry_columns: Indices


@dataclass(frozen=True)
class CoarseDescriptors:
    """Descriptors as signed 8-bit numbers."""

    codes: NDArray[np.int8]  # (N, D) descriptors divided by ``step`` and rounded
    packed: Any  # the same as the second factor of products
    step: float  # the largest value over 127

    @classmethod
    def of(cls, descriptors: Singles) -> Self:
        """Round (N, D) unit rows."""
        step = max(float(np.abs(descriptors).max(initial=0.0)), 1e-6) / MAX_CODE
        codes = np.rint(descriptors / step).astype(np.int8)
        return cls(codes, _packed(codes), step)

    @property
    def nbytes(self) -> int:
        """Memory they take."""
        return 2 * self.codes.nbytes


def coarse_pays(num_comparisons: float) -> bool:
    """Tell whether coarse cosines save time, for the number of all pairs of features to come."""
    return _is_enough(num_comparisons) and has_fast_8_bit_products()


def load_meanwhile(num_comparisons: float) -> None:
    """Load torch in another thread where there will be enough to match.

    While features are extracted, which leaves Python alone for most of the time, that is over
    before it is missed.

    Args:
        num_comparisons: of pairs of features, at most.
    """
    if _is_enough(num_comparisons):
        load = threading.Thread(
            target=importlib.import_module, args=("torch",), daemon=True
        )
        load.start()


def _is_enough(num_comparisons: float) -> bool:
    return num_comparisons >= MIN_COMPARISONS_PER_CORE * available_cores()


def short_lists(
    codes: NDArray[np.int8],
    step: float,
    image: CoarseDescriptors,
    rivals: NeighborLists,
    max_ratio: float,
) -> Iterator[ShortList]:
    """Compare features of one image with all of another.

    Args:
        codes: (Q, D) descriptors of the features, divided by ``step`` and rounded.
        step: of these codes.
        image: all descriptors of the other image.
        rivals: for each feature of the other image those too near to be its second neighbour.
        max_ratio: of the distances to the first and the second neighbour.

    Yields:
        What may pass, for ``NUM_ROWS`` of the features at a time, if there are any.
    """
    # A rounding error is uniform: its standard deviation is a step over the root of 12.
    margin = ERROR_SIGMAS * math.hypot(step, image.step, CODE_STEP) / math.sqrt(12)
    unit = step * image.step
    for begin in range(0, len(codes), NUM_ROWS):
        cosine_codes = _cosine_codes(
            codes[begin : begin + NUM_ROWS], image.packed, unit
        )
        listed = _short_list(cosine_codes, margin, rivals, max_ratio)
        if len(listed.rows):
            yield replace(listed, rows=begin + listed.rows)


def _short_list(
    codes: Bytes, margin: float, rivals: NeighborLists, max_ratio: float
) -> ShortList:
    """Return what may pass the test, by (R, N) cosines over ``CODE_STEP``, which are changed.

    ``margin`` is the largest error of a cosine.
    """
    # Codes nearer to each other may be in the other order
    width = 2.0 * margin / CODE_STEP
    best, highest = _largest(codes)
    of_best = rivals.of(best)
    is_near_best = codes[of_best] >= highest[of_best[0]] - width
    codes[of_best] = 0
    runners_up, second_highest = _largest(codes)
    is_doubtful = _is_hidden(best, runners_up, of_best, is_near_best, rivals)
    is_doubtful |= second_highest <= width  # codes have no negative cosines
    least_distance = 1.0 - CODE_STEP * highest - margin
    largest_second = 1.0 - CODE_STEP * second_highest + margin
    passes = least_distance < max_ratio**2 * largest_second
    rows = np.flatnonzero(passes | is_doubtful)
    least_codes = np.maximum(second_highest[rows] - width, 1).astype(np.uint8)
    is_candidate = np.flatnonzero(codes[rows] >= least_codes[:, None])
    candidate_rows, candidates = np.divmod(is_candidate, codes.shape[1])
    rival_rows, rivals_of_best = rivals.of(best[rows])
    entry_rows = np.concatenate([candidate_rows, rival_rows])
    entry_columns = np.concatenate([candidates, rivals_of_best])
    # Far faster than an order by two keys
    entries = np.sort(entry_rows << 32 | entry_columns)
    return ShortList(
        rows, runners_up[rows], is_doubtful[rows], entries >> 32, entries & 0xFFFF_FFFF
    )


def _largest(codes: Bytes) -> tuple[Indices, Indices]:
    """Return the column of a largest code of each row, and the code."""
    columns = codes.argmax(axis=1)
    return columns, codes[np.arange(len(columns)), columns].astype(np.int64)


def _is_hidden(
    best: Indices,
    runners_up: Indices,
    of_best: tuple[Indices, Indices],
    is_near_best: Bools,
    rivals: NeighborLists,
) -> Bools:
    """Return where the second neighbour is not known, for each of R rows.

    A rival of the best may be nearer than it and have the runner-up, no rival of the best, for a
    rival; the second neighbour then may be far less similar.

    Args:
        best: (R,) the nearest feature of each row by coarse cosines.
        runners_up: (R,) the nearest of those that are no rivals of it.
        of_best: (E,) rows, and (E,) rivals of their nearest features.
        is_near_best: (E,) whether such a rival may be nearer than the nearest.
        rivals: those of every feature.
    """
    rows = of_best[0][is_near_best]
    columns = of_best[1][is_near_best]
    is_other = columns != best[rows]
    entries, rivals_of_other = rivals.of(columns[is_other])
    rows = rows[is_other][entries]
    is_hidden = np.zeros(len(best), np.bool_)
    is_hidden[rows[rivals_of_other == runners_up[rows]]] = True
    return is_hidden


def _packed(codes: NDArray[np.int8]) -> Any:
    """Return (N, D) codes as the second factor of products, in the library's own order."""
    import torch

    return torch.ops.onednn.qlinear_prepack(torch.from_numpy(_filled_up(codes)), None)


def _filled_up(codes: NDArray[np.int8]) -> NDArray[np.int8]:
    """Add rows of zeros to (N, D) codes up to a multiple of ``SIZE_MULTIPLE``."""
    num_missing = -len(codes) % SIZE_MULTIPLE
    return np.pad(codes, ((0, num_missing), (0, 0))) if num_missing else codes


def _cosine_codes(codes: NDArray[np.int8], packed: Any, unit: float) -> Bytes:
    """Return cosines over ``CODE_STEP`` of (R, D) and (N, D) codes, rounded: 0...255.

    Columns that ``packed`` was filled up with stay, as 0: numpy would copy before it looks for
    maxima. ``unit`` is the product of the codes 1 and 1.
    """
    import torch

    # Signed ones as the first factor are far slower.
    shifted = torch.from_numpy(_filled_up(codes).view(np.uint8) ^ ZERO_CODE)
    scale = torch.tensor([unit])
    zero = torch.zeros(1, dtype=torch.int32)
    product = torch.ops.onednn.qlinear_pointwise(
        shifted, 1.0, ZERO_CODE, packed, scale, zero, None,
        CODE_STEP, 0, torch.uint8, "none", [], "",
    )  # fmt: skip
    return np.asarray(product.numpy()[: len(codes)])


@cache
def has_fast_8_bit_products() -> bool:
    """Tell whether 8-bit products are fast here and right: old processors lose bits."""
    import torch

    if not torch.backends.cpu.get_cpu_capability().startswith("AVX512"):
        return False
    codes = np.full((64, 128), MAX_CODE, np.int8)
    codes[::2, ::3] = -MAX_CODE
    unit = 1.0 / (128 * MAX_CODE**2)
    try:
        found = _cosine_codes(codes, _packed(codes), unit)
    except (AttributeError, RuntimeError, TypeError):
        # It is another torch, or one built otherwise
        return False
    wide = codes.astype(np.int32)
    expected = np.maximum(unit / CODE_STEP * (wide @ wide.T), 0.0)
    return bool((np.abs(found[:, :64] - expected) < 0.501).all())
