"""Short lists for the ratio test, by similarities of descriptors in 8 bits.

Coarse similarities say which features may pass the test and what their neighbours may be; only
these are compared exactly. Six standard deviations of the rounding error are allowed for, so that
matches are those of exact similarities. torch is loaded where there is enough to match.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bools, Bytes, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists
from colmap_affrect.parallel.executor import available_cores, one_openmp_thread

MIN_SIMILARITIES_PER_CORE = 6e8  # with fewer, loading torch takes longer than it saves
ERROR_SIGMAS = 6.0  # of the rounding error, allowed for on each side
MAX_CODE, ZERO_CODE = 127, 128  # largest signed code; code 0 as an unsigned one
CODE_STEP = 1.0 / 250  # of similarities: negative ones become 0, errors exceed 1 a little
NUM_ROWS = 512  # compared at once, a multiple of ``SIZE_MULTIPLE``
SIZE_MULTIPLE = 256
"""Both factors of a product are padded to a multiple of it: oneDNN prepares and keeps a program
for every size, and many sizes take memory and time."""


@dataclass(frozen=True)
class ShortList:
    """Features that may pass the ratio test, and what may be their two nearest neighbours."""

    rows: Indices  # (R,) int64 which of the features asked for may pass, rising
    runners_up: Indices  # (R,) int64 the second neighbour of each by coarse similarities
    doubtful: Bools  # (R,) bool those whose neighbours may not all be listed
    entry_rows: Indices  # (E,) int64 indices into ``rows``, rising
    entry_columns: Indices  # (E,) int64 features of the second image, rising in each row


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


def coarse_pays(num_similarities: float) -> bool:
    """Return whether coarse similarities save time, for those of all pairs of features to come."""
    enough = num_similarities >= MIN_SIMILARITIES_PER_CORE * available_cores()
    return enough and has_fast_8_bit_products()


def short_lists(
    first: CoarseDescriptors,
    second: CoarseDescriptors,
    rows: Indices,
    rivals: NeighborLists,
    max_ratio: float,
) -> Iterator[ShortList]:
    """Compare some features of one image (``rows``) with all of another.

    ``rivals`` has for each feature of the other image those too close to be its second neighbour,
    ``max_ratio`` limits the ratio of the distances to the first and the second neighbour.
    """
    # A rounding error is uniform: its standard deviation is a step over the root of 12.
    margin = ERROR_SIGMAS * math.hypot(first.step, second.step, CODE_STEP) / math.sqrt(12)
    width = 2.0 * margin / CODE_STEP
    unit = first.step * second.step
    for begin in range(0, len(rows), NUM_ROWS):
        chosen = first.codes[rows[begin : begin + NUM_ROWS]]
        codes = _similarity_codes(chosen, second.packed, unit)
        best, highest = _largest(codes)
        of_best = rivals.of(best)
        is_close = codes[of_best] >= highest[of_best[0]] - width
        codes[of_best] = 0
        runners_up, second_highest = _largest(codes)
        doubtful = _is_hidden(best, runners_up, of_best, is_close, rivals)
        doubtful |= second_highest <= width  # codes have no negative similarities
        nearer, farther = CODE_STEP * highest, CODE_STEP * second_highest
        # sqrt((1 - nearer) / (1 - farther)) may be below the limit
        passing = 1.0 - nearer - margin < max_ratio**2 * (1.0 - farther + margin)
        may = np.flatnonzero(passing | doubtful)
        if not len(may):
            continue
        least = np.maximum(second_highest[may] - width, 1).astype(np.uint8)
        above = np.flatnonzero(codes[may] >= least[:, None])
        near = np.divmod(above, codes.shape[1])
        parts = zip(near, rivals.of(best[may]), strict=True)
        entry_rows, columns = (np.concatenate(part) for part in parts)
        entries = np.sort(entry_rows << 32 | columns)  # far faster than an order by two keys
        yield ShortList(
            begin + may, runners_up[may], doubtful[may], entries >> 32, entries & 0xFFFF_FFFF
        )


def _largest(codes: Bytes) -> tuple[Indices, Indices]:
    """Return the column of a largest code of each row, and the code."""
    columns = codes.argmax(axis=1)
    return columns, codes[np.arange(len(columns)), columns].astype(np.int64)


def _is_hidden(
    best: Indices,
    runners_up: Indices,
    of_best: tuple[Indices, Indices],
    is_close: Bools,
    rivals: NeighborLists,
) -> Bools:
    """Return where the second neighbour is not known, for each of R rows.

    A rival of the best may be nearer than it and have the runner-up, no rival of the best, for a
    rival; the second neighbour then may be far less similar.
    """
    rows, columns = (indices[is_close] for indices in of_best)
    is_other = columns != best[rows]
    entries, theirs = rivals.of(columns[is_other])
    hidden = np.zeros(len(best), dtype=bool)
    rows = rows[is_other][entries]
    hidden[rows[theirs == runners_up[rows]]] = True
    return hidden


def _packed(codes: NDArray[np.int8]) -> Any:
    """Return (N, D) codes as the second factor of products, in the library's own order."""
    import torch

    return torch.ops.onednn.qlinear_prepack(torch.from_numpy(_filled_up(codes)), None)


def _filled_up(codes: NDArray[np.int8]) -> NDArray[np.int8]:
    """Add rows of zeros to (N, D) codes up to a multiple of ``SIZE_MULTIPLE``."""
    return np.pad(codes, ((0, -len(codes) % SIZE_MULTIPLE), (0, 0)))


def _similarity_codes(codes: NDArray[np.int8], packed: Any, unit: float) -> Bytes:
    """Return similarities over ``CODE_STEP`` of (R, D) and (N, D) codes, rounded: 0...255.

    Columns that ``packed`` was filled up with stay, as 0: numpy would copy before it looks for
    maxima. ``unit`` is the similarity of the codes 1 and 1.
    """
    import torch

    # Signed ones as the first factor are far slower.
    shifted = torch.from_numpy(_filled_up(codes).view(np.uint8) ^ ZERO_CODE)
    scale, zero = torch.tensor([unit]), torch.zeros(1, dtype=torch.int32)
    with one_openmp_thread():
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
        found = _similarity_codes(codes, _packed(codes), unit)
    except (AttributeError, RuntimeError, TypeError):  # another torch, or one built otherwise
        return False
    wide = codes.astype(np.int32)
    expected = np.maximum(unit / CODE_STEP * (wide @ wide.T), 0.0)
    return bool((np.abs(found[:, :64] - expected) < 0.501).all())
