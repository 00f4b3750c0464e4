"""What is done for one photograph, in a thread of this process or on a worker of a cluster."""

from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from colmap_affrect.data import (
    LocalFeatures,
    Mask,
    Photograph,
    RectificationPlan,
    in_mask,
)
from colmap_affrect.errors import MEMORY_HINT, DepthError, ImageError, lacks_memory
from colmap_affrect.features.base import (
    EXTRACTORS,
    SHAPES,
    FeatureExtractor,
    NetworkContext,
)
from colmap_affrect.features.weights import digests, resolve
from colmap_affrect.geometry.affine import transform_lafs
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.conventions import (
    camera_matrix,
    is_inside,
    resized_from_original,
)
from colmap_affrect.geometry.lines import Lines
from colmap_affrect.images import reading
from colmap_affrect.images.depth import DepthMaps
from colmap_affrect.images.lines import lines_of
from colmap_affrect.images.photographs import Photographs
from colmap_affrect.parallel.executor import available_cores, available_memory_bytes
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import ExtractionOptions, Level
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    CoverOptions,
    Rectifier,
    RectifierInputs,
)
from colmap_affrect.rectifiers.execute import extract_rectified
from colmap_affrect.session.context import Resources, require_same_files

# Shorter side; else no block would see its surroundings; theory
MIN_RECTIFIABLE_PX = 32


@dataclass(frozen=True)
class ExtractedImage:
    """Features of one image file."""

    features: LocalFeatures  # frames in px of the stored image
    image_size: tuple[int, int]  # (width, height) of the stored image in px
    warning: str = ""  # why it was not rectified; empty if all went well
    stretched: bool = False  # whether its contrast was low and was stretched
    mask_is_white: bool = False  # whether it has a mask, which leaves out nothing
    lines: Lines | None = None  # straight ones; None where they were not asked for


@dataclass(frozen=True)
class ImageTask:
    """One photograph to extract."""

    photographs: Photographs  # where it and its masks are
    name: str  # of the photograph
    level: int = 0  # of escalation: above 0 only the features that its rectifier adds
    # (3, 3) in pixel-centre px as stored; None: COLMAP's guess
    intrinsics: Array | None = None
    camera_size: tuple[int, int] | None = None  # (width, height) of its camera, if any


@dataclass(eq=False)
class ImageExtractor:
    """A recipe ready to work: built once by :func:`prepare`, called for every photograph.

    It may work on several images at once, in threads. In another process (pickled) it is prepared
    there anew, with the weights and the device found there.
    """

    options: ExtractionOptions  # of the recipe
    extractors: Mapping[
        int, FeatureExtractor
    ]  # by level, but those that wait for weights
    rectifiers: Mapping[int, Rectifier]  # of the same levels
    weights: Mapping[str, Path] = field(
        default_factory=dict
    )  # files of the networks by key
    resources: Resources = field(default_factory=Resources)  # that it was prepared with
    # held while networks run, which take one image at a time
    network_lock: AbstractContextManager[Any] = field(default_factory=Lock)

    def __reduce__(self) -> tuple[Any, ...]:
        return _prepared_elsewhere, (
            self.options,
            self.resources,
            digests(self.weights),
        )

    def __call__(self, task: ImageTask) -> ExtractedImage | ImageError:
        """Extract the features of a photograph, or return why it cannot be used."""
        path = task.photographs.folder / task.name
        try:
            mask = task.photographs.mask(task.name)
            found = self.extract_file(
                path,
                task.name,
                task.intrinsics,
                task.level,
                mask,
                with_lines=task.level == 0,
            )
        except ImageError as error:
            return error
        except Exception as error:
            if not lacks_memory(error):
                raise
            return ImageError(f"{path}: {MEMORY_HINT}")
        size = found.image_size
        expected = task.camera_size
        if expected and expected != size:
            return ImageError(
                f"{path}: is {size[0]} x {size[1]} px, and its camera in the database "
                f"{expected[0]} x {expected[1]} px; give the images that the database is of"
            )
        return replace(found, mask_is_white=mask is not None and bool(mask.all()))

    def extract_file(
        self,
        path: Path,
        name: str = "",
        intrinsics: Array | None = None,
        level: int = 0,
        mask: Mask | None = None,
        *,
        with_lines: bool = False,
    ) -> ExtractedImage:
        """Read an image and extract its features.

        Args:
            path: the file.
            name: key of its depth map; empty: the file's name.
            intrinsics: (3, 3) in pixel-centre px as stored; None: COLMAP's guess.
            level: of escalation: above 0 only the features that its rectifier adds.
            mask: (H, W) bool of the stored image, where features may be.
            with_lines: also measure its straight lines.

        Returns:
            The features, in px of the stored image.

        Raises:
            ImageError: the file cannot be read, or its mask has another size.
        """
        photograph, original_size = self.photograph(path, name, intrinsics, mask, level)
        with (
            self.network_lock
            if self.options.levels[level].uses_networks
            else nullcontext()
        ):
            plan, warning = self.plan(photograph, level)
            features = self.execute(photograph, plan, level)
        if photograph.size != original_size:
            resized = resized_from_original(original_size, photograph.size)
            frames = transform_lafs(np.linalg.inv(resized), features.lafs)
            features = replace(features, lafs=frames)
        keep = is_inside(features.keypoints, original_size)
        if mask is not None:
            keep &= in_mask(mask, features.keypoints)
        kept = features.select(keep)
        lines = lines_of(photograph.gray, photograph.mask) if with_lines else None
        return ExtractedImage(
            kept, original_size, warning, photograph.stretched, lines=lines
        )

    def photograph(
        self,
        path: Path,
        name: str = "",
        intrinsics: Array | None = None,
        mask: Mask | None = None,
        level: int = 0,
    ) -> tuple[Photograph, tuple[int, int]]:
        """Read an image at the size of processing; also return its stored (width, height)."""
        stored = reading.decode(path)
        black_and_white = (
            reading.tones(stored) if self.options.stretch_contrast else None
        )
        image = reading.in_eight_bits(stored, black_and_white)
        original_size = (image.shape[1], image.shape[0])
        chosen = self.options.levels[level]
        limit = chosen.max_image_size_px
        gray = reading.shrink_to(image, limit)
        color = None
        if chosen.features.in_color:
            color = reading.read_color(
                path, limit, stretch=self.options.stretch_contrast
            )
        size = (gray.shape[1], gray.shape[0])
        original_camera = (
            camera_matrix(original_size) if intrinsics is None else intrinsics
        )
        camera = resized_from_original(original_size, size) @ original_camera
        if mask is not None:
            mask = reading.shrink_mask(mask, size)
        stretched = black_and_white is not None
        found = Photograph(
            gray, name or path.name, path, camera, mask, color, stretched
        )
        return found, original_size

    def plan(
        self, photograph: Photograph, level: int = 0
    ) -> tuple[RectificationPlan, str]:
        """Decide which warps to look at; without a usable depth map none, and say why."""
        if min(photograph.size) < MIN_RECTIFIABLE_PX:
            return RectificationPlan(photograph.size), ""
        try:
            return self.rectifiers[level].plan(photograph), ""
        except DepthError as error:
            return RectificationPlan(photograph.size), f"not rectified: {error}"

    def execute(
        self, photograph: Photograph, plan: RectificationPlan, level: int = 0
    ) -> LocalFeatures:
        """Extract the features of a level's plan, frames in px of the photograph.

        Those of the image itself only where no lower level has them.
        """
        chosen = self.options.levels[level]
        return extract_rectified(
            photograph.gray if photograph.color is None else photograph.color,
            plan,
            self.extractors[level],
            chosen.features.max_num_rectified_features,
            with_original=chosen.base == level,
            mask=photograph.mask,
        )


def num_images_at_once(levels: Collection[Level]) -> int:
    """Return how many images are worked on at once in this process, for features of some levels.

    They take at most half of the memory there is. With networks at most two: one is read while
    the networks run on the other.
    """
    num_bytes = max(x.features.bytes_per_px * x.max_image_size_px**2 for x in levels)
    most = 2 if any(level.uses_networks for level in levels) else available_cores()
    return min(most, max(1, available_memory_bytes() // 2 // num_bytes))


def prepare(
    options: ExtractionOptions,
    resources: Resources | None = None,
    image_names: Sequence[str] | None = None,
    progress: Progress = SILENT,
) -> ImageExtractor:
    """Find everything a recipe needs, before any image is touched, and build its parts.

    Levels of escalation whose weights are not here are left out. ``image_names`` are those to come,
    to see whether there are depth maps for them. AffrectError when a file of weights is neither
    found nor downloaded, or the device is not there, OptionError when depth maps are needed and no
    source is given, DepthError when the folder of depth maps has none of the images.
    """
    resources = resources or Resources()
    options.check_depth()
    levels = {k: options.levels[k] for k in resources.usable_levels(options)}
    parts = {part for level in levels.values() for part in level.network_parts}
    keys = sorted({key for part in parts for key in part.weights})
    weights = resolve(keys, resources.weights_path, progress=progress)
    uses_network = any(level.uses_networks for level in options.levels)
    device = resources.require_device(uses_network=uses_network)
    network = NetworkContext(weights, device)
    depth = None
    extractor = cache(lambda features: EXTRACTORS.make(features, network))
    extractors = {k: extractor(level.features) for k, level in levels.items()}
    if options.uses_depth:
        depth = DepthMaps(options.depth)
        if image_names is not None:
            depth.require_some(image_names)
    shapes = cache(lambda source, features: SHAPES.make(source, network, features))

    def rectifier(level: Level) -> Rectifier:
        item = level.rectifier
        source = None
        if isinstance(item, CoverOptions):
            source = shapes(item.shape_source, level.features)
        return RECTIFIERS.make(
            item, RectifierInputs(source, depth if item.uses_depth else None)
        )

    rectifiers = {k: rectifier(level) for k, level in levels.items()}
    return ImageExtractor(options, extractors, rectifiers, weights, resources)


def _prepared_elsewhere(
    options: ExtractionOptions, resources: Resources, sent: Mapping[str, str]
) -> ImageExtractor:
    """Prepare a recipe in another process."""
    extractor = prepare(options, resources)
    require_same_files(extractor.weights, sent)
    return extractor
