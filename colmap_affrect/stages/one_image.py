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
from colmap_affrect.errors import DepthError, lacks_memory, with_flags
from colmap_affrect.features.base import (
    EXTRACTORS,
    SHAPES,
    FeatureExtractor,
    NetworkContext,
)
from colmap_affrect.features.weights import digests, is_published, resolve
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
from colmap_affrect.images.masks import shrink_mask
from colmap_affrect.images.orientation import picture_down
from colmap_affrect.images.photographs import Photographs
from colmap_affrect.parallel.executor import available_cores, available_memory_bytes
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.image_failures import UnusableImageError, unusable
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
    not_rectified: str = ""  # why it was not; empty if all went well
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
    # By level that was asked for, but those that wait for weights
    extractors: Mapping[int, FeatureExtractor]
    rectifiers: Mapping[int, Rectifier]  # of the same levels
    # Files of the networks by key
    weights: Mapping[str, Path] = field(default_factory=dict)
    resources: Resources = field(default_factory=Resources)  # that it was prepared with
    # It lacks the levels of escalation whose weights are the published ones
    only_first: bool = False
    # Held while networks run, which take one image at a time
    network_lock: AbstractContextManager[Any] = field(default_factory=Lock)

    def __reduce__(self) -> tuple[Any, ...]:
        sent = digests(self.weights)
        given = self.options, self.resources, sent, self.only_first
        return _prepare_elsewhere, given

    def __call__(self, task: ImageTask) -> ExtractedImage | UnusableImageError:
        """Extract the features of a photograph, or return why it cannot be used."""
        path = task.photographs.folder / task.name
        try:
            mask = task.photographs.mask(task.name)
            found = self.extract_file(
                path,
                name=task.name,
                intrinsics=task.intrinsics,
                level=task.level,
                mask=mask,
                with_lines=task.level == 0,
            )
        except UnusableImageError as error:
            return error
        except Exception as error:
            if not lacks_memory(error):
                raise
            return unusable("no_memory", path)
        size = found.image_size
        expected = task.camera_size
        if expected and expected != size:
            return unusable(
                "camera_of_another_size",
                path,
                width=size[0],
                height=size[1],
                camera_width=expected[0],
                camera_height=expected[1],
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
        uses_networks = self.options.levels[level].uses_networks
        with self.network_lock if uses_networks else nullcontext():
            plan, not_rectified = self.plan(photograph, level)
            features = self.execute(photograph, plan, level)
        if photograph.size != original_size:
            resized = resized_from_original(original_size, photograph.size)
            frames = transform_lafs(np.linalg.inv(resized), features.lafs)
            features = replace(features, lafs=frames)
        lines = None
        if with_lines:
            down = picture_down(path)
            lines = lines_of(photograph.gray, photograph.mask, down)
        keep = is_inside(features.keypoints, original_size)
        if mask is not None:
            keep &= in_mask(mask, features.keypoints)

        return ExtractedImage(
            features=features.select(keep),
            image_size=original_size,
            not_rectified=not_rectified,
            stretched=photograph.stretched,
            lines=lines,
        )

    def photograph(
        self,
        path: Path,
        name: str = "",
        intrinsics: Array | None = None,
        mask: Mask | None = None,
        level: int = 0,
    ) -> tuple[Photograph, tuple[int, int]]:
        """Read an image at the size of processing; also return its stored (width, height).

        Args:
            path: the file.
            name: key of its depth map; empty: the file's name.
            intrinsics: (3, 3) in pixel-centre px as stored; None: COLMAP's guess.
            mask: (H, W) bool of the stored image, where features may be.
            level: of escalation, which may have a size of its own.

        Raises:
            ImageError: the file cannot be read.
        """
        stored = reading.decode(path)
        stretches = self.options.stretch_contrast
        black_and_white = reading.tones(stored) if stretches else None
        image = reading.in_eight_bits(stored, black_and_white)
        original_size = (image.shape[1], image.shape[0])
        chosen = self.options.levels[level]
        limit = chosen.max_image_size_px
        gray = reading.shrink_to(image, limit)
        color = None
        if chosen.features.in_color:
            color = reading.read_color(path, max_size_px=limit, stretch=stretches)
        size = (gray.shape[1], gray.shape[0])
        if intrinsics is None:
            intrinsics = camera_matrix(original_size)
        photograph = Photograph(
            gray=gray,
            name=name or path.name,
            path=path,
            camera_matrix=resized_from_original(original_size, size) @ intrinsics,
            mask=None if mask is None else shrink_mask(mask, size),
            color=color,
            stretched=black_and_white is not None,
        )
        return photograph, original_size

    def plan(
        self, photograph: Photograph, level: int = 0
    ) -> tuple[RectificationPlan, str]:
        """Decide which warps to look at.

        Args:
            photograph: at the size of processing.
            level: of escalation.

        Returns:
            The plan, and why it has no warps where a depth map cannot be used; else empty.
        """
        if min(photograph.size) < MIN_RECTIFIABLE_PX:
            return RectificationPlan(photograph.size), ""
        try:
            return self.rectifiers[level].plan(photograph), ""
        except DepthError as error:
            return RectificationPlan(photograph.size), with_flags(error.words)

    def execute(
        self, photograph: Photograph, plan: RectificationPlan, level: int = 0
    ) -> LocalFeatures:
        """Extract the features of a level's plan.

        Those of the image itself are extracted only where no lower level has them.

        Args:
            photograph: at the size of processing.
            plan: its warps.
            level: of escalation.

        Returns:
            The features, LAFs in px of the photograph.
        """
        chosen = self.options.levels[level]
        return extract_rectified(
            photograph.gray if photograph.color is None else photograph.color,
            plan,
            extractor=self.extractors[level],
            max_num_rectified=chosen.features.max_num_rectified_features,
            with_original=chosen.base == level,
            mask=photograph.mask,
        )


def num_images_at_once(levels: Collection[Level]) -> int:
    """Return how many images are worked on at once in this process, for features of some levels.

    They take at most half of the memory there is. With networks at most two: one is read while
    the networks run on the other.
    """
    needed = [
        level.features.bytes_per_px * level.max_image_size_px**2 for level in levels
    ]
    uses_networks = any(level.uses_networks for level in levels)
    most = 2 if uses_networks else available_cores()
    return min(most, max(1, available_memory_bytes() // 2 // max(needed)))


def find_weights(
    options: ExtractionOptions, resources: Resources, progress: Progress = SILENT
) -> dict[str, Path]:
    """Return the files of weights that extraction needs, by key.

    Args:
        options: of the recipe.
        resources: where weights are.
        progress: where to show downloads.

    Raises:
        AffrectError: a file of weights is neither found nor downloaded.
    """
    keys = set[str]()
    for level in _usable_levels(options, resources).values():
        keys |= _weights_of(level)
    return resolve(sorted(keys), resources.weights_path, progress=progress)


def _usable_levels(
    options: ExtractionOptions, resources: Resources
) -> dict[int, Level]:
    """Return the levels by number, but those of escalation that wait for weights."""
    return {k: options.levels[k] for k in resources.usable_levels(options)}


def prepare(
    options: ExtractionOptions,
    resources: Resources | None = None,
    image_names: Sequence[str] | None = None,
    progress: Progress = SILENT,
    *,
    only_first: bool = False,
) -> ImageExtractor:
    """Find everything a recipe needs, before any image is touched, and build its parts.

    Levels of escalation whose weights are not here are left out.

    Args:
        options: of the recipe.
        resources: weights and device; None: the usual places, and any device.
        image_names: of the images to come, to see whether there are depth maps for them; None: do
            not look.
        progress: where to show downloads.
        only_first: build no parts of levels of escalation whose weights are the published ones, so
            that torch is not loaded for them; all others are tried nevertheless.

    Returns:
        What is called for every photograph.

    Raises:
        AffrectError: a file of weights is neither found nor downloaded, or the device is not there.
        OptionError: depth maps are needed, and no folder is given, or it has none of the images.
    """
    resources = resources or Resources()
    options.check_depth()
    levels = _usable_levels(options, resources)
    weights = find_weights(options, resources, progress)
    if only_first:
        levels = _first_and_unpublished(levels, weights)
    uses_network = any(level.uses_networks for level in levels.values())
    network = NetworkContext(
        weights, resources.require_device(uses_network=uses_network)
    )
    extractor_of = cache(lambda features: EXTRACTORS.make(features, network))
    extractors = {k: extractor_of(level.features) for k, level in levels.items()}
    depth = None
    if options.uses_depth:
        depth = DepthMaps(options.depth)
        if image_names is not None:
            depth.require_some(image_names)
    return ImageExtractor(
        options=options,
        extractors=extractors,
        rectifiers=_rectifiers(levels, network, depth),
        weights=weights,
        resources=resources,
        only_first=only_first,
    )


def _first_and_unpublished(
    levels: Mapping[int, Level], weights: Mapping[str, Path]
) -> dict[int, Level]:
    """Return the first level, and those that do not work with published weights alone."""
    published = {key for key, path in weights.items() if is_published(key, path)}
    found = {}
    for number, level in levels.items():
        needed = _weights_of(level)
        if number == 0 or not needed or not published.issuperset(needed):
            found[number] = level
    return found


def _weights_of(level: Level) -> set[str]:
    """Return the keys of the weights that extraction by a level needs."""
    return {key for part in level.network_parts for key in part.weights}


def _rectifiers(
    levels: Mapping[int, Level], network: NetworkContext, depth: DepthMaps | None
) -> dict[int, Rectifier]:
    """Build the rectifiers of levels; those of equal shape sources share one."""
    source_of = cache(lambda source, features: SHAPES.make(source, network, features))
    rectifiers = {}
    for number, level in levels.items():
        item = level.rectifier
        inputs = RectifierInputs(
            source_of(item.shape_source, level.features)
            if isinstance(item, CoverOptions)
            else None,
            depth if item.uses_depth else None,
        )
        rectifiers[number] = RECTIFIERS.make(item, inputs)
    return rectifiers


def _prepare_elsewhere(
    options: ExtractionOptions,
    resources: Resources,
    sent: Mapping[str, str],
    only_first: bool,
) -> ImageExtractor:
    """Prepare a recipe in another process."""
    extractor = prepare(options, resources, only_first=only_first)
    require_same_files(extractor.weights, sent)
    return extractor
