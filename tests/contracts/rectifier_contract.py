"""What every rectifier promises; a rectifier of another package can inherit this too.

Subclass, say how one is made, and pytest runs the rest.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from synthetic import texture

from colmap_affrect.data import GrayImage, Photograph, Rectification, RectificationPlan
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import project, transform_frames
from colmap_affrect.geometry.conventions import camera_matrix
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.base import Rectifier
from colmap_affrect.stages.one_image import ImageExtractor

ROUNDING_PX = 1e-6
MAX_WARPED_AREAS = 100.0
"""Canvas areas of all warps of an image together, in image areas: the 24 of the near-optimal
cover at full area, each in a rotated bounding box, with room."""

IMAGES = {
    "textured": texture((117, 163), 7),
    "black": np.zeros((90, 61), np.uint8),
    "flat": np.full((64, 80), 131, np.uint8),
    "one row": texture((50, 1), 3),
    "one column": texture((1, 50), 3),
    "one pixel": np.full((1, 1), 9, np.uint8),
    "tiny": texture((7, 5), 5),
    "smallest rectified": texture((33, 32), 6),
}


def photograph_of(image: GrayImage) -> Photograph:
    size = (image.shape[1], image.shape[0])
    return Photograph(image, "folder/name.png", None, camera_matrix(size))


class RectifierContract:
    """Inherit and implement :meth:`make`."""

    def make(self) -> Rectifier:
        """Return the rectifier under test."""
        raise NotImplementedError

    def extractor(self) -> ImageExtractor:
        options = ExtractionOptions()
        return ImageExtractor(options, (RootSift(SiftOptions()),), (self.make(),))

    @pytest.mark.parametrize("kind", IMAGES)
    def test_plan_keeps_the_invariants(self, kind: str) -> None:
        photograph = photograph_of(IMAGES[kind])
        plan = self.extractor().plan(photograph)
        assert plan.image_size == photograph.size
        if plan.original_region is not None:
            assert plan.original_region.shape == photograph.gray.shape
        area = photograph.gray.size
        assert plan.rectified_area_px <= MAX_WARPED_AREAS * max(area, 64 * 64)
        for item in plan.items:
            check_rectification(item, photograph.size)

    @pytest.mark.parametrize("kind", IMAGES)
    def test_features_are_inside_the_image_and_their_region(self, kind: str) -> None:
        photograph = photograph_of(IMAGES[kind])
        extractor = self.extractor()
        plan = extractor.plan(photograph)
        features = extractor.execute(photograph, plan)
        assert len(features) or kind != "textured"
        assert features.descriptors.shape == (
            len(features),
            extractor.extractors[0].descriptor_size,
        )
        assert features.inside(plan.image_size).all()
        for number, item in enumerate(plan.items, 1):
            of_warp = features.select(features.rectification_ids == number)
            assert item.in_region(of_warp.keypoints).all()

    def test_plan_is_the_same_every_time(self) -> None:
        photograph = photograph_of(IMAGES["textured"])
        first = self.extractor().plan(photograph)
        second = self.extractor().plan(photograph)
        assert_same_plan(first, second)

    def test_image_is_left_alone(self) -> None:
        image = IMAGES["textured"].copy()
        self.extractor().plan(photograph_of(image))
        assert_array_equal(image, IMAGES["textured"])


def check_rectification(item: Rectification, size: tuple[int, int]) -> None:
    width, height = size
    matrix = item.rectified_from_image
    assert matrix.shape == (3, 3)
    assert np.isfinite(matrix).all()
    assert np.isfinite(item.image_from_rectified).all()
    assert min(item.canvas_size) >= 1
    assert item.tilt >= 1.0
    assert 0.0 <= item.tilt_angle_rad < np.pi
    points = region_pixels(item, size)
    assert len(points)
    assert (points >= 0).all()
    assert (points <= np.array([width - 1, height - 1])).all()
    assert (points @ matrix[2, :2] + matrix[2, 2] > 0).all()
    mapped = project(matrix, points)
    assert (mapped >= -ROUNDING_PX).all()
    assert (mapped <= np.array(item.canvas_size) - 1 + ROUNDING_PX).all()
    frames = np.concatenate([np.tile(np.eye(2), (len(points), 1, 1)), points[:, :, None]], axis=2)
    assert (np.linalg.det(transform_frames(matrix, frames)[:, :, :2]) > 0).all()


def region_pixels(item: Rectification, size: tuple[int, int]) -> np.ndarray:
    """All pixels (N, 2) of the region."""
    region = np.ones(size[::-1], bool) if item.region is None else item.region
    rows, columns = np.nonzero(region)
    return np.column_stack([columns, rows]) + np.array(item.region_origin, dtype=float)


def assert_same_plan(first: RectificationPlan, second: RectificationPlan) -> None:
    assert len(first.items) == len(second.items)
    for one, other in zip(first.items, second.items, strict=True):
        assert_array_equal(one.rectified_from_image, other.rectified_from_image)
        assert one.canvas_size == other.canvas_size
        assert one.region_origin == other.region_origin
        assert (one.region is None) == (other.region is None)
        if one.region is not None:
            assert_array_equal(one.region, other.region)
