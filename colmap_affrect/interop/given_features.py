"""Features in HDF5 files of hloc, of deep-image-matching and of our own, as COLMAP has them.

What the files hold is in :mod:`colmap_affrect.interop.hdf5`.
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap.database import colmap_keypoints
from colmap_affrect.errors import StoreError, such_as
from colmap_affrect.geometry.arrays import Singles
from colmap_affrect.geometry.conventions import colmap_from_pixel
from colmap_affrect.project.given_h5 import GivenFile


def keys_of(
    features: GivenFile, names: Sequence[str], image_path: Path
) -> dict[str, str]:
    """Return the key of the features of each image, by its name.

    Some programs leave out the folders of images.

    Args:
        features: the file.
        names: of all images.
        image_path: folder of the photographs, for errors.

    Raises:
        StoreError: the file has features of other images.
    """
    full_names = defaultdict[str, list[str]](list)
    for name in names:
        full_names[PurePosixPath(name).name].append(name)
    known = set(names)
    found = dict[str, str]()
    unknown = []
    for key in features.groups_with("keypoints"):
        alike = [key] if key in known else full_names.get(key, [])
        if len(alike) == 1:
            found[alike[0]] = key
        else:
            unknown.append(key)
    if unknown:
        raise StoreError(
            f"has features of images that are not in {image_path}: {such_as(unknown)}",
            where=features.path,
        )
    return found


def given_descriptors(features: GivenFile, key: str, count: int) -> NDArray[Any]:
    """Return the descriptors of an image; hloc has them as (D, N).

    Args:
        features: the file.
        key: of the features of the image.
        count: N, the number of its keypoints.

    Returns:
        (N, D) values of the type that the file has.

    Raises:
        StoreError: there is another number of them.
    """
    shape = features.shapes[f"{key}/descriptors"]
    if len(shape) != 2 or count not in shape:
        raise StoreError(
            f"{key}/descriptors has shape {shape}, expected (D, {count})",
            where=features.path,
        )
    values = features.read(f"{key}/descriptors", shape)
    return values.T if shape[1] == count else values


def require_size(
    source: GivenFile, key: str, name: str, expected: tuple[int, int]
) -> None:
    """Refuse features that were found in an image of another size than it has.

    Args:
        source: the file.
        key: of the features of the image.
        name: of the image.
        expected: its (width, height) in px.

    Raises:
        StoreError: the size is another one; without one in the file nothing is refused.
    """
    if f"{key}/image_size" not in source.shapes:
        return
    size = tuple(source.read(f"{key}/image_size", (2,)).tolist())
    if f"{key}/tile_idx" in source.shapes:  # deep-image-matching has (height, width)
        size = size[::-1]
    if size != expected:
        turned = " (turned by its EXIF orientation?)" if size == expected[::-1] else ""
        raise StoreError(
            f"{name} was {size[0]:g} x {size[1]:g} px for the features{turned}, and "
            f"the photograph is {expected[0]} x {expected[1]} px",
            where=source.path,
            advice="use the same photographs",
        )


def keypoint_rows(source: GivenFile, name: str) -> Singles:
    """Return the (N, 2), (N, 4) or (N, 6) keypoints of an image as COLMAP stores them."""
    # What is not finite, or float32 cannot hold, is refused later
    with np.errstate(all="ignore"):
        points = source.read(f"{name}/keypoints", (None, 2)).astype(np.float32)
        centers = np.asarray(colmap_from_pixel(points))
        count = len(points)
        if f"{name}/lafs" in source.shapes:
            lafs = source.read(f"{name}/lafs", (count, 2, 3)).astype(np.float64)
            return np.column_stack([centers, colmap_keypoints(lafs)[:, 2:]])
        if not {f"{name}/scales", f"{name}/oris"} <= source.shapes.keys():
            return centers
        sigmas = source.read(f"{name}/scales", (count,)).astype(np.float32)
        angles = np.deg2rad(source.read(f"{name}/oris", (count,)).astype(np.float32))
        return np.column_stack([centers, sigmas, angles])
