"""Features ``rootsift``: OpenCV's DoG and SIFT, described as RootSIFT; no weights."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np

from colmap_affrect.data import ColorImage, GrayImage, LocalFeatures, View
from colmap_affrect.features.base import FeatureExtractor, FeatureOptions, NetworkContext
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.arrays import Array, Bytes, Floats, Indices, Singles
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.options import within


class DogOptions(FeatureOptions):
    """OpenCV's difference-of-Gaussians detector."""

    name: str = "dog"
    contrast_threshold: Annotated[float, within(0.0, 1.0)] = 0.013
    """OpenCV's contrast threshold; lower finds fainter features (OpenCV and the paper: 0.04)."""
    edge_threshold: Annotated[float, within(1.0, 1e6)] = 10.0
    """OpenCV's edge threshold: largest ratio of the principal curvatures of a keypoint."""
    num_octave_layers: Annotated[int, within(1, 10)] = 3
    """Scales in an octave."""
    sigma_px: Annotated[float, within(0.5, 10.0)] = 1.6
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

    def __init__(self, options: SiftOptions, network: NetworkContext | None = None) -> None:
        del network
        self.options = options

    def detect(self, view: View) -> LocalFeatures:
        """Detect and describe in one pass over the scale space; none for images under 8 px.

        A location with several orientations yields one feature for each: the matcher's second
        neighbour never lies at the same location, so none is lost. Of too many the strongest by
        response times sigma are kept; they are returned by falling response.
        """
        image, mask = view
        if not is_searchable(image, mask):
            return LocalFeatures.empty(self.descriptor_size)
        keypoints, descriptors = make_sift(self.options).detectAndCompute(image, mask)
        if not keypoints:
            return LocalFeatures.empty(self.descriptor_size)
        order, rows, responses = by_falling_response(keypoints)
        strongest = np.argsort(-responses * rows[:, 2], kind="stable")
        best = np.sort(strongest[: self.options.max_num_features])
        rows = rows[best]
        lafs = lafs_from_keypoints(rows[:, :2], MEASUREMENT_SIGMAS * rows[:, 2], rows[:, 3])
        described = root_normalized(descriptors[order[best]].astype(np.float32))
        return LocalFeatures(lafs, responses[best], described)


def root_normalized(descriptors: Floats) -> Singles:
    """Divide non-negative rows by their sum and take square roots: rows of unit length."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(np.sqrt(descriptors / sums), dtype=np.float32)


MIN_IMAGE_SIZE_PX = 8  # OpenCV's scale space needs this much of the shorter side


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
    large = min(image.shape[:2]) >= MIN_IMAGE_SIZE_PX
    return large and bool(image.min() < image.max()) and (mask is None or bool(mask.any()))


def by_falling_response(keypoints: Sequence[cv2.KeyPoint]) -> tuple[Indices, Array, Singles]:
    """Return (N,) order, (N, 4) x, y, sigma in px and angle in radians, and (N,) responses."""
    responses = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
    order = np.argsort(-responses, kind="stable")
    rows = np.array([(*k.pt, k.size, k.angle) for k in keypoints], dtype=np.float64)
    rows = rows.reshape(-1, 4)[order] * (1.0, 1.0, 1.0 / 2.0, np.pi / 180.0)
    return order, rows, responses[order]


def detect_dog(image: GrayImage, options: DogOptions, mask: Bytes | None = None) -> LocalFeatures:
    """Detect DoG keypoints for descriptors that assign orientations themselves.

    OpenCV returns a location once for each dominant orientation; these would become equal features,
    so there is one per centre and scale. The (H, W) uint8 mask is 0 where none are wanted. Returns
    upright circles of 6 sigma by falling response, descriptors (N, 0); none for images under 8 px.
    """
    if not is_searchable(image, mask):
        return LocalFeatures.empty()
    _, rows, responses = by_falling_response(make_sift(options).detect(image, mask))
    _, first = np.unique(rows[:, :3], axis=0, return_index=True)
    kept = np.sort(first)[: options.max_num_features]
    rows = rows[kept]
    lafs = lafs_from_keypoints(rows[:, :2], MEASUREMENT_SIGMAS * rows[:, 2], np.zeros(len(rows)))
    return LocalFeatures(lafs, responses[kept], np.zeros((len(rows), 0), np.float32))
