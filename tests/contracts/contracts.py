"""What parts promise. One of another package can inherit its contract too.

Subclass, say how a part is made, and pytest runs the rest.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small_scene import INTRINSICS, NAMES
from synthetic import texture, unit_rows

from colmap_affrect.colmap import pycolmap
from colmap_affrect.data import (
    GrayImage,
    LocalFeatures,
    Photograph,
    Rectification,
    RectificationPlan,
    View,
)
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import lafs_from_keypoints, project, transform_lafs
from colmap_affrect.geometry.conventions import camera_matrix, is_inside
from colmap_affrect.geometry.tilts import (
    metrics_from_tilts,
    unit_metrics,
)
from colmap_affrect.mappers.base import (
    MAPPERS,
    MappedModel,
    Mapper,
    MapperOptions,
    MappingTask,
)
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.matchers.base import ImageFeatures, Matcher
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.base import Rectifier
from colmap_affrect.stages.one_image import ImageExtractor

UNIT_LENGTH_ERROR = 1e-4
SAME_DESCRIPTOR_ERROR = 1e-5
"""Networks sum in another order when a batch has another size."""
ROUNDING_PX = 1e-6
MAX_WARPED_AREAS = 100.0
"""Canvas areas of all warps of an image together, in image areas: the 24 of the near-optimal
cover at full area, each in a rotated bounding box, with room."""
NUM_THINGS = 60
METRIC_ERROR = 1e-6
"""Of the metric of a warp in the middle of its region, in float64."""

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


class Contract:
    """Of a part."""

    def make(self) -> Any:
        """Return the part under test."""
        raise NotImplementedError


class ExtractorContract(Contract):
    """Of a feature extractor."""

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
        assert is_inside(features.keypoints, (image.shape[1], image.shape[0])).all()
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
        assert (np.rint(features.keypoints[:, 0]) < 70).all()

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


def image_of(things: np.ndarray, seed: int) -> ImageFeatures:
    """Features that show some things, their descriptors a bit otherwise in every image."""
    random = np.random.default_rng(seed)
    rows = unit_rows(things + 0.02 * random.random(things.shape))
    count = len(things)
    centers = random.uniform((10.0, 20.0), (400.0, 280.0), (count, 2))
    lafs = lafs_from_keypoints(centers, random.uniform(3, 9, count), np.zeros(count))
    scores = random.random(count).astype(np.float32) + np.float32(0.1)
    return ImageFeatures(LocalFeatures(lafs, scores, rows), (420, 300), "")


class MatcherContract(Contract):
    """Of a matcher."""

    @pytest.fixture
    def things(self) -> np.ndarray:
        return np.random.default_rng(0).gamma(0.4, size=(NUM_THINGS, 128))

    def test_same_things_are_matched_in_rising_order_of_the_first_image(
        self, things
    ) -> None:
        matcher: Matcher = self.make()
        order = np.random.default_rng(1).permutation(NUM_THINGS)[:45]
        first = image_of(things, 2)
        second = image_of(things[order], 3)
        found = matcher.match(matcher.prepare(first), matcher.prepare(second))
        assert found.indices.dtype == np.int64
        assert found.indices.shape == (len(found.scores), 2)
        assert (np.diff(found.indices[:, 0]) > 0).all()
        assert len(np.unique(found.indices[:, 1])) == len(found.indices)
        right = order[found.indices[:, 1]] == found.indices[:, 0]
        assert right.mean() > 0.95
        assert right.sum() > 15  # a matcher may keep the better half
        assert found.scores.dtype == np.float32
        assert ((found.scores >= 0.0) & (found.scores <= 1.0)).all()

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


class RectifierContract(Contract):
    """Of a rectifier."""

    def extractor(self) -> ImageExtractor:
        rectifier: Rectifier = self.make()
        return ImageExtractor(
            ExtractionOptions(), (RootSift(SiftOptions()),), (rectifier,)
        )

    @pytest.mark.parametrize("kind", IMAGES)
    def test_plan_keeps_the_invariants_and_features_their_region(
        self, kind: str
    ) -> None:
        photograph = photograph_of(IMAGES[kind].copy())
        extractor = self.extractor()
        plan, _ = extractor.plan(photograph)
        assert_array_equal(photograph.gray, IMAGES[kind])  # which is left alone
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
        photograph = photograph_of(IMAGES["textured"])
        assert_same_plan(*(self.extractor().plan(photograph)[0] for _ in range(2)))


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
    assert 0.0 <= item.tilt_angle_rad < np.pi


def check_mapping(item: Rectification, points: np.ndarray) -> None:
    """A warp takes points onto its canvas, none through the horizon, and mirrors none."""
    matrix = item.rectified_from_image
    assert (points @ matrix[2, :2] + matrix[2, 2] > 0).all()
    mapped = project(matrix, points)
    assert (mapped >= -ROUNDING_PX).all()
    assert (mapped <= np.array(item.canvas_size) - 1 + ROUNDING_PX).all()
    shapes = np.tile(np.eye(2), (len(points), 1, 1))
    frames = np.concatenate([shapes, points[:, :, None]], axis=2)
    assert (np.linalg.det(transform_lafs(matrix, frames)[:, :, :2]) > 0).all()


def check_direction(item: Rectification, middle: np.ndarray) -> None:
    """A warp is stretched as it says, by its tilt, and along the direction that it says.

    A map the wrong way round, from the warp to the photograph, shrinks in that direction.
    """
    frame = np.concatenate([np.eye(2), middle[:, None]], axis=1)
    (mapped,) = transform_lafs(item.rectified_from_image, frame[None])
    said = metrics_from_tilts([item.tilt], [item.tilt_angle_rad])
    assert_allclose(unit_metrics(mapped[None, :, :2]), said, atol=METRIC_ERROR)


def assert_same_plan(first: RectificationPlan, second: RectificationPlan) -> None:
    assert len(first.items) == len(second.items)
    for one, other in zip(first.items, second.items, strict=True):
        assert_array_equal(one.rectified_from_image, other.rectified_from_image)
        assert one.canvas_size == other.canvas_size
        assert one.region_origin == other.region_origin
        np.testing.assert_equal(one.region, other.region)


class MapperContract(Contract):
    """Of a mapper."""

    def options(self) -> MapperOptions:
        """Return the options of the mapper under test."""
        raise NotImplementedError

    def make(self) -> Mapper:
        return MAPPERS.make(self.options())

    def test_mapper_registers_tells_of_it_and_keeps_given_cameras(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        shown: list[int] = []
        (model, *_) = map_database(self.make(), task, tmp_path / "sparse", shown.append)
        assert model.registered_names == tuple(sorted(NAMES))
        assert sum(shown) == len(NAMES)
        assert [path.name for path in tmp_path.iterdir()] == ["sparse"]
        written = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
        (camera,) = written.cameras.values()
        given = [float(value) for value in INTRINSICS.split(",")]
        assert camera.params.tolist() == given, "a given camera has changed"

    def test_mapper_has_presets_and_refuses_unknown_options(self) -> None:
        options = self.options().changed(random_seed=5, mapper_options={})
        colmap = type(options).preset("colmap")
        assert (colmap.preset_name, options.preset_name) == ("colmap", "sparse")
        with pytest.raises(OptionError, match="no such option"):
            MAPPERS.make(options.changed(mapper_options={"nonsense": 1}))

    def test_mapper_makes_no_model_or_says_why_where_no_pair_is_verified(
        self, unmatched_task: MappingTask, tmp_path: Path
    ) -> None:
        found: list[MappedModel] = []
        with suppress(AffrectError):
            found = self.make().map(unmatched_task, tmp_path, 0, lambda _: None)
        assert found == []

    def test_mapper_that_is_stopped_raises_and_leaves_no_model(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        token = pycolmap.CancellationToken()
        token.cancel()
        stopped = replace(task, cancellation=token)
        with pytest.raises(KeyboardInterrupt):
            map_database(self.make(), stopped, tmp_path / "sparse", lambda _: None)
        assert not (tmp_path / "sparse").exists()

    @pytest.mark.long
    def test_mapper_makes_the_same_model_in_two_threads_at_once(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        """Neither is the main one, which alone may handle signals."""
        mapper = self.make()

        def poses(number: int) -> dict[str, list[float]]:
            folder = tmp_path / str(number)
            folder.mkdir()
            (model, *_) = mapper.map(task, folder, 0, lambda _: None)
            return poses_by_name(model.reconstruction)

        with ThreadPoolExecutor(2) as threads:
            first, second = threads.map(poses, (1, 2))
        assert first.keys() == set(NAMES)
        assert first == second


def poses_by_name(model: pycolmap.Reconstruction) -> dict[str, list[float]]:
    """Return the matrix of each registered image in one row."""
    found = {}
    for image in model.images.values():
        if image.has_pose:
            found[image.name] = image.cam_from_world().matrix().ravel().tolist()
    return found
