"""Files of depth maps: ``.npy``, ``.png`` of 16 bits, ``.tif`` of 16 bits or floating point.

Files may come from anywhere: whatever is wrong with one ends in :class:`UnusableMap`, and no header
is trusted with more memory than a depth map may need.
"""

from math import prod
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.headers import header_size

SUFFIXES = (".npy", ".png", ".tif", ".tiff")  # in the order in which they are looked for
MAX_NUM_VALUES_PER_PX = 4  # of a map, for each pixel of its photograph; more is taken for damage
MIN_LARGEST_MAP = 1 << 22  # a map of so many values is read whatever the size of the photograph


class UnusableMap(Exception):
    """Reason why a map cannot be used; the caller adds the file and the photograph."""


def read_map(path: Path, num_px: int) -> Array:
    """Read the (h, w) values of a photograph's map; UnusableMap if there are none, or too many."""
    max_num = max(MIN_LARGEST_MAP, MAX_NUM_VALUES_PER_PX * num_px)
    try:
        values = _array(path, max_num) if path.suffix == ".npy" else _picture(path, max_num)
    except UnusableMap:
        raise
    except Exception as error:  # damaged files make readers fail in any way
        raise UnusableMap("cannot be read; damaged, or not what its suffix says") from error
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiu":
        raise UnusableMap(
            f"expected numbers of shape (height, width), found {values.dtype} of shape "
            f"{values.shape}"
        )
    return values.astype(np.float64)


def _require_sensible(shape: tuple[int, ...], max_num: int) -> None:
    if prod(shape) > max_num:
        raise UnusableMap(f"is of shape {shape}, too large for a depth map of it")


def _array(path: Path, max_num: int) -> NDArray[Any]:
    values = np.load(path, mmap_mode="r", allow_pickle=False)  # which takes no memory yet
    _require_sensible(values.shape, max_num)
    return np.asarray(values)


def _picture(path: Path, max_num: int) -> NDArray[Any]:
    size = header_size(path)
    if size is None:
        raise ValueError
    _require_sensible(size[::-1], max_num)
    values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError
    if values.dtype == np.uint8:
        raise UnusableMap("8 bits are a preview, too coarse for depth; give 16 bits, or .npy")
    return np.asarray(values)
