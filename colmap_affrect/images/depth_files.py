"""Files of depth maps: how the values of each format are read.

- ``.npy``: the map. ``.npz``: the array ``depth``, or the only one.
- ``.png``: 16 bit, in steps of any size.
- ``.exr``: one channel; only if OpenCV was built with OpenEXR (wheels of 4.x, not of 5.0).
- ``.h5``, ``.hdf5``: the dataset ``depth``, or the only one of two dimensions.

Files may come from anywhere: whatever is wrong with one ends in :class:`UnusableMap`, and no header
is trusted with more memory than a depth map may need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import prod
from pathlib import Path
from typing import IO
from zipfile import ZipFile, is_zipfile

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

MAX_NUM_VALUES = 1 << 28
"""Of a map; more is taken for damage."""


class UnusableMap(Exception):
    """Reason why a map cannot be used; the caller adds the file and the photograph."""


def read_map(path: Path) -> NDArray[np.float64]:
    """Read the (h, w) values of a file with one of ``SUFFIXES``; UnusableMap if it holds no map."""
    try:
        values = _READERS[path.suffix](path)
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


def _read_numpy(path: Path) -> NDArray[np.generic]:
    with path.open("rb") as stream:
        if not is_zipfile(stream):
            return _read_array(stream)
        with ZipFile(stream) as archive:
            names = sorted(name.removesuffix(".npy") for name in archive.namelist())
            if "depth" not in names and len(names) != 1:
                raise UnusableMap(
                    f"expected one array, or one named 'depth', found {_listed(names)}"
                )
            with archive.open(f"{'depth' if 'depth' in names else names[0]}.npy") as member:
                return _read_array(member)


def _read_array(stream: IO[bytes]) -> NDArray[np.generic]:
    """Read an array in the format of ``.npy``, never a pickle, when its header is sensible."""
    stream.seek(0)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    _require_readable_size(read_header(stream)[0])
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _require_readable_size(shape: Sequence[int]) -> None:
    """Refuse what a damaged or malicious header says before memory is taken for it."""
    if prod(shape) > MAX_NUM_VALUES:
        raise UnusableMap(f"claims to be of shape {tuple(shape)}, too large for a depth map")


def _read_hdf5(path: Path) -> NDArray[np.generic]:
    maps: dict[str, h5py.Dataset] = {}

    def collect(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset) and (item.ndim == 2 or name == "depth"):
            maps[name] = item

    with h5py.File(path, "r") as file:
        file.visititems(collect)
        if "depth" not in maps and len(maps) != 1:
            raise UnusableMap(
                "expected one dataset of two dimensions, or one named 'depth', found "
                f"{_listed(maps)}"
            )
        chosen = maps["depth"] if "depth" in maps else next(iter(maps.values()))
        _require_readable_size(chosen.shape)
        return np.asarray(chosen[()])


def _read_png(path: Path) -> NDArray[np.generic]:
    data = np.fromfile(path, np.uint8)
    if data[:8].tobytes() == b"\x89PNG\r\n\x1a\n":
        _require_readable_size(data[16:24].view(">u4").tolist())  # width and height
    values = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError
    if values.dtype != np.uint16:
        raise UnusableMap("an 8-bit PNG is a preview, too coarse for depth; give 16 bit, or .npy")
    return np.asarray(values)


def _read_exr(path: Path) -> NDArray[np.generic]:
    try:
        values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        values = None
    if values is None:
        raise UnusableMap(
            f"OpenCV {cv2.__version__} cannot read it; save the map as .npy, or install "
            "'opencv-python-headless<5' and set the environment variable OPENCV_IO_ENABLE_OPENEXR=1"
        )
    return np.asarray(values)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


_READERS: dict[str, Callable[[Path], NDArray[np.generic]]] = {
    ".npy": _read_numpy,
    ".npz": _read_numpy,
    ".png": _read_png,
    ".exr": _read_exr,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
}

SUFFIXES = tuple(_READERS)
"""Of files of depth maps, in the order in which they are looked for."""
