"""What guided matching does for one pair, in a thread of this process or on a worker."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.two_views import epipolar_pair, homography_of
from colmap_affrect.geometry.arrays import Array, Floats, Indices, Singles
from colmap_affrect.matchers.guided import (
    BANDS_OF_HOMOGRAPHY,
    EpipolarGuide,
    GuidableImage,
    Guide,
    GuidedOptions,
    HomographyGuide,
    guided_matches,
)
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.stores import FeatureStore, GuidedPair
from colmap_affrect.stages.one_pair import ImageCache

MIN_OFF_PLANE = 20  # fewer inliers off a plane may be accidental
Points = Array


@dataclass(frozen=True)
class GuidedTask:
    """One pair to match again."""

    names: Pair  # of the two images
    matrix: Array  # (3, 3) fundamental matrix, or a homography of image 2 from image 1
    is_homography: bool  # which of both
    points: tuple[Points, Points]  # (N, 2) keypoints in the pixels of the matrix
    inliers: Indices  # (M, 2) of the geometry

    def __str__(self) -> str:
        return " and ".join(self.names)

    def scaled(self, scales: tuple[float, float]) -> Self:
        """Return the same in pixels of images that are smaller by these factors."""
        first, second = (np.diag([scale, scale, 1.0]) for scale in scales)
        other = np.linalg.inv(second) if self.is_homography else second
        points = (self.points[0] / scales[0], self.points[1] / scales[1])
        return replace(self, matrix=other @ self.matrix @ first, points=points)

    def guide(self, band_px: float) -> Guide:
        """Return the geometry as what guides matches."""
        make = HomographyGuide if self.is_homography else EpipolarGuide
        return make(self.matrix, *self.points, band_px)


def guided_task(
    names: Pair,
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    keypoints: tuple[Floats, Floats],
    scales: tuple[float, float],
    geometry: pycolmap.TwoViewGeometry,
    band_px: float,
) -> GuidedTask | None:
    """Return what is to be done for a pair of a database where its geometry can guide, else None.

    The image of the lower id comes first. Keypoints are as in the database; scales the longer side
    of each image over that at which features were extracted: bands are as wide as features are
    exact.
    """
    inliers = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
    tolerance_px = BANDS_OF_HOMOGRAPHY * band_px * max(scales)
    homography = homography_of(geometry, keypoints, tolerance_px, MIN_OFF_PLANE)
    if homography is not None:
        first, second = (np.asarray(p[:, :2], np.float64) for p in keypoints)
        task = GuidedTask(names, homography, True, (first, second), inliers)
    else:
        pair = epipolar_pair(geometry, cameras, keypoints)
        if pair is None:
            return None
        task = GuidedTask(names, pair.fundamental, False, pair.points, inliers)
    return task.scaled(scales)


class GuidedMatcher:
    """Matches pairs again, with the features that it keeps of some images."""

    def __init__(self, store: FeatureStore, options: GuidedOptions) -> None:
        self._store, self._options = store, options
        self._images = ImageCache(self._read, lambda arrays: sum(x.nbytes for x in arrays))

    def __reduce__(self) -> tuple[Any, ...]:
        return GuidedMatcher, (self._store, self._options)

    def __call__(self, task: GuidedTask) -> GuidedPair:
        """Return the inliers of a pair and its guided matches."""
        first, second = (
            GuidableImage(descriptors, points, shapes)
            for points, (descriptors, shapes) in zip(
                task.points, map(self._images.get, task.names), strict=True
            )
        )
        guide = task.guide(self._options.band_px)
        both = guided_matches(first, second, guide, self._options, task.inliers)
        return GuidedPair(task.names, task.inliers, both, 0)

    def _read(self, name: str) -> tuple[Singles, Array]:
        features = self._store.read(name)
        return features.descriptors, features.lafs[:, :, :2]
