"""What every matcher promises; subclasses say which one is tried."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.matchers.base import ImageFeatures, Matcher

NUM_THINGS = 60


def image_of(things: np.ndarray, seed: int, extractor: str = "rootsift") -> ImageFeatures:
    """Features that show some things, their descriptors a bit otherwise in every image."""
    random = np.random.default_rng(seed)
    rows = things + 0.02 * random.random(things.shape)
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    count = len(things)
    centers = random.uniform((10.0, 20.0), (400.0, 280.0), (count, 2))
    lafs = lafs_from_keypoints(centers, random.uniform(3, 9, count), np.zeros(count))
    scores = random.random(count).astype(np.float32) + np.float32(0.1)
    return ImageFeatures(LocalFeatures(lafs, scores, rows), (420, 300), extractor)


class MatcherContract:
    """Tests of one matcher."""

    def make(self) -> Matcher:
        """Build the matcher."""
        raise NotImplementedError

    @pytest.fixture
    def things(self) -> np.ndarray:
        return np.random.default_rng(0).gamma(0.4, size=(NUM_THINGS, 128))

    def test_same_things_are_matched_in_rising_order_of_the_first_image(self, things) -> None:
        matcher = self.make()
        order = np.random.default_rng(1).permutation(NUM_THINGS)[:45]
        first, second = image_of(things, 2), image_of(things[order], 3)
        found = matcher.match(matcher.prepare(first), matcher.prepare(second))
        assert found.indices.dtype == np.int64
        assert found.indices.shape == (len(found.scores), 2)
        assert (np.diff(found.indices[:, 0]) > 0).all()
        assert len(np.unique(found.indices[:, 1])) == len(found.indices)
        right = order[found.indices[:, 1]] == found.indices[:, 0]
        assert right.mean() > 0.95
        assert right.sum() > 40

    def test_scores_are_between_0_and_1(self, things) -> None:
        matcher = self.make()
        images = [matcher.prepare(image_of(things, seed)) for seed in (2, 3)]
        scores = matcher.match(*images).scores
        assert scores.dtype == np.float32
        assert len(scores)
        assert ((scores >= 0.0) & (scores <= 1.0)).all()

    def test_images_without_features_have_no_matches(self, things) -> None:
        matcher = self.make()
        empty = ImageFeatures(LocalFeatures.empty(128), (420, 300), "rootsift")
        some, none = matcher.prepare(image_of(things, 2)), matcher.prepare(empty)
        for pair in ((some, none), (none, some), (none, none)):
            found = matcher.match(*pair)
            assert found.indices.shape == (0, 2)
            assert len(found.scores) == 0

    def test_what_is_kept_of_an_image_has_a_size_and_serves_every_pair(self, things) -> None:
        matcher = self.make()
        first, second, third = (matcher.prepare(image_of(things, seed)) for seed in (2, 3, 4))
        assert first.nbytes > NUM_THINGS
        before = matcher.match(first, second)
        matcher.match(third, first)
        assert_array_equal(matcher.match(first, second).indices, before.indices)
