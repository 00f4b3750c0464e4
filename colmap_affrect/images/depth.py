"""Depth maps of photographs: ``.npy``, 16-bit ``.png`` or ``.tif``.

A depth map is (h, w) float32: depth along the optical axis, > 0, NaN where it is unknown. It
covers the whole image at any resolution, so that ``conventions.resized_from_original`` relates
its pixels to those of the photograph. The unit is free: normals do not depend on it.
"""

from collections.abc import Sequence
from math import log, prod
from pathlib import Path
from posixpath import splitext
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import Photograph
from colmap_affrect.errors import DepthError, OptionError
from colmap_affrect.geometry.arrays import Floats, Singles
from colmap_affrect.geometry.conventions import resized_from_original
from colmap_affrect.images.reading import decode, header_size
from colmap_affrect.options import Options

# In the order in which they are looked for
SUFFIXES = (".npy", ".png", ".tif", ".tiff")
MAX_NUM_VALUES = 1 << 27  # of a map; more is taken for damage
# Depth of one step of 16 bits; only the ratio of depths matters; theory
PNG_STEP = 0.001
# Of aspects of map and photograph: networks round sizes to 32 px; theory
MAX_ASPECT_RATIO = 1.05
MIN_VALID_FRAC = 0.01  # share of the pixels of a map that must be known; damage


class DepthOptions(Options):
    """Depth maps in a folder."""

    path: str = ""
    """Folder of depth maps, named as the images: ``a/b.jpg`` has ``a/b.npy``, or .png, .tif (also
    after the image's full name, ``a/b.jpg.npy``)."""
    kind: Literal["z", "ray", "inverse"] = "z"
    """What the values are: ``z`` (along the optical axis), ``ray`` (distance from the camera), or
    ``inverse`` (1 / z)."""

    def file(self, name: str) -> Path | None:
        """Return the map of an image, if any: ``a/b.jpg.npy`` and so on, then ``a/b.npy``."""
        names = [f"{name}{suffix}" for suffix in SUFFIXES]
        names += [f"{splitext(name)[0]}{suffix}" for suffix in SUFFIXES]
        paths = map(Path(self.path).joinpath, names)
        return next(filter(Path.is_file, paths), None)


class DepthMaps:
    """Depth maps in a folder; values that are not finite or not positive are unknown."""

    def __init__(self, options: DepthOptions) -> None:
        self._options = options
        self._path = Path(options.path)

    def require_some(self, names: Sequence[str]) -> None:
        """Refuse a folder that is not there, or has no map of any image; OptionError."""
        if not self._path.is_dir():
            raise OptionError(
                "no such folder",
                where=self._path,
                advice="give the folder of the depth maps",
            )
        if not any(self._options.file(name) for name in names):
            raise OptionError(
                f"holds no depth map of any of the {len(names)} images",
                where=self._path,
                advice=self._searched_names(names[0]),
            )

    def depth(self, photograph: Photograph) -> Singles:
        """Return (h, w) float32 z-depth > 0, NaN where unknown, of any size over the whole image.

        DepthError if there is no map, or it is damaged or not of this photograph.
        """
        path = self._options.file(photograph.name)
        if path is None:
            raise DepthError(
                f"no depth map of {photograph.name}",
                where=self._path,
                advice=self._searched_names(photograph.name),
            )
        what = f"{path}: depth map of {photograph.name}"
        try:
            values = _read_map(path)
        except Exception as error:  # damaged files make readers fail in any way
            raise DepthError(
                "cannot be read",
                where=what,
                advice="damaged, too large, or not what its suffix says",
            ) from error
        if values.ndim != 2 or not values.size or values.dtype.kind not in "fiu":
            raise DepthError(
                f"expected numbers of shape (height, width), found {values.dtype} of "
                f"shape {values.shape}",
                where=what,
            )
        if values.dtype == np.uint8:
            raise DepthError(
                "8 bits are a preview, too coarse for depth",
                where=what,
                advice="give 16 bits, or .npy",
            )
        (height, width) = values.shape
        size = photograph.size
        if abs(log(width / height) - log(size[0] / size[1])) > log(MAX_ASPECT_RATIO):
            raise DepthError(
                f"is {width} x {height} px, the photograph {size[0]} x {size[1]} (width "
                "x height): not of this photograph, or turned",
                where=what,
                advice="map and photograph must have the same aspect as stored, EXIF "
                "orientation is not applied",
            )
        step = PNG_STEP if path.suffix == ".png" else 1.0
        depth = _z_depth(
            step * values.astype(np.float64), self._options.kind, photograph
        )
        known_frac = np.isfinite(depth).mean()
        if known_frac < MIN_VALID_FRAC:
            raise DepthError(
                f"{100 * known_frac:.2g} % of the values are depths (finite and "
                f"positive), at least {100 * MIN_VALID_FRAC:g} % are needed",
                where=what,
                advice="make the map again",
            )
        return depth

    def _searched_names(self, name: str) -> str:
        suffixes = ", ".join(SUFFIXES)
        return f"looked for {name}.* and {splitext(name)[0]}.* with * one of {suffixes}"


def _read_map(path: Path) -> NDArray[Any]:
    """Read the values of a map; anything is raised for a damaged file, and for too many values."""
    if path.suffix != ".npy":
        if prod(header_size(path) or (0,)) > MAX_NUM_VALUES:
            raise ValueError
        return decode(path, flags=cv2.IMREAD_UNCHANGED, keeps_numbers=True)
    # A map into memory, which takes none yet
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    if values.size > MAX_NUM_VALUES:
        raise ValueError
    return np.asarray(values)


def _z_depth(values: Floats, kind: str, photograph: Photograph) -> Singles:
    """Turn (h, w) values of a kind of depth into float32 z-depth, NaN where it is unknown."""
    # Unknown values may be anything, and become NaN below.
    with np.errstate(all="ignore"):
        if kind == "inverse":
            values = 1.0 / values
        elif kind == "ray":
            rows, columns = np.indices(values.shape)
            size = (values.shape[1], values.shape[0])
            resized = resized_from_original(photograph.size, size)
            camera = resized @ photograph.camera_matrix
            pixels = np.stack([columns, rows, np.ones(values.shape)])
            # To points of depth 1
            rays = np.tensordot(np.linalg.inv(camera), pixels, axes=1)
            values = values / np.linalg.norm(rays, axis=0)
        depth = values.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(np.nan))
