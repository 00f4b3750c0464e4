"""What a pair is, lists of millions of them, and the options of how pairs are chosen."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Literal, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from colmap_affrect.geometry.arrays import Bools
from colmap_affrect.options import Options, within

Pair = tuple[str, str]  # names of two photographs, in order

AT_ONCE = 1 << 16  # pairs that are given names together


class PairList(Sequence[Pair]):
    """Pairs as (N, 2) int32 ``numbers`` of their images in the sorted ``names``."""

    def __init__(self, names: Sequence[str], numbers: NDArray[np.integer]) -> None:
        self.names, self.numbers = names, numbers.astype(np.int32, copy=False).reshape(-1, 2)

    @classmethod
    def of(cls, pairs: Iterable[Pair]) -> "PairList":
        """Make a list of any pairs, in their order."""
        if isinstance(pairs, PairList):
            return pairs
        listed = list(pairs)
        names = sorted({name for pair in listed for name in pair})
        number = {name: index for index, name in enumerate(names)}
        return cls(names, np.array([(number[a], number[b]) for a, b in listed], np.int32))

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
    num_neighbors: Annotated[int, within(1, 1_000_000)] = 20
    """Of each image: on average, by retrieval, and half as many at least; at most, by gps; before
    and after it, in a sequence."""
    max_distance_m: Annotated[float, within(0.0, 1e9)] = 100.0
    """Between positions of ``gps``; in their own unit where they are not longitude and latitude."""
    match_list_path: str = ""
    """List of pairs, two names per line; takes the place of ``exhaustive``."""
