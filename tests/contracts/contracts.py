"""What parts promise. One of another package can inherit its contract too.

Subclass, say how a part is made, and pytest runs the rest.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from line_scenes import corner_of_walls
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import texture, unit_rows

from colmap_affrect.data import (
    GrayImage,
    LocalFeatures,
    Photograph,
    Rectification,
    RectificationPlan,
    View,
)
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import lafs_from_keypoints, project, transform_lafs
from colmap_affrect.geometry.conventions import camera_matrix, is_inside
from colmap_affrect.geometry.tilts import (
    metrics_from_tilts,
    unit_metrics,
)
from colmap_affrect.matchers.base import ImageFeatures, Matcher, Matches
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.base import Rectifier, RectifierOptions
from colmap_affrect.stages.one_image import ImageExtractor

UNIT_LENGTH_ERROR = 1e-4
SAME_DESCRIPTOR_ERROR = 1e-5
"""Networks sum in another order when a batch has another size."""
ROUNDING_PX = 1e-6
MAX_WARPED_AREAS = 100.0
"""Canvas areas of all warps of an image together, in image areas: the 24 of the near-optimal
cover at full area, each in a rotated bounding box, with room."""
NUM_THINGS = 60
SAME_SCORE = 1e-3
METRIC_ERROR = 1e-6
"""Of the metric of a warp in the middle of its region, in float64."""

TURNED_PX = 0.5
"""In a turned image an error of half a pixel counts twice; the bias of pyramids is less."""
TURNED_DEG = 20.0
MOVED_PX = 32
"""A whole number of cells of all networks."""

MIN_SAME = 0.1
"""Of features of an image whose nearest descriptor in a part of it is of the same place: 0.99 for
RootSIFT, 0.16 for a network of random weights, nearly none by chance."""

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


RECTIFIED_IMAGES = {
    **IMAGES,
    "widened": cv2.resize(texture((40, 90), 9), (120, 90)),
    "corner of walls": cv2.resize(
        corner_of_walls(), (240, 160), interpolation=cv2.INTER_AREA
    ),
}
"""For those that warp what is not seen from the front."""


def photograph_of(image: GrayImage) -> Photograph:
    size = (image.shape[1], image.shape[0])
    return Photograph(image, "folder/name.png", None, camera_matrix(size))


class Contract:
    """Of a part."""

    def make(self) -> Any:
        """Return the part under test."""
        raise NotImplementedError


class ExtractorContract(Contract):
    """Of a feature extractor."""

    frames_turn = True
    """Whether frames turn with the image: not those of upright features, nor of random weights."""

    def extract(self, view: View) -> LocalFeatures:
        extractor: FeatureExtractor = self.make()
        features = extractor.describe([view[0]], [extractor.detect(view)])[0]
        assert features.descriptors.shape == (len(features), extractor.descriptor_size)
        return features

    @pytest.mark.parametrize("kind", IMAGES)
    def test_features_are_well_formed(self, kind: str) -> None:
        image = IMAGES[kind]
        features = self.extract((image, None))
        assert features.descriptors.dtype == np.float32
        assert features.lafs.dtype == np.float64
        assert (features.responses > 0).all()
        lengths = np.linalg.norm(features.descriptors, axis=1)
        assert_allclose(lengths, 1.0, atol=UNIT_LENGTH_ERROR)
        size = (image.shape[1], image.shape[0])
        assert is_inside(features.keypoints, size).all(), (
            "keypoints outside of the image: x comes first, then y"
        )
        if kind == "textured":
            assert len(features) > 10
        if kind in ("flat", "black"):
            assert len(features) == 0

    def test_mask_leaves_features_where_it_is_set(self) -> None:
        image = IMAGES["textured"]
        mask = np.zeros_like(image)
        assert len(self.extract((image, mask))) == 0
        mask[:, :70] = 255
        features = self.extract((image, mask))
        assert len(features)
        assert (np.rint(features.keypoints[:, 0]) < 70).all(), (
            "features where the mask is 0: x comes first, then y"
        )

    def test_image_and_mask_are_left_alone(self) -> None:
        image = IMAGES["textured"].copy()
        mask = np.full_like(image, 255)
        mask[:, :70] = 0
        given = mask.copy()
        self.extract((image, mask))
        assert_array_equal(image, IMAGES["textured"], "the image has been changed")
        assert_array_equal(mask, given, "the mask has been changed")

    def test_features_with_like_descriptors_show_the_same_place(self) -> None:
        """In an image and in what is left of it without its first columns."""
        image = texture((320, 256), 4)
        whole = self.extract((image, None))
        part = self.extract((np.ascontiguousarray(image[:, MOVED_PX:]), None))
        nearest = (part.descriptors @ whole.descriptors.T).argmax(axis=1)
        moved = whole.keypoints[nearest] - part.keypoints
        is_same = np.abs(moved - (MOVED_PX, 0.0)).max(axis=1) < 1.0
        assert is_same.mean() > MIN_SAME, (
            "descriptors are not those of the keypoints in the same rows, or x is not before y"
        )

    def test_features_turn_with_the_image(self) -> None:
        """Coordinates are those of pixel centres, and frames are turned as what they show."""
        if not self.frames_turn:
            pytest.skip("its frames do not turn with the image")
        image = texture((240, 180), 8)
        upright = self.extract((image, None))
        turned = self.extract((np.ascontiguousarray(np.rot90(image)), None))
        quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, image.shape[1] - 1.0]])
        expected = quarter[:, :2] @ upright.lafs
        expected[:, :, 2] += quarter[:, 2]
        off_px, off_deg = differences_from_nearest(expected, turned.lafs)
        assert np.abs(np.median(off_px, axis=0)).max() < TURNED_PX, (
            "keypoints are not in pixel-centre px, where (0, 0) is the middle of the first pixel"
        )
        assert np.median(off_deg) < TURNED_DEG, (
            "frames do not turn with the image: their angle is another one, or turns the other "
            "way; frames_turn = False says that features are upright"
        )

    def test_images_together_and_one_by_one_give_the_same_every_time(self) -> None:
        extractor: FeatureExtractor = self.make()
        images = [texture((111, 140), 1), IMAGES["flat"], texture((111, 140), 2)]
        detected = [extractor.detect((image, None)) for image in images]
        together = extractor.describe(images, detected)
        for image, both in zip(images, together, strict=True):
            alone = self.extract((image, None))
            assert_allclose(both.lafs, alone.lafs, atol=SAME_DESCRIPTOR_ERROR, rtol=0)
            assert_allclose(
                both.descriptors, alone.descriptors, atol=SAME_DESCRIPTOR_ERROR
            )
        again = extractor.describe(images, detected)
        assert_array_equal(again[0].descriptors, together[0].descriptors)


def differences_from_nearest(
    expected: np.ndarray, found: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) px and (N,) degrees from frames to those found next to them.

    Of several in one place the one counts that is turned likewise.
    """
    offsets = found[None, :, :, 2] - expected[:, None, :, 2]
    distances = np.linalg.norm(offsets, axis=2)
    is_nearest = distances <= distances.min(axis=1, keepdims=True) + ROUNDING_PX
    angles = [np.arctan2(one[:, 1, 0], one[:, 0, 0]) for one in (expected, found)]
    turns = np.abs(np.angle(np.exp(1j * (angles[1][None, :] - angles[0][:, None]))))
    best = np.where(is_nearest, turns, np.inf).argmin(axis=1)
    rows = np.arange(len(expected))
    return offsets[rows, best], np.rad2deg(turns[rows, best])


def things_to_see() -> np.ndarray:
    """(N, 128) descriptors of things, none like another."""
    return np.random.default_rng(0).gamma(0.4, size=(NUM_THINGS, 128))


def image_of(things: np.ndarray, seed: int, noise: float = 0.02) -> ImageFeatures:
    """Features that show some things, their descriptors a bit otherwise in every image."""
    random = np.random.default_rng(seed)
    rows = unit_rows(things + noise * random.random(things.shape))
    count = len(things)
    centers = random.uniform((10.0, 20.0), (400.0, 280.0), (count, 2))
    lafs = lafs_from_keypoints(centers, random.uniform(3, 9, count), np.zeros(count))
    scores = random.random(count).astype(np.float32) + np.float32(0.1)
    return ImageFeatures(LocalFeatures(lafs, scores, rows), (420, 300), "")


class MatcherContract(Contract):
    """Of a matcher."""

    @pytest.fixture
    def things(self) -> np.ndarray:
        return things_to_see()

    def test_same_things_are_matched_in_rising_order_of_the_first_image(
        self, things
    ) -> None:
        matcher: Matcher = self.make()
        order = np.random.default_rng(1).permutation(NUM_THINGS)[:45]
        first = image_of(things, 2)
        second = image_of(things[order], 3)
        found = matcher.match(matcher.prepare(first), matcher.prepare(second))
        check_matches(found, len(first.features), len(second.features))
        check_right(order[found.indices[:, 1]] == found.indices[:, 0])

    def test_second_image_may_have_more_features(self, things) -> None:
        matcher: Matcher = self.make()
        order = np.random.default_rng(1).permutation(NUM_THINGS)[:45]
        first = image_of(things[order], 3)
        second = image_of(things, 2)
        found = matcher.match(matcher.prepare(first), matcher.prepare(second))
        check_matches(found, len(first.features), len(second.features))
        check_right(order[found.indices[:, 0]] == found.indices[:, 1])

    def test_scores_of_clear_matches_are_not_smaller(self, things) -> None:
        matcher: Matcher = self.make()
        first = matcher.prepare(image_of(things, 2))
        clear = matcher.match(first, matcher.prepare(image_of(things, 3)))
        noisy = matcher.match(first, matcher.prepare(image_of(things, 3, 0.4)))
        best = clear.scores.max(initial=0.0)
        assert best >= noisy.scores.max(initial=0.0) - SAME_SCORE, (
            "larger scores have to be better ones"
        )

    def test_features_are_left_alone(self, things) -> None:
        matcher: Matcher = self.make()
        first = image_of(things, 2)
        matcher.match(matcher.prepare(first), matcher.prepare(image_of(things, 3)))
        assert_array_equal(
            first.features.descriptors,
            image_of(things, 2).features.descriptors,
            "descriptors have been changed",
        )

    def test_images_without_features_have_no_matches(self, things) -> None:
        matcher: Matcher = self.make()
        empty = ImageFeatures(LocalFeatures.empty(128), (420, 300), "")
        some = matcher.prepare(image_of(things, 2))
        none = matcher.prepare(empty)
        for pair in ((some, none), (none, some), (none, none)):
            found = matcher.match(*pair)
            assert (found.indices.shape, len(found.scores)) == ((0, 2), 0)

    def test_what_is_kept_of_an_image_has_a_size_and_serves_every_pair(
        self, things
    ) -> None:
        matcher: Matcher = self.make()
        first, second, third = (
            matcher.prepare(image_of(things, seed)) for seed in (2, 3, 4)
        )
        assert first.nbytes > NUM_THINGS
        before = matcher.match(first, second)
        matcher.match(third, first)
        assert_array_equal(matcher.match(first, second).indices, before.indices)


def check_matches(found: Matches, num_first: int, num_second: int) -> None:
    """Matches are well formed for images with so many features."""
    assert found.indices.dtype == np.int64
    assert found.scores.dtype == np.float32
    fault = found.fault(num_first, num_second)
    assert not fault, (
        f"matches with {fault}: column 0 is of image 1, column 1 of image 2"
    )


def check_right(is_right: np.ndarray) -> None:
    assert is_right.mean() > 0.95, "features that show other things are matched"
    assert is_right.sum() > 15, "a matcher may keep the better half"


class RectifierContract(Contract):
    """Of a rectifier."""

    finds_warps = True
    """Whether there is something to warp in some of the images, for a rectifier that warps."""

    def options(self) -> RectifierOptions:
        """Return the options of the rectifier under test."""
        raise NotImplementedError

    def extractor(self) -> ImageExtractor:
        rectifier: Rectifier = self.make()
        return ImageExtractor(
            ExtractionOptions(), (RootSift(SiftOptions()),), (rectifier,)
        )

    @pytest.mark.parametrize("kind", RECTIFIED_IMAGES)
    def test_plan_keeps_the_invariants_and_features_their_region(
        self, kind: str
    ) -> None:
        image = RECTIFIED_IMAGES[kind]
        photograph = photograph_of(image.copy())
        extractor = self.extractor()
        plan, _ = extractor.plan(photograph)
        assert_array_equal(photograph.gray, image, "the photograph has been changed")
        assert plan.image_size == photograph.size
        if plan.original_region is not None:
            assert plan.original_region.shape == photograph.gray.shape
        area = photograph.gray.size
        assert plan.rectified_area_px <= MAX_WARPED_AREAS * max(area, 64 * 64)
        features = extractor.execute(photograph, plan)
        assert len(features) or kind != "textured"
        assert features.descriptors.shape == (len(features), 128)
        assert is_inside(features.keypoints, plan.image_size).all()
        for number, item in enumerate(plan.items, 1):
            check_rectification(item, photograph.size)
            of_warp = features.select(features.rectification_ids == number)
            assert item.in_region(of_warp.keypoints).all()

    def test_plan_is_the_same_every_time(self) -> None:
        """Also by one rectifier that has planned for another photograph meanwhile."""
        photograph = photograph_of(RECTIFIED_IMAGES["widened"])
        extractor = self.extractor()
        plan, _ = extractor.plan(photograph)
        extractor.plan(photograph_of(IMAGES["textured"]))
        assert_same_plan(plan, extractor.plan(photograph)[0])
        assert_same_plan(plan, self.extractor().plan(photograph)[0])

    def test_warps_are_as_many_as_the_options_say(self) -> None:
        """And somewhere there are some, or nothing else of this contract says anything."""
        rectifier: Rectifier = self.make()
        warps = self.options().warps
        counts = {}
        for kind, image in RECTIFIED_IMAGES.items():
            counts[kind] = len(rectifier.plan(photograph_of(image)).items)
        is_found = self.finds_warps and warps != "none"
        assert any(counts.values()) == is_found, (
            f"Options.warps is {warps!r}, but the numbers of warps are {counts}"
        )
        if warps == "all tilts":
            assert counts["flat"], "all tilts are there whatever the photograph shows"


def check_rectification(item: Rectification, size: tuple[int, int]) -> None:
    """The numbers of a warp are possible, and it takes its region onto its canvas."""
    check_numbers(item)
    width, height = size
    region = np.ones((height, width), bool) if item.region is None else item.region
    points = np.argwhere(region)[:, ::-1] + np.array(item.region_origin, dtype=float)
    assert len(points)
    assert (points >= 0).all()
    assert (points <= np.array([width - 1, height - 1])).all()
    check_mapping(item, points)
    check_direction(item, points.mean(axis=0))


def check_numbers(item: Rectification) -> None:
    matrix = item.rectified_from_image
    assert matrix.shape == (3, 3)
    assert np.isfinite(matrix).all()
    assert np.isfinite(item.image_from_rectified).all()
    assert min(item.canvas_size) >= 1
    assert item.tilt >= 1.0
    assert 0.0 <= item.tilt_angle_rad < np.pi, "radians, from 0 up to pi"


def check_mapping(item: Rectification, points: np.ndarray) -> None:
    """A warp takes points onto its canvas, none through the horizon, and mirrors none."""
    matrix = item.rectified_from_image
    assert (points @ matrix[2, :2] + matrix[2, 2] > 0).all(), "beyond the horizon"
    mapped = project(matrix, points)
    is_on_canvas = (mapped >= -ROUNDING_PX).all() and (
        mapped <= np.array(item.canvas_size) - 1 + ROUNDING_PX
    ).all()
    assert is_on_canvas, (
        f"the region goes from {mapped.min(axis=0)} to {mapped.max(axis=0)} of a canvas of "
        f"{item.canvas_size}: rectified_from_image takes px of the photograph to px of the warp"
    )
    shapes = np.tile(np.eye(2), (len(points), 1, 1))
    frames = np.concatenate([shapes, points[:, :, None]], axis=2)
    areas = np.linalg.det(transform_lafs(matrix, frames)[:, :, :2])
    assert (areas > 0).all(), "the warp is mirrored"


def check_direction(item: Rectification, middle: np.ndarray) -> None:
    """A warp is stretched as it says, by its tilt, and along the direction that it says.

    A map the wrong way round, from the warp to the photograph, shrinks in that direction.
    """
    frame = np.concatenate([np.eye(2), middle[:, None]], axis=1)
    (mapped,) = transform_lafs(item.rectified_from_image, frame[None])
    said = metrics_from_tilts([item.tilt], [item.tilt_angle_rad])
    assert_allclose(
        unit_metrics(mapped[None, :, :2]),
        said,
        atol=METRIC_ERROR,
        err_msg="the warp is stretched otherwise than tilt and tilt_angle_rad say: its map may be "
        "the one from the warp to the photograph",
    )


def assert_same_plan(first: RectificationPlan, second: RectificationPlan) -> None:
    assert len(first.items) == len(second.items)
    for one, other in zip(first.items, second.items, strict=True):
        assert_array_equal(one.rectified_from_image, other.rectified_from_image)
        assert one.canvas_size == other.canvas_size
        assert one.region_origin == other.region_origin
        np.testing.assert_equal(one.region, other.region)
