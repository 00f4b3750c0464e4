"""Synthetic images with known geometry."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_affrect.data import GrayImage, LocalFeatures
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS

Array = NDArray[np.float64]

BACKGROUND = 40.0


def blobs(
    size: tuple[int, int],
    centers: ArrayLike,
    shapes: ArrayLike,
    *,
    amplitude: float = 160.0,
    background: float = BACKGROUND,
) -> GrayImage:
    """Draw Gaussian blobs exactly, sampled at pixel centres.

    Args:
        size: (width, height) in px.
        centers: (N, 2) pixel-centre px.
        shapes: (2, 2) or (N, 2, 2) map from the unit circle to one sigma of the Gaussian.
        amplitude: gray values at the centre of a blob above the background.
        background: gray value far from the blobs.
    """
    width, height = size
    centers = np.asarray(centers, dtype=float)
    shapes = np.broadcast_to(np.asarray(shapes, dtype=float), (len(centers), 2, 2))
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    image = np.full((height, width), float(background))
    for center, shape in zip(centers, shapes, strict=True):
        unit = (grid - center) @ np.linalg.inv(shape).T
        image += amplitude * np.exp(-0.5 * (unit**2).sum(axis=-1))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def centroid(image: NDArray[np.generic], background: float = 0.0) -> Array:
    """Centre of mass (x, y) of what is above the background, pixel-centre px."""
    weights = image.astype(float) - background
    rows, columns = np.indices(image.shape)
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def texture(
    size: tuple[int, int], seed: int, finest_sigma_px: float = 1.2
) -> GrayImage:
    """Isotropic noise with structure at several scales, each of the same contrast."""
    width, height = size
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width))
    for octave in range(4):
        layer = cv2.GaussianBlur(
            rng.standard_normal((height, width)), (0, 0), finest_sigma_px * 2**octave
        )
        image += layer / max(layer.std(), 1e-9)
    return np.clip(np.rint(128 + 32 * image / max(image.std(), 1e-9)), 0, 255).astype(
        np.uint8
    )


def circles(centers: ArrayLike, sigmas_px: ArrayLike) -> LocalFeatures:
    """Upright features in order of falling response, as a detector returns them."""
    points = np.asarray(centers, float)
    sigmas = np.asarray(sigmas_px, float)
    lafs = lafs_from_keypoints(
        points, MEASUREMENT_SIGMAS * sigmas, np.zeros(len(points))
    )
    responses = np.linspace(1.0, 0.5, len(points), dtype=np.float32)
    ids = np.arange(len(points), dtype=np.int32)
    return LocalFeatures(lafs, responses, np.zeros((len(points), 0), np.float32), ids)


def unit_rows(rows: ArrayLike) -> NDArray[np.float32]:
    """Rows of unit length."""
    rows = np.asarray(rows)
    return np.asarray(
        rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32
    )


def write_image(path: Path, image: NDArray[np.generic]) -> Path:
    """Write an image through OpenCV's encoder of the suffix."""
    success, data = cv2.imencode(path.suffix, image)
    assert success
    path.write_bytes(data.tobytes())
    return path


def png_of_size(width: int, height: int) -> bytes:
    """A PNG that claims to have a size; what follows the header is missing."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    checksum = struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + checksum
