"""Which pairs guided matching has matched again: ``guided.h5``, a group for each pair."""

from collections.abc import Iterable
from dataclasses import dataclass

import h5py
import numpy as np

from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.project.group_store import GroupStore, entries_of, read_checked
from colmap_affrect.project.match_state import Names
from colmap_affrect.project.match_store import pair_key


@dataclass(frozen=True)
class GuidedPair:
    """What guided matching found for a pair."""

    names: Names  # of the two images, in the order of the columns
    exact: Indices  # (M, 2) inliers before; what adjusts models most accurately
    num_inliers: int  # of the geometry that took the place of the one before; 0 where that stayed


class GuidedStore(GroupStore):
    """Which pairs were matched again by their geometry."""

    format = "colmap_affrect/guided matches"
    stage = "verify"

    def write(self, pairs: Iterable[GuidedPair]) -> None:
        """Write a batch of pairs, in the place of what is there of them."""
        with self._open("a") as file:
            for pair in pairs:
                self._write(
                    file,
                    key=pair_key(*pair.names),
                    datasets={"exact": pair.exact},
                    names=np.asarray(pair.names, dtype=h5py.string_dtype()),
                    num_inliers=pair.num_inliers,
                )

    def read(self) -> list[GuidedPair]:
        """Read all pairs."""
        if not self.path.exists():
            return []
        found = []
        with self._open("r") as file:
            for key, group in sorted(entries_of(file), key=lambda item: item[0]):
                first, second = group.attrs["names"]
                if (
                    pair_key(str(first), str(second)) != key
                ):  # columns would be exchanged
                    raise ValueError(f"{group.name} is not as it was written")
                found.append(
                    GuidedPair(
                        names=(str(first), str(second)),
                        exact=read_checked(group, "exact"),
                        num_inliers=int(group.attrs["num_inliers"]),
                    )
                )
        return found
