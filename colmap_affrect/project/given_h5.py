"""HDF5 files of other programs: opened and read with care.

Links and data in other files are not followed, and the shape and kind of arrays is checked.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import OptionError, StoreError, damage

MAX_VALUES = 1 << 28  # an array of more values is taken for damage, and not read
# An array of so many may have been declared and never written; resource
LARGE_BYTES = 1 << 26
MOST_COMPRESSED = 1100  # deflate makes no array smaller than by this factor; format
MAX_DEPTH = 100  # of groups in groups; names of images have fewer folders; damage
MEND = "make it again with the program that wrote it"


@dataclass(frozen=True)
class GivenFile:
    """An open HDF5 file of another program, and the shapes of its datasets by their paths."""

    path: Path
    file: h5py.File
    shapes: dict[str, tuple[int, ...]]

    def groups_with(self, dataset: str) -> list[str]:
        """Return the sorted paths of the groups that have a dataset."""
        ending = f"/{dataset}"
        groups = []
        for key in self.shapes:
            if key.endswith(ending):
                groups.append(key.removesuffix(ending))
        if self.shapes and not groups:
            raise StoreError(
                f"holds no '{dataset}' of images",
                where=self.path,
                advice="is it a file of hloc?",
            )
        return sorted(groups)

    def read(
        self, key: str, shape: tuple[int | None, ...], kinds: str = "fiu"
    ) -> NDArray[Any]:
        """Read an array of numbers.

        Args:
            key: path of the dataset.
            shape: that it must have; None is any size.
            kinds: numpy's kinds of numbers that it may hold.

        Returns:
            The array.

        Raises:
            StoreError: it is damaged, or holds something else.
        """
        stored = self.shapes[key]
        expected = tuple(stored[:1]) if shape[0] is None else shape[:1]
        if stored != expected + shape[1:]:
            wanted = str(shape).replace("None", "N")
            raise StoreError(
                f"{key} has shape {stored}, expected {wanted}", where=self.path
            )
        with damage(self.path, MEND):
            require_plausible(self.file[key].id, key)
            if self.file[key].dtype.kind not in kinds:
                raise ValueError(f"{key} does not hold numbers, or no whole ones")
            _require_filters(self.path, self.file[key])
            return np.asarray(self.file[key][()])


def require_plausible(dataset: h5py.h5d.DatasetID, key: str) -> None:
    """Refuse an array that would take memory for values which nobody can have written.

    Args:
        dataset: the array.
        key: what it is called.

    Raises:
        ValueError: it says that it is larger than that.
    """
    shape = dataset.shape or ()
    num_values = math.prod(shape)
    if num_values > MAX_VALUES:
        raise ValueError(f"{key} of shape {shape} is too large to be true")
    num_bytes = num_values * dataset.dtype.itemsize
    if num_bytes > max(LARGE_BYTES, MOST_COMPRESSED * dataset.get_storage_size()):
        raise ValueError(
            f"{key} of shape {shape} was never written, but for a small part"
        )


def _require_filters(path: Path, dataset: h5py.Dataset) -> None:
    """Refuse an array that is compressed by what HDF5 lacks here; StoreError."""
    properties = dataset.id.get_create_plist()
    for index in range(properties.get_nfilters()):
        code = properties.get_filter(index)[0]
        if not h5py.h5z.filter_avail(code):
            raise StoreError(
                f"{dataset.name[1:]} is compressed by a plugin of HDF5 that is not "
                f"installed (filter {code})",
                where=path,
                advice="write the file again with gzip, or without compression",
            )


@contextmanager
def open_given_file(path: Path) -> Iterator[GivenFile]:
    """Open a file for reading; of links nothing is seen, data that are elsewhere are refused."""
    if not path.is_file():
        raise OptionError("no such file", where=path)
    shapes: dict[str, tuple[int, ...]] = {}

    def visit(key: str, item: h5py.Group | h5py.Dataset) -> None:
        if key.count("/") > MAX_DEPTH:
            raise StoreError(
                f"has groups in groups, more than {MAX_DEPTH} deep",
                where=path,
                advice=MEND,
            )
        if isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise StoreError(
                    f"data in other files are not followed: {key}", where=path
                )
            shapes[key] = item.shape or ()

    with damage(path, f"or still being written; {MEND}"):
        file = h5py.File(path, "r")
        try:
            file.visititems(visit)
        except SystemError as error:  # h5py's, for a name that is no UTF-8
            raise ValueError(error) from error
    with file:
        yield GivenFile(path=path, file=file, shapes=shapes)
