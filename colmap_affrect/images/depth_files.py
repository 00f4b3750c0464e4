"""Files of depth maps: how the values of each format are read.

- ``.npy``: the map. ``.npz``: the array ``depth``, or the only one.
- ``.png``: 16 bit, in steps of any size.
- ``.tif``, ``.tiff``: one channel of floating point numbers, or of 16 bits.

Files may come from anywhere: whatever is wrong with one ends in :class:`UnusableMap`, and no header
is trusted with more memory than a depth map may need.
"""

from collections.abc import Callable, Sequence
from math import prod
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile, is_zipfile

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.headers import header_size

MAX_NUM_VALUES_PER_PX = 4  # of a map, for each pixel of its photograph; more is taken for damage
MIN_LARGEST_MAP = 1 << 22  # a map of so many values is read whatever the size of the photograph
Require = Callable[..., None]  # takes the shape of a map, and its type if that may be no number


class UnusableMap(Exception):
    """Reason why a map cannot be used; the caller adds the file and the photograph."""


def read_map(path: Path, num_px: int) -> Array:
    """Read the (h, w) values of a photograph's map; UnusableMap if there are none, or too many."""
    max_num = max(MIN_LARGEST_MAP, MAX_NUM_VALUES_PER_PX * num_px)

    def require(shape: Sequence[int], dtype: np.dtype[Any] | None = None) -> None:
        """Refuse what a damaged or malicious header says before memory is taken for it."""
        if prod(shape) > max_num:
            raise UnusableMap(f"is of shape {tuple(shape)}, too large for a depth map of it")
        if dtype is not None and dtype.kind not in "fiu":
            raise _unexpected(shape, dtype)

    try:
        values = _READERS[path.suffix](path, require)
    except UnusableMap:
        raise
    except Exception as error:  # damaged files make readers fail in any way
        raise UnusableMap("cannot be read; damaged, or not what its suffix says") from error
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiu":
        raise _unexpected(values.shape, values.dtype)
    return values.astype(np.float64)


def _unexpected(shape: Sequence[int], dtype: np.dtype[Any]) -> UnusableMap:
    return UnusableMap(
        f"expected numbers of shape (height, width), found {dtype} of shape {tuple(shape)}"
    )


def _read_numpy(path: Path, require: Require) -> NDArray[np.generic]:
    with path.open("rb") as stream:
        if not is_zipfile(stream):
            return _read_array(stream, require)
        with ZipFile(stream) as archive:
            names = sorted(name.removesuffix(".npy") for name in archive.namelist())
            if "depth" not in names and len(names) != 1:
                found = ", ".join(names) or "none"
                raise UnusableMap(f"expected one array, or one named 'depth', found {found}")
            with archive.open(f"{'depth' if 'depth' in names else names[0]}.npy") as member:
                return _read_array(member, require)


def _read_array(stream: IO[bytes], require: Require) -> NDArray[np.generic]:
    """Read an array in the format of ``.npy``, never a pickle, when its header is sensible."""
    stream.seek(0)
    major, minor = np.lib.format.read_magic(stream)
    shape, _, dtype = getattr(np.lib.format, f"read_array_header_{major}_{minor}")(stream)
    require(shape, dtype)
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _read_image(path: Path, require: Require) -> NDArray[np.generic]:
    size = header_size(path)
    if size is None:
        raise ValueError
    require(size[::-1])
    values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError
    if values.dtype == np.uint8:
        raise UnusableMap("8 bits are a preview, too coarse for depth; give 16 bits, or .npy")
    return np.asarray(values)


_READERS: dict[str, Callable[[Path, Require], NDArray[np.generic]]] = {
    ".npy": _read_numpy,
    ".npz": _read_numpy,
    ".png": _read_image,
    ".tif": _read_image,
    ".tiff": _read_image,
}

SUFFIXES = tuple(_READERS)  # of files of depth maps, in the order in which they are looked for
