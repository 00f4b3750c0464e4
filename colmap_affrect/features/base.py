"""The protocols of feature extractors and of sources of affine shapes, and their registries.

Those of other packages are entry points of the groups ``colmap_affrect.features`` and
``colmap_affrect.shapes``. Several threads may call one object.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Protocol

from colmap_affrect.data import GrayImage, LocalFeatures, ShapeGrid, ShapeSamples, View
from colmap_affrect.options import PartOptions, Registry, within

PATCH_SIZE_PX = 32  # side of the patches that all networks take; paper


@dataclass(frozen=True)
class NetworkContext:
    """Files of weights and the device of networks."""

    weights: Mapping[str, Path] = field(default_factory=dict)  # files by key; all exist
    device: str = "cpu"  # or ``cuda``, ``cuda:1``, ``mps``


class NetworkOptions(PartOptions):
    """Base of the options of parts that may run on torch."""

    uses_network: ClassVar[bool] = True
    """Whether it runs on torch, one image at a time."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Keys of the files of weights that the part reads."""
        return ()


class FeatureOptions(NetworkOptions):
    """Base of the options of all feature extractors."""

    in_color: ClassVar[bool] = False
    """Whether views are (H, W, 3) instead of (H, W)."""
    bytes_per_px: ClassVar[int] = 256  # measured
    """Memory of the extraction of one image, roughly."""
    has_shapes: ClassVar[bool] = True
    """Whether LAFs were measured one by one, so that they can tell right matches from wrong."""
    max_num_features: Annotated[int, within(1, 1_000_000)] = 8192  # COLMAP's
    """Most features of the image itself, by response."""
    max_num_rectified_features: Annotated[int, within(1, 1_000_000)] = 6144  # resource
    """Most features of all warps together, by response."""


class FeatureExtractor(Protocol):
    """Detection and description; called with its ``Options`` and a :class:`NetworkContext`."""

    descriptor_size: int  # D, also of an image without features

    def detect(self, view: View) -> LocalFeatures:
        """Return features of one view, LAFs in its px; descriptors may still be (N, 0)."""

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        """Describe the features of :meth:`detect`.

        Images described together and one by one have the same descriptors. By default features are
        described already.

        Args:
            images: (H, W) uint8 images.
            detected: features of each image.

        Returns:
            Described features of each image, some of which may be left out.
        """
        del images
        return list(detected)


EXTRACTORS: Registry[FeatureExtractor] = Registry(
    kind="feature extractor",
    group="colmap_affrect.features",
    built_in={
        "rootsift": "colmap_affrect.features.sift:RootSift",
        "affnet-hardnet": "colmap_affrect.features.affnet_hardnet:AffNetHardNet",
        "aliked": "colmap_affrect.features.learned:Aliked",
    },
    default="rootsift",
    protocol=FeatureExtractor,
    options_base=FeatureOptions,
)


class ShapeOptions(NetworkOptions):
    """Base of the options of all shape sources."""


class ShapeSource(Protocol):
    """Affine shapes of an image.

    Called with its ``Options``, a :class:`NetworkContext` and the :class:`FeatureOptions` of the
    recipe, whose keypoints may be those that shapes are read at.
    """

    def grid(self, image: GrayImage) -> ShapeGrid:
        """Return one shape per 4 x 4 block of a (H, W) uint8 image."""

    def samples(self, image: GrayImage) -> ShapeSamples:
        """Return shapes at points of a (H, W) uint8 image."""


SHAPES: Registry[ShapeSource] = Registry(
    kind="shape source",
    group="colmap_affrect.shapes",
    built_in={
        "second-moment": "colmap_affrect.features.second_moment:SecondMoment",
        "affnet": "colmap_affrect.features.affnet_shapes:AffNet",
    },
    default="second-moment",
    protocol=ShapeSource,
    options_base=ShapeOptions,
)
