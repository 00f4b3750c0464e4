"""Short lists for the ratio test, by similarities of descriptors in 8 bits (CPU) or 16 bits (GPU).

Few features pass the test. Coarse similarities say which may, and which features may be their two
nearest neighbours; only these are compared exactly. Six standard deviations of the rounding error
are allowed for, so that matches are those of exact similarities. A run of ten photographs without
8-bit products takes 1.7 times the processor time and 1.4 times as long (Sceaux, default recipe).

torch is loaded here, when there is enough to match to pay for that.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bools, Bytes, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists
from colmap_affrect.parallel.executor import available_cores, one_openmp_thread

MIN_SIMILARITIES_PER_CORE = 6e8  # with fewer, loading torch takes longer than it saves
ERROR_SIGMAS = 6.0  # of the rounding error, allowed for on each side
MAX_CODE, ZERO_CODE = 127, 128  # largest signed code; code 0 as an unsigned one
CODE_STEP = 1.0 / 250  # of 8-bit similarities: negative ones become 0, errors exceed 1 a little
SIZE_MULTIPLE = 256
"""Both factors of a product are padded to a multiple of it: oneDNN prepares and keeps a program
for every size, and many sizes take memory and time."""
HALF_ERROR = 2.0**-11  # standard deviation, rounded up, of similarities in 16 bits
TAKEN_OUT = -4.0  # less than any similarity


@dataclass(frozen=True)
class ShortList:
    """Features that may pass the ratio test, and what may be their two nearest neighbours."""

    rows: Indices  # (R,) int64 which of the features asked for may pass, rising
    runners_up: Indices  # (R,) int64 the second neighbour of each by coarse similarities
    doubtful: Bools  # (R,) bool those whose neighbours may not all be listed
    entry_rows: Indices  # (E,) int64 indices into ``rows``, rising
    entry_columns: Indices  # (E,) int64 features of the second image, rising in each row


class ByteSimilarities:
    """(R, N) similarities as 8-bit codes, on the CPU."""

    def __init__(self, codes: Bytes) -> None:
        self.codes = codes

    def largest(self) -> tuple[Indices, Indices]:
        """Return the column of a largest similarity of each row, and its code."""
        columns = self.codes.argmax(axis=1)
        return columns, self.codes[np.arange(len(columns)), columns].astype(np.int64)

    def take_out(self, rows: Indices, columns: Indices) -> Bytes:
        """Make some similarities 0; return what they were."""
        before = self.codes[rows, columns]
        self.codes[rows, columns] = 0
        return before

    def at_least(self, rows: Indices, least: Singles) -> tuple[Indices, Indices]:
        """Return where some rows reach a limit each: indices into ``rows``, and columns."""
        above = self.codes[rows] >= np.maximum(least, 1).astype(np.uint8)[:, None]
        index, columns = np.divmod(np.flatnonzero(above), above.shape[1])
        return index, columns


class HalfSimilarities:
    """(R, N) similarities in 16 bits on a GPU; methods as those of :class:`ByteSimilarities`."""

    def __init__(self, values: Any) -> None:
        self.values = values

    def _there(self, array: NDArray[Any]) -> Any:
        import torch

        return torch.from_numpy(array).to(self.values.device)

    def largest(self) -> tuple[Indices, Singles]:
        """See :class:`ByteSimilarities`."""
        values, columns = self.values.max(dim=1)
        return columns.cpu().numpy(), values.float().cpu().numpy()

    def take_out(self, rows: Indices, columns: Indices) -> Singles:
        """See :class:`ByteSimilarities`."""
        places = self._there(rows), self._there(columns)
        before = self.values[places].float().cpu().numpy()
        self.values[places] = TAKEN_OUT
        return np.asarray(before)

    def at_least(self, rows: Indices, least: Singles) -> tuple[Indices, Indices]:
        """See :class:`ByteSimilarities`."""
        above = self.values[self._there(rows)] >= self._there(least.astype(np.float32))[:, None]
        index, columns = (found.cpu().numpy() for found in above.nonzero(as_tuple=True))
        return index, columns


@dataclass(frozen=True)
class EightBitDescriptors:
    """Descriptors as signed 8-bit numbers, on the CPU."""

    codes: NDArray[np.int8]  # (N, D) descriptors divided by ``step`` and rounded
    packed: Any  # the same as the second factor of products
    step: float  # the largest value over 127

    num_rows: ClassVar[int] = 512  # compared at once, a multiple of ``SIZE_MULTIPLE``
    unit: ClassVar[float] = CODE_STEP  # of similarities

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

    def margin(self, other: Self) -> float:
        """Return the error of a similarity that is allowed for."""
        # A rounding error is uniform: its standard deviation is a step over the root of 12.
        return ERROR_SIGMAS * math.hypot(self.step, other.step, CODE_STEP) / math.sqrt(12)

    def similarities(self, rows: Indices, other: Self) -> ByteSimilarities:
        """Compare some features with all of another image."""
        unit = self.step * other.step
        return ByteSimilarities(_similarity_codes(self.codes[rows], other.packed, unit))


@dataclass(frozen=True)
class HalfDescriptors:
    """Descriptors as 16-bit floating point numbers, on a GPU."""

    values: Any  # (N, D) tensor

    num_rows: ClassVar[int] = 4096  # compared at once
    unit: ClassVar[float] = 1.0  # of similarities

    @classmethod
    def of(cls, descriptors: Singles, device: str) -> Self:
        """Copy (N, D) unit rows to a device."""
        import torch

        return cls(torch.from_numpy(descriptors).to(device, torch.float16))

    @property
    def nbytes(self) -> int:
        """Memory they take."""
        return int(self.values.nbytes)

    def margin(self, other: Self) -> float:
        """Return the error of a similarity that is allowed for."""
        del other
        return ERROR_SIGMAS * HALF_ERROR

    def similarities(self, rows: Indices, other: Self) -> HalfSimilarities:
        """Compare some features with all of another image."""
        import torch

        chosen = self.values[torch.from_numpy(rows).to(self.values.device)]
        return HalfSimilarities(chosen @ other.values.T)


CoarseDescriptors = EightBitDescriptors | HalfDescriptors
MakeCoarse = Callable[[Singles], CoarseDescriptors]  # makes coarse descriptors of (N, D) unit rows


def coarse_descriptors(num_similarities: float, device: str = "auto") -> MakeCoarse | None:
    """Return what makes coarse descriptors; None where they do not pay.

    ``num_similarities`` are those of all pairs of features to come; the device ``auto`` asks for a
    GPU only when there is enough to do.
    """
    enough = MIN_SIMILARITIES_PER_CORE * available_cores()
    if device in ("auto", "cpu") and num_similarities < enough:
        return None
    from colmap_affrect.features.networks import resolve_device

    resolved = resolve_device(device)
    if resolved.type != "cpu":
        return partial(HalfDescriptors.of, device=str(resolved))
    return EightBitDescriptors.of if has_fast_8_bit_products() else None


def short_lists(
    first: Any, second: Any, rows: Indices, rivals: NeighborLists, max_ratio: float
) -> Iterator[ShortList]:
    """Compare some features of one image (``rows``) with all of another, both of one class.

    ``rivals`` has for each feature of the other image those too close to be its second neighbour,
    ``max_ratio`` limits the ratio of the distances to the first and the second neighbour.
    """
    margin = first.margin(second)
    width = 2.0 * margin / first.unit
    for begin in range(0, len(rows), first.num_rows):
        similarities = first.similarities(rows[begin : begin + first.num_rows], second)
        best, highest = similarities.largest()
        of_best = rivals.of(best)
        is_close = similarities.take_out(*of_best) >= highest[of_best[0]] - width
        runners_up, second_highest = similarities.largest()
        doubtful = _is_hidden(best, runners_up, of_best, is_close, rivals)
        doubtful |= second_highest <= width  # codes have no negative similarities
        nearer, farther = first.unit * highest, first.unit * second_highest
        # sqrt((1 - nearer) / (1 - farther)) may be below the limit
        passing = 1.0 - nearer - margin < max_ratio**2 * (1.0 - farther + margin)
        may = np.flatnonzero(passing | doubtful)
        if not len(may):
            continue
        near = similarities.at_least(may, np.maximum(second_highest[may] - width, HALF_ERROR))
        parts = zip(near, rivals.of(best[may]), strict=True)
        entry_rows, columns = (np.concatenate(part) for part in parts)
        entries = np.sort(entry_rows << 32 | columns)  # far faster than an order by two keys
        yield ShortList(
            begin + may, runners_up[may], doubtful[may], entries >> 32, entries & 0xFFFF_FFFF
        )


def _is_hidden(
    best: Indices,
    runners_up: Indices,
    of_best: tuple[Indices, Indices],
    is_close: Bools,
    rivals: NeighborLists,
) -> Bools:
    """Tell where the second neighbour is not known, for each of R rows.

    A rival of the best may be nearer than it and have the runner-up for a rival, of which the best
    is none. The second neighbour then may be far less similar than the runner-up.
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
