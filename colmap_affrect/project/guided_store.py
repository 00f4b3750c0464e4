"""Guided matches of a run in HDF5: ``guided.h5``, a group per pair that was matched again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.project.stores import Store, pair_key


@dataclass(frozen=True)
class GuidedPair:
    """What guided matching found for a pair.

    Attributes:
        names: of the two images, in the order of the columns.
        exact: (M, 2) inliers before; what adjusts models most accurately.
        candidates: (K, 2) the same and guided matches, to verify.
        num_inliers: of the geometry that was estimated from the candidates and took the place of
            the one before; 0 where that stayed.
    """

    names: tuple[str, str]
    exact: NDArray[np.int64]
    candidates: NDArray[np.int64]
    num_inliers: int


class GuidedStore(Store):
    """Which pairs were matched again by their geometry."""

    kind = "guided matches"

    def write(self, pairs: Iterable[GuidedPair]) -> None:
        """Write a batch of pairs, in the place of what is there of them."""
        with self._open("a") as file:
            for pair in pairs:
                datasets = {"exact": pair.exact, "candidates": pair.candidates}
                names = np.asarray(pair.names, dtype=h5py.string_dtype())
                key = pair_key(*pair.names)
                self._write(file, key, datasets, names=names, num_inliers=pair.num_inliers)

    def read(self) -> list[GuidedPair]:
        """Read all pairs."""
        keys = self.names()
        if not keys:
            return []
        found = []
        with self._open("r") as file:
            for group in (file[key] for key in keys):
                first, second = (str(name) for name in group.attrs["names"])
                exact, candidates = group["exact"][()], group["candidates"][()]
                count = int(group.attrs["num_inliers"])
                found.append(GuidedPair((first, second), exact, candidates, count))
        return found
