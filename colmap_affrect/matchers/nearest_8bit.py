"""Which features may pass the ratio test, by similarities of descriptors in 8 bits.

Only these are compared exactly. Three standard deviations of the rounding error are allowed for, so
that matches are those of exact similarities, but for one in many thousands. torch is loaded where
there is enough to match to pay for that.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bytes, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists
from colmap_affrect.parallel.executor import available_cores, one_openmp_thread

MIN_SIMILARITIES_PER_CORE = 6e8  # with fewer, loading torch takes longer than it saves
ERROR_SIGMAS = 3.0  # of the rounding error, allowed for on each side
MAX_CODE, ZERO_CODE = 127, 128  # largest signed code; code 0 as an unsigned one
CODE_STEP = 1.0 / 250  # of similarities: negative ones become 0, errors exceed 1 a little
NUM_ROWS = 512  # compared at once, a multiple of ``SIZE_MULTIPLE``
SIZE_MULTIPLE = 256
"""Both factors of a product are padded to a multiple of it: oneDNN prepares and keeps a program
for every size, and many sizes take memory and time."""


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


def may_match(
    first: CoarseDescriptors, second: CoarseDescriptors, rivals: NeighborLists, max_ratio: float
) -> Indices:
    """Return the features of one image that may pass the ratio test among those of another.

    ``rivals`` has for each feature of the other image those too close to be its second neighbour,
    ``max_ratio`` limits the ratio of the distances to the first and the second neighbour.
    """
    # A rounding error is uniform: its standard deviation is a step over the root of 12.
    margin = ERROR_SIGMAS * math.hypot(first.step, second.step, CODE_STEP) / math.sqrt(12)
    width = 2.0 * margin / CODE_STEP
    found = []
    for begin in range(0, len(first.codes), NUM_ROWS):
        chosen = first.codes[begin : begin + NUM_ROWS]
        codes = _similarity_codes(chosen, second.packed, first.step * second.step)
        rows, best = np.arange(len(codes)), codes.argmax(axis=1)
        highest = codes[rows, best].astype(np.int64)
        of_best = rivals.of(best)
        is_close = codes[of_best] >= highest[of_best[0]] - width
        # A rival that is as near may be the nearest, and have the second neighbour for a rival.
        doubtful = np.bincount(of_best[0][is_close], minlength=len(rows)) > 1
        codes[of_best] = 0
        second_highest = codes.max(axis=1).astype(np.int64)
        doubtful |= second_highest <= width  # codes have no negative similarities
        nearer, farther = CODE_STEP * highest, CODE_STEP * second_highest
        # sqrt((1 - nearer) / (1 - farther)) may be below the limit
        passing = 1.0 - nearer - margin < max_ratio**2 * (1.0 - farther + margin)
        found.append(begin + np.flatnonzero(passing | doubtful))
    return np.concatenate(found)


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
