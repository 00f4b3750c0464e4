"""What every feature extractor promises; one of another package can inherit this too."""

from __future__ import annotations

import numpy as np
import pytest
from contracts.rectifier_contract import IMAGES
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import texture

from colmap_affrect.data import GrayImage, LocalFeatures, View
from colmap_affrect.features.base import FeatureExtractor

UNIT_LENGTH_ERROR = 1e-4
SAME_DESCRIPTOR_ERROR = 1e-5
"""Networks sum in another order when a batch has another size."""


class ExtractorContract:
    """Inherit and implement :meth:`make`."""

    def make(self) -> FeatureExtractor:
        """Return the extractor under test."""
        raise NotImplementedError

    def extract(self, view: View) -> LocalFeatures:
        extractor = self.make()
        return extractor.describe([view[0]], [extractor.detect(view)])[0]

    @pytest.mark.parametrize("kind", IMAGES)
    def test_features_are_well_formed(self, kind: str) -> None:
        image = IMAGES[kind]
        features = self.extract((image, None))
        assert features.descriptors.shape == (len(features), self.make().descriptor_size)
        assert features.descriptors.dtype == np.float32
        assert features.lafs.dtype == np.float64
        assert (features.responses > 0).all()
        lengths = np.linalg.norm(features.descriptors, axis=1)
        assert_allclose(lengths, 1.0, atol=UNIT_LENGTH_ERROR)
        assert features.inside((image.shape[1], image.shape[0])).all()
        if kind == "textured":
            assert len(features) > 10
        if kind in ("flat", "black"):
            assert len(features) == 0

    def test_zero_mask_leaves_nothing(self) -> None:
        image = IMAGES["textured"]
        features = self.extract((image, np.zeros_like(image)))
        assert len(features) == 0
        assert features.descriptors.shape == (0, self.make().descriptor_size)

    def test_mask_leaves_features_where_it_is_set(self) -> None:
        image = IMAGES["textured"]
        mask = np.zeros_like(image)
        mask[:, :70] = 255
        features = self.extract((image, mask))
        assert len(features)
        assert (np.rint(features.keypoints[:, 0]) < 70).all()

    def test_result_is_the_same_every_time(self) -> None:
        first, second = self.extract((image_of(8), None)), self.extract((image_of(8), None))
        assert_array_equal(first.lafs, second.lafs)
        assert_array_equal(first.descriptors, second.descriptors)

    def test_images_together_and_one_by_one_give_the_same(self) -> None:
        extractor = self.make()
        images = [image_of(1), IMAGES["flat"], image_of(2)]
        detected = [extractor.detect((image, None)) for image in images]
        together = extractor.describe(images, detected)
        for image, found, both in zip(images, detected, together, strict=True):
            alone = extractor.describe([image], [found])[0]
            assert_allclose(both.lafs, alone.lafs, atol=SAME_DESCRIPTOR_ERROR, rtol=0)
            assert_allclose(both.descriptors, alone.descriptors, atol=SAME_DESCRIPTOR_ERROR)


def image_of(seed: int) -> GrayImage:
    return texture((111, 140), seed)
