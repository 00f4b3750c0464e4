"""Short lists for the ratio test, by similarities of descriptors in 8 or 16 bits.

On photographs few features pass the test, and their neighbours stand out. Coarse similarities tell
which features may pass and which may be their first and second neighbours; only those few are
compared exactly. A GPU, or a processor with 8-bit products, computes coarse similarities in a
fraction of the time. Their error is known, and six times its standard deviation is allowed for, so
that the matches are those of exact similarities.

torch is loaded here, when there is enough to match to pay for that.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bools, Bytes, Floats, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists
from colmap_affrect.parallel.executor import available_cores, one_openmp_thread

MIN_SIMILARITIES_PER_CORE = 6e8  # with fewer than this, loading torch takes longer than it saves

ERROR_SIGMAS = 6.0
MAX_CODE, ZERO_CODE = 127, 128
CODE_STEP = 1.0 / 250  # of 8-bit similarities; negative ones are 0, errors make some more than 1
NUM_ROWS_8_BIT = 512  # rows of similarities computed at once, a multiple of ``SIZE_MULTIPLE``
SIZE_MULTIPLE = 256
"""Both factors of a product are filled up to a multiple of it: oneDNN prepares and keeps a program
for every size, and many sizes take memory and time."""
FOLD = 8  # similarities that share a maximum
NO_HALF_SIMILARITY = -4.0
NUM_ROWS_16_BIT = 4096
HALF_ERROR = 2.0**-11  # standard deviation, rounded up, of similarities in 16 bits


@dataclass(frozen=True)
class ShortList:
    """Features that may pass the ratio test, and what may be their two nearest neighbours."""

    rows: Indices  # (R,) int64 features of the first image that may pass, rising
    runners_up: Indices  # (R,) int64 the second neighbour of each by coarse similarities
    doubtful: Bools  # (R,) bool those whose neighbours may not all be listed
    entry_rows: Indices  # (E,) int64 indices into ``rows``, rising
    entry_columns: Indices  # (E,) int64 features of the second image, rising in each row


class CoarseDescriptors(Protocol):
    """Descriptors of one image in few bits."""

    @property
    def nbytes(self) -> int:
        """Memory they take."""

    def short_list(
        self, rows: Indices, other: Self, rivals: NeighborLists, max_ratio: float
    ) -> ShortList:
        """Compare some features (``rows``, rising) with all of another image of the same kind.

        ``rivals`` has for each feature of the other image those too close to be its second
        neighbour, ``max_ratio`` limits the ratio of the distances to the first and the second one.
        """


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


@dataclass(frozen=True)
class EightBitDescriptors:
    """Descriptors as signed 8-bit numbers, on the CPU."""

    codes: NDArray[np.int8]  # (N, D) int8, the descriptors divided by ``step`` and rounded
    packed: Any  # the same as the second factor of products, filled up with zeros
    step: float  # the largest value over 127

    @classmethod
    def of(cls, descriptors: Singles) -> Self:
        """Round (N, D) unit rows."""
        step = max(float(np.abs(descriptors).max(initial=0.0)), 1e-6) / MAX_CODE
        codes = np.rint(descriptors / step).astype(np.int8)
        return cls(codes, _packed(codes), step)

    @property
    def nbytes(self) -> int:
        """See :class:`CoarseDescriptors`."""
        return 2 * self.codes.nbytes

    def short_list(
        self, rows: Indices, other: Self, rivals: NeighborLists, max_ratio: float
    ) -> ShortList:
        """See :class:`CoarseDescriptors`."""
        import torch  # noqa: F401 - its threads can only be limited once they are there

        # A rounding error is uniform: its standard deviation is a step over the root of 12.
        margin = ERROR_SIGMAS * math.hypot(self.step, other.step, CODE_STEP) / math.sqrt(12)
        width = math.ceil(2 * margin / CODE_STEP)
        parts = []
        with one_openmp_thread():
            for begin in range(0, len(rows), NUM_ROWS_8_BIT):
                chunk = rows[begin : begin + NUM_ROWS_8_BIT]
                similarity = _Similarities.of(
                    _similarity_codes(self.codes[chunk], other.packed, self.step * other.step)
                )
                best, first = similarity.largest()
                of_best = rivals.of(best)
                is_close = similarity.take_out(*of_best) >= first[of_best[0]] - width
                runners_up, second = similarity.largest()
                doubtful = _is_hidden(best, runners_up, of_best, is_close, rivals)
                doubtful |= second <= width  # others may be below the smallest code
                passing = _may_pass(CODE_STEP * first, CODE_STEP * second, max_ratio, margin)
                may = np.flatnonzero(passing | doubtful)
                near = similarity.at_least(may, np.maximum(second[may] - width, 1))
                parts.append(
                    _part(chunk[may], runners_up[may], doubtful[may], near, rivals.of(best[may]))
                )
        return _joined(parts)


@dataclass(frozen=True)
class _Similarities:
    """Similarities of R features to N = ``FOLD`` G others, and the largest of every few.

    Large ones are looked for among the maxima, which are fewer.
    """

    groups: Bytes  # (R, FOLD, G) uint8; columns g, g + G, g + 2 G, ... are group g
    maxima: Bytes  # (R, G) uint8 the largest of each group

    @classmethod
    def of(cls, codes: Bytes) -> Self:
        """Group (R, N) similarities, N a multiple of ``FOLD``."""
        groups = codes.reshape(len(codes), FOLD, -1)
        return cls(groups, groups.max(axis=1))

    def largest(self) -> tuple[Indices, Indices]:
        """Return the column of a largest similarity of each row, and the similarity."""
        every, group = np.arange(len(self.maxima)), self.maxima.argmax(axis=1)
        member = self.groups[every, :, group].argmax(axis=1)
        return member * self.maxima.shape[1] + group, self.maxima[every, group].astype(np.int64)

    def take_out(self, rows: Indices, columns: Indices) -> Bytes:
        """Make some similarities 0; return what they were."""
        member, group = np.divmod(columns, self.maxima.shape[1])
        before = self.groups[rows, member, group]
        self.groups[rows, member, group] = 0
        self.maxima[rows, group] = self.groups[rows, :, group].max(axis=1)
        return before

    def at_least(self, rows: Indices, least: Indices) -> tuple[Indices, Indices]:
        """Return where some rows reach a limit each: indices into ``rows``, and columns."""
        above = self.maxima[rows] >= least.astype(np.uint8)[:, None]
        index, group = np.divmod(np.flatnonzero(above), above.shape[1])
        found, member = np.nonzero(self.groups[rows[index], :, group] >= least[index, None])
        return index[found], member * self.maxima.shape[1] + group[found]


@dataclass(frozen=True)
class HalfDescriptors:
    """Descriptors as 16-bit floating point numbers, on a GPU."""

    values: Any  # (N, D) tensor

    @classmethod
    def of(cls, descriptors: Singles, device: str) -> Self:
        """Copy (N, D) unit rows to a device."""
        import torch

        return cls(torch.from_numpy(descriptors).to(device, torch.float16))

    @property
    def nbytes(self) -> int:
        """See :class:`CoarseDescriptors`."""
        return int(self.values.nbytes)

    def short_list(
        self, rows: Indices, other: Self, rivals: NeighborLists, max_ratio: float
    ) -> ShortList:
        """See :class:`CoarseDescriptors`."""
        import torch

        device = self.values.device
        margin = ERROR_SIGMAS * HALF_ERROR
        parts = []
        for begin in range(0, len(rows), NUM_ROWS_16_BIT):
            chunk = rows[begin : begin + NUM_ROWS_16_BIT]
            similarity = self.values[torch.from_numpy(chunk).to(device)] @ other.values.T
            first, best = (found.cpu().numpy() for found in similarity.max(dim=1))
            of_best = rivals.of(best)
            places = tuple(torch.from_numpy(indices).to(device) for indices in of_best)
            is_close = similarity[places].float().cpu().numpy() >= first[of_best[0]] - 2 * margin
            similarity[places] = NO_HALF_SIMILARITY
            seconds, runners = similarity.max(dim=1)
            second, runners_up = seconds.float().cpu().numpy(), runners.cpu().numpy()
            doubtful = _is_hidden(best, runners_up, of_best, is_close, rivals)
            passing = _may_pass(first.astype(np.float32), second, max_ratio, margin)
            may = np.flatnonzero(passing | doubtful)
            chosen = torch.from_numpy(may).to(device)
            close = similarity[chosen] >= (seconds[chosen] - 2 * margin)[:, None]
            near = tuple(found.cpu().numpy() for found in close.nonzero(as_tuple=True))
            parts.append(
                _part(chunk[may], runners_up[may], doubtful[may], near, rivals.of(best[may]))
            )
        return _joined(parts)


def _is_hidden(
    best: Indices,
    runners_up: Indices,
    of_best: tuple[Indices, Indices],
    is_close: Bools,
    rivals: NeighborLists,
) -> Bools:
    """Tell where the second neighbour is not known, for each of R rows.

    That is where a rival of the best may be nearer than it, and has the runner-up for a rival, of
    which the best is none. What takes the place of the runner-up then may be far less similar.
    """
    rows, columns = (indices[is_close] for indices in of_best)
    is_other = columns != best[rows]
    entries, theirs = rivals.of(columns[is_other])
    hidden = np.zeros(len(best), dtype=bool)
    rows = rows[is_other][entries]
    hidden[rows[theirs == runners_up[rows]]] = True
    return hidden


def _may_pass(first: Floats, second: Floats, max_ratio: float, margin: float) -> Bools:
    """Tell where sqrt((1 - first) / (1 - second)) may be under a limit."""
    return np.asarray(1.0 - first - margin < max_ratio**2 * (1.0 - second + margin))


def _part(
    rows: Indices,
    runners_up: Indices,
    doubtful: Bools,
    near: tuple[Indices, ...],
    of_best: tuple[Indices, Indices],
) -> ShortList:
    """Unite the entries near the second neighbour with the first one and its rivals, sorted."""
    entry_rows, columns = (np.concatenate(both) for both in zip(near, of_best, strict=True))
    entries = np.sort(entry_rows << 32 | columns)  # far faster than an order by two keys
    return ShortList(rows, runners_up, doubtful, entries >> 32, entries & 0xFFFF_FFFF)


def _joined(parts: list[ShortList]) -> ShortList:
    begins = np.cumsum([0, *(len(part.rows) for part in parts)])
    moved = (replace(p, entry_rows=p.entry_rows + b) for p, b in zip(parts, begins, strict=False))
    none = np.zeros(0, np.int64)
    every = [vars(ShortList(none, none, none.astype(bool), none, none)), *map(vars, moved)]
    return ShortList(**{name: np.concatenate([part[name] for part in every]) for name in every[0]})


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
