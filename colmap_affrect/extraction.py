"""Features of image files by the options of a recipe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import camera_matrix, resized_from_original
from colmap_affrect.depth import depth_source
from colmap_affrect.errors import DepthError, ImageError, OptionError, WeightsError
from colmap_affrect.executor import unless_gpu_is_full
from colmap_affrect.features.registry import (
    make_profile,
    make_shape_source,
    needed_weights,
    shape_sources,
    uses_networks,
)
from colmap_affrect.features.weights import file_sha256, resolve
from colmap_affrect.geometry.affine import transform_frames
from colmap_affrect.imaging import SHARED_OPENCV_THREADS, read_gray, shrink_mask, shrink_to
from colmap_affrect.interfaces import Computing, FeatureProfile, Rectifier, Sources
from colmap_affrect.options import CoverOptions, ExtractionOptions
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.rectified import extract_rectified
from colmap_affrect.rectifiers.registry import make_rectifier
from colmap_affrect.types import (
    GrayImage,
    LocalFeatures,
    Mask,
    Photograph,
    RectificationPlan,
    in_mask,
)

MIN_RECTIFIABLE_PX = 32
"""Images with a shorter side are not rectified: no block would see its surroundings."""

MEMORY_IS_FULL = "extracted on the CPU, the memory of the GPU is full"


@dataclass(frozen=True)
class Resources:
    """What extraction needs from outside and what does not change its results.

    Attributes:
        weights_path: folder with the weights of networks; None searches the usual places.
        device: ``auto``, ``cpu``, ``cuda``, ``cuda:1``, ``mps``.
        depth_cache_path: folder that keeps the depth maps of a network; None keeps none.
    """

    weights_path: Path | None = None
    device: str = "auto"
    depth_cache_path: Path | None = None


@dataclass(frozen=True)
class ExtractedImage:
    """Features of one image file.

    Attributes:
        features: frames in px of the stored image.
        image_size: (width, height) of the stored image in px.
        warning: why it was not rectified though it was to be, or not on the GPU; empty if all
            went well.
    """

    features: LocalFeatures
    image_size: tuple[int, int]
    warning: str = ""


@dataclass(frozen=True)
class ImageExtractor:
    """A recipe ready to work: built once by :func:`prepare`, used for every image.

    It may work on several images at once, in threads. In another process (pickled) it is prepared
    there anew, with the weights and the device found there.

    Attributes:
        options: of the recipe.
        profile: detector and descriptor.
        rectifiers: one per level, that of every image first, then those of escalation.
        weights: files of the networks by key.
        resources: that it was prepared with.
        turn: held while networks run, which take one image at a time.
    """

    options: ExtractionOptions
    profile: FeatureProfile
    rectifiers: tuple[Rectifier, ...]
    weights: Mapping[str, Path] = field(default_factory=dict)
    resources: Resources = field(default_factory=Resources)
    turn: AbstractContextManager[Any] = field(default_factory=nullcontext)

    def __reduce__(self) -> tuple[Callable[..., ImageExtractor], tuple[Any, ...]]:
        digests = {key: file_sha256(path) for key, path in self.weights.items()}
        return _prepared_elsewhere, (self.options, self.resources, digests)

    def extract_file(
        self,
        path: Path,
        name: str = "",
        intrinsics: NDArray[np.float64] | None = None,
        level: int = 0,
        mask: Mask | None = None,
    ) -> ExtractedImage:
        """Read an image and extract its features.

        Args:
            path: the image file.
            name: key of its depth map; the file's name by default.
            intrinsics: (3, 3) camera matrix in pixel-centre px of the stored image; by default
                COLMAP's guess of a focal length of 1.2 times the longer side.
            level: 0 for the features that every image gets; above that, only those that the
                rectifier of this level of escalation adds.
            mask: (H, W) bool of the stored image, where features may be; None means everywhere.

        Raises:
            ImageError: when the file cannot be read, or its mask has another size.
        """
        photograph, original_size = self.photograph(path, name, intrinsics, mask)
        with self.turn, SHARED_OPENCV_THREADS:
            features, warning = unless_gpu_is_full(
                lambda: self._features(photograph, level),
                lambda: self._features_on_cpu(photograph, level),
            )
        if photograph.size != original_size:
            original_from_resized = np.linalg.inv(
                resized_from_original(original_size, photograph.size)
            )
            features = features.with_frames(transform_frames(original_from_resized, features.lafs))
        keep = features.inside(original_size)
        if mask is not None:
            keep &= in_mask(mask, features.keypoints)
        return ExtractedImage(features.select(keep), original_size, warning)

    def _features(self, photograph: Photograph, level: int) -> tuple[LocalFeatures, str]:
        """Plan and execute; also say what went wrong."""
        plan, warning = self.plan_or_warn(photograph, level)
        features = self.execute(
            photograph.gray, plan, with_original=level == 0, mask=photograph.mask
        )
        return features, warning

    def _features_on_cpu(self, photograph: Photograph, level: int) -> tuple[LocalFeatures, str]:
        features, warning = self._on_cpu._features(photograph, level)
        return features, "; ".join(filter(None, (MEMORY_IS_FULL, warning)))

    @cached_property
    def _on_cpu(self) -> ImageExtractor:
        return prepare(self.options, replace(self.resources, device="cpu"))

    def photograph(
        self,
        path: Path,
        name: str = "",
        intrinsics: NDArray[np.float64] | None = None,
        mask: Mask | None = None,
    ) -> tuple[Photograph, tuple[int, int]]:
        """Read an image at the size of processing; also return its stored (width, height)."""
        image = read_gray(path)
        if mask is not None and mask.shape != image.shape:
            raise ImageError(
                f"{path}: is {image.shape[1]} x {image.shape[0]} px and its mask "
                f"{mask.shape[1]} x {mask.shape[0]} px; they must have one size"
            )
        original_size = (image.shape[1], image.shape[0])
        gray = shrink_to(image, self.options.max_image_size_px)
        size = (gray.shape[1], gray.shape[0])
        original_camera = camera_matrix(original_size) if intrinsics is None else intrinsics
        camera = resized_from_original(original_size, size) @ original_camera
        if mask is not None:
            mask = shrink_mask(mask, size)
        return Photograph(gray, name or path.name, path, camera, mask), original_size

    def plan(self, photograph: Photograph, level: int = 0) -> RectificationPlan:
        """Decide which warps of a photograph to look at.

        Raises:
            DepthError: when the rectifier needs a depth map and it cannot be used.
        """
        if min(photograph.size) < MIN_RECTIFIABLE_PX:
            return RectificationPlan(photograph.size)
        return self.rectifiers[level].plan(photograph)

    def execute(
        self,
        image: GrayImage,
        plan: RectificationPlan,
        *,
        with_original: bool = True,
        mask: Mask | None = None,
    ) -> LocalFeatures:
        """Extract the features of a plan, frames in px of the (H, W) uint8 image."""
        limit = self.options.features.max_num_rectified_features
        return extract_rectified(
            image, plan, self.profile, limit, with_original=with_original, mask=mask
        )

    def plan_or_warn(self, photograph: Photograph, level: int = 0) -> tuple[RectificationPlan, str]:
        """Plan; without a usable depth map plan no warps and say why, else say nothing."""
        try:
            return self.plan(photograph, level), ""
        except DepthError as error:
            return RectificationPlan(photograph.size), f"not rectified: {error}"


def extract_image(image: GrayImage, options: ExtractionOptions | None = None) -> LocalFeatures:
    """Extract the features of one (H, W) uint8 image, frames in its px.

    For many images build the extractor once with :func:`prepare`.
    """
    extractor = prepare(options or ExtractionOptions())
    size = (image.shape[1], image.shape[0])
    photograph = Photograph(image, "", None, camera_matrix(size))
    return extractor.execute(image, extractor.plan(photograph))


def prepare(
    options: ExtractionOptions,
    resources: Resources | None = None,
    image_names: Sequence[str] | None = None,
    progress: Progress = SILENT,
) -> ImageExtractor:
    """Find everything a recipe needs, before any image is touched, and build its parts.

    Args:
        options: of the recipe.
        resources: weights, device, cache.
        image_names: the images to come, to see whether there are depth maps for them.
        progress: where to show downloads.

    Raises:
        WeightsError: when a file of weights is neither found nor downloaded.
        DeviceError: when the device is not there.
        OptionError: when depth maps are needed and no source is given.
        DepthError: when the folder of depth maps has none of the images.
    """
    resources = resources or Resources()
    weights = resolve(needed_weights(options), resources.weights_path, progress=progress)
    computing = Computing(weights, _device(options, resources))
    profile = make_profile(options.features, computing)
    depth = None
    needing = [item.name for item in options.rectifiers if item.uses_depth]
    if needing:
        depth = depth_source(options.depth, resources.depth_cache_path, computing.device)
        if depth is None:
            raise OptionError(
                f"rectifier {needing[0]} needs depth maps: give --depth-path FOLDER, or "
                "--depth-model NAME for a monocular depth network"
            )
        if image_names is not None:
            depth.require_some(image_names)
    shapes = {name: make_shape_source(name, options, computing) for name in shape_sources(options)}
    rectifiers = tuple(
        make_rectifier(
            item,
            Sources(
                shapes[item.shape_source] if isinstance(item, CoverOptions) else None,
                depth if item.uses_depth else None,
            ),
        )
        for item in options.rectifiers
    )
    turn = Lock() if uses_networks(options) else nullcontext()
    return ImageExtractor(options, profile, rectifiers, weights, resources, turn)


def _prepared_elsewhere(
    options: ExtractionOptions, resources: Resources, digests: Mapping[str, str]
) -> ImageExtractor:
    """Prepare a recipe in another process; depth maps of networks are not kept from there."""
    extractor = prepare(options, replace(resources, depth_cache_path=None))
    for key, path in extractor.weights.items():
        if file_sha256(path) != digests[key]:
            raise WeightsError(
                f"{path}: is another file than {key} on the machine that leads the work; give "
                "both the same"
            )
    return extractor


def _device(options: ExtractionOptions, resources: Resources) -> str:
    """Return the device that is there; torch is asked only when it is needed."""
    if resources.device in ("auto", "cpu") and not uses_networks(options):
        return "cpu"
    from colmap_affrect.features.networks import resolve_device

    return str(resolve_device(resources.device))
