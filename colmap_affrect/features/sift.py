"""Features ``rootsift``: OpenCV's DoG and SIFT, described as RootSIFT; no weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np

from colmap_affrect.data import ColorImage, GrayImage, LocalFeatures, View
from colmap_affrect.features.base import (
    FeatureExtractor,
    FeatureOptions,
    NetworkContext,
)
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.arrays import Array, Bytes, Floats, Indices, Singles
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.options import within

MIN_IMAGE_SIZE_PX = 8  # of the shorter side, which OpenCV's scale space needs
SMALLEST_SUM = 1e-12  # of descriptors, which are divided by it; numeric


class DogOptions(FeatureOptions):
    """OpenCV's difference-of-Gaussians detector."""

    name: str = "dog"
    contrast_threshold: Annotated[float, within(0.0, 1.0)] = 0.013  # judged
    """OpenCV's contrast threshold; lower finds fainter features (OpenCV and the paper: 0.04)."""
    edge_threshold: Annotated[float, within(1.0, 1e6)] = 10.0
    """OpenCV's edge threshold: largest ratio of the principal curvatures of a keypoint."""
    num_octave_layers: Annotated[int, within(1, 10)] = 3  # OpenCV's
    """Scales in an octave."""
    sigma_px: Annotated[float, within(0.5, 10.0)] = 1.6  # OpenCV's
    """Blur of the first scale."""


class SiftOptions(DogOptions):
    """Features ``rootsift``."""

    name: Literal["rootsift"] = "rootsift"
    uses_network: ClassVar[bool] = False
    max_num_features: Annotated[int, within(1, 1_000_000)] = 13_000
    """Most features of the image itself, by response times scale: large ones are found again more
    often. Those of several orientations count as several, so this is about as many as COLMAP keeps
    of a large photograph, which counts 8192 before."""


class RootSift(FeatureExtractor):
    """DoG keypoints with RootSIFT descriptors (Arandjelovic & Zisserman 2012)."""

    Options = SiftOptions
    descriptor_size = 128

    def __init__(
        self, options: SiftOptions, network: NetworkContext | None = None
    ) -> None:
        del network
        self.options = options

    def detect(self, view: View) -> LocalFeatures:
        """Detect and describe in one pass over the scale space; none for images under 8 px.

        A keypoint with several orientations is one feature for each: the matcher's second neighbour
        never has the same position, so no match is lost. Of too many features the strongest by
        response times sigma are kept. They are returned by falling response.
        """
        image, mask = view
        if not is_searchable(image, mask):
            return LocalFeatures.empty(self.descriptor_size)
        keypoints, descriptors = make_sift(self.options).detectAndCompute(image, mask)
        if not keypoints:
            return LocalFeatures.empty(self.descriptor_size)
        ordered = by_falling_response(keypoints)
        strength = ordered.responses * ordered.sigmas_px
        strongest = np.argsort(-strength, kind="stable")
        kept = np.sort(strongest[: self.options.max_num_features])
        lafs = lafs_from_keypoints(
            ordered.points[kept],
            MEASUREMENT_SIGMAS * ordered.sigmas_px[kept],
            ordered.angles_rad[kept],
        )
        described = descriptors[ordered.order[kept]].astype(np.float32)
        return LocalFeatures(
            lafs=lafs,
            responses=ordered.responses[kept],
            descriptors=root_normalized(described),
        )


def root_normalized(descriptors: Floats) -> Singles:
    """Divide non-negative rows by their sum and take square roots: rows of unit length."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), SMALLEST_SUM)
    return np.asarray(np.sqrt(descriptors / sums), dtype=np.float32)


def make_sift(options: DogOptions) -> cv2.SIFT:
    """Build OpenCV's SIFT; ``enable_precise_upscale`` removes its bias of +0.25 px in x and y."""
    return cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=options.num_octave_layers,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        sigma=options.sigma_px,
        enable_precise_upscale=True,
    )


def is_searchable(image: GrayImage | ColorImage, mask: Bytes | None) -> bool:
    """Tell whether an image is large enough for OpenCV, not flat, and its mask not empty."""
    if min(image.shape[:2]) < MIN_IMAGE_SIZE_PX:
        return False
    has_contrast = bool(image.min() < image.max())
    return has_contrast and (mask is None or bool(mask.any()))


@dataclass(frozen=True)
class OrderedKeypoints:
    """OpenCV's keypoints by falling response."""

    order: Indices  # (N,) of OpenCV's keypoints
    points: Array  # (N, 2) px
    sigmas_px: Array  # (N,) Gaussian scales
    angles_rad: Array  # (N,) orientations
    responses: Singles  # (N,)


def by_falling_response(keypoints: Sequence[cv2.KeyPoint]) -> OrderedKeypoints:
    """Sort OpenCV's keypoints. OpenCV's ``size`` is the diameter of two sigmas."""
    responses = np.array(
        [keypoint.response for keypoint in keypoints], dtype=np.float32
    )
    points = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    sizes = np.array([keypoint.size for keypoint in keypoints], dtype=np.float64)
    angles_deg = np.array([keypoint.angle for keypoint in keypoints], dtype=np.float64)
    order = np.argsort(-responses, kind="stable")
    return OrderedKeypoints(
        order=order,
        points=points.reshape(-1, 2)[order],
        sigmas_px=sizes[order] / 2.0,
        angles_rad=angles_deg[order] * (np.pi / 180.0),
        responses=responses[order],
    )


def detect_dog(
    image: GrayImage, options: DogOptions, mask: Bytes | None = None
) -> LocalFeatures:
    """Detect DoG keypoints for descriptors that assign orientations themselves.

    OpenCV returns a keypoint once for each dominant orientation. These would become equal features,
    so only one of each position and scale is kept.

    Args:
        image: (H, W) uint8.
        options: of the detector.
        mask: (H, W) uint8, 0 where no keypoints are wanted.

    Returns:
        Upright circles of 6 sigma by falling response, descriptors (N, 0); none for images under
        8 px.
    """
    if not is_searchable(image, mask):
        return LocalFeatures.empty()
    ordered = by_falling_response(make_sift(options).detect(image, mask))
    positions = np.column_stack([ordered.points, ordered.sigmas_px])
    _, first = np.unique(positions, axis=0, return_index=True)
    kept = np.sort(first)[: options.max_num_features]
    radii_px = MEASUREMENT_SIGMAS * ordered.sigmas_px[kept]
    lafs = lafs_from_keypoints(ordered.points[kept], radii_px, np.zeros(len(kept)))
    return LocalFeatures(
        lafs=lafs,
        responses=ordered.responses[kept],
        descriptors=np.zeros((len(kept), 0), np.float32),
    )
