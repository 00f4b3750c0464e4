"""Difference-of-Gaussians keypoints (Lowe 2004) through OpenCV, the home of its SIFT."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.options import DogOptions
from colmap_affrect.types import GrayImage, LocalFeatures

MIN_IMAGE_SIZE_PX = 8
"""OpenCV's scale space needs this much of the shorter side."""


def make_sift(options: DogOptions) -> cv2.SIFT:
    """Build OpenCV's detector and descriptor.

    ``enable_precise_upscale`` removes OpenCV's bias of +0.25 px in x and y.
    """
    return cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=options.num_octave_layers,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        sigma=options.sigma_px,
        enable_precise_upscale=True,
    )


def is_searchable(image: GrayImage, mask: NDArray[np.uint8] | None) -> bool:
    """Tell whether an image is large enough for OpenCV, not flat, and its mask not empty."""
    large = min(image.shape) >= MIN_IMAGE_SIZE_PX
    return large and bool(image.min() < image.max()) and (mask is None or bool(mask.any()))


def by_falling_response(
    keypoints: Sequence[cv2.KeyPoint],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32]]:
    """Sort keypoints by falling response; those of equal response keep their order.

    Returns:
        (N,) index of the sorted keypoints in the given ones; their (N, 4) x, y in pixel-centre
        px, sigma in px and angle in radians (from x towards y); their (N,) responses.
    """
    responses = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
    order = np.argsort(-responses, kind="stable")
    rows = np.array([(*k.pt, k.size, k.angle) for k in keypoints], dtype=np.float64)
    rows = rows.reshape(-1, 4)[order] * (1.0, 1.0, 1.0 / 2.0, np.pi / 180.0)
    return order, rows, responses[order]


def detect_dog(
    image: GrayImage, options: DogOptions, mask: NDArray[np.uint8] | None = None
) -> LocalFeatures:
    """Detect DoG keypoints for descriptors that assign orientations themselves.

    OpenCV returns a location once for each of its dominant orientations, 15 to 18 % of them more
    than once. With another orientation put in their place these would be equal features, which
    no ratio test tells apart; so there is one keypoint per centre and scale.

    Args:
        image: (H, W) uint8.
        options: detector thresholds and the cap on the number of features.
        mask: (H, W) uint8, keypoints are kept only where it is not 0.

    Returns:
        Features by falling response, frames upright circles of 6 sigma, descriptors (N, 0); none
        for images under 8 px.
    """
    if not is_searchable(image, mask):
        return LocalFeatures.empty()
    _, rows, responses = by_falling_response(make_sift(options).detect(image, mask))
    _, first = np.unique(rows[:, :3], axis=0, return_index=True)
    kept = np.sort(first)[: options.max_num_features]
    rows = rows[kept]
    lafs = lafs_from_keypoints(rows[:, :2], MEASUREMENT_SIGMAS * rows[:, 2], np.zeros(len(rows)))
    return LocalFeatures(lafs, responses[kept], np.zeros((len(rows), 0), np.float32))
