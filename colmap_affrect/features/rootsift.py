"""Feature profile ``rootsift``: OpenCV's DoG and SIFT, described as RootSIFT; no weights."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.options import SiftOptions
from colmap_affrect.types import GrayImage, LocalFeatures

DESCRIPTOR_SIZE = 128
MIN_IMAGE_SIZE_PX = 8


def extract_rootsift(
    image: GrayImage, options: SiftOptions, mask: NDArray[np.uint8] | None = None
) -> LocalFeatures:
    """Detect DoG keypoints and describe them with RootSIFT (Arandjelovic & Zisserman 2012).

    ``enable_precise_upscale`` removes OpenCV's bias of +0.25 px. A location with several
    dominant orientations yields one feature for each: their descriptors differ, and the
    matcher's second neighbour never lies at the same location, so none of them is lost.

    Args:
        image: (H, W) uint8.
        options: detector thresholds and the cap on the number of features.
        mask: (H, W) uint8, features are described only where it is not 0.

    Returns:
        Features by falling response; none for images under 8 px.
    """
    if min(image.shape) < MIN_IMAGE_SIZE_PX or (mask is not None and not mask.any()):
        return no_features()
    sift = cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=options.num_octave_layers,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        sigma=options.sigma_px,
        enable_precise_upscale=True,
    )
    keypoints, descriptors = sift.detectAndCompute(image, mask)
    if not keypoints:
        return no_features()
    responses = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
    best = np.argsort(-responses, kind="stable")[: options.max_num_features]
    rows = np.array([(*k.pt, k.size, k.angle) for k in keypoints], dtype=np.float64)[best]
    sigmas_px = rows[:, 2] / 2.0
    lafs = lafs_from_keypoints(rows[:, :2], MEASUREMENT_SIGMAS * sigmas_px, np.deg2rad(rows[:, 3]))
    described = root_normalized(descriptors[best].astype(np.float32))
    return LocalFeatures(lafs, responses[best], described)


def no_features() -> LocalFeatures:
    """Return the result for an image without features."""
    return LocalFeatures(
        np.zeros((0, 2, 3)), np.zeros(0, np.float32), np.zeros((0, DESCRIPTOR_SIZE), np.float32)
    )


def root_normalized(descriptors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Divide non-negative rows by their sum and take square roots: rows of unit length."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(np.sqrt(descriptors / sums), dtype=np.float32)
