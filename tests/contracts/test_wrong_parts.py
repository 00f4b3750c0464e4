"""Contracts find what they are for: each of these parts is wrong in one way, and fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contracts.contracts import (
    ExtractorContract,
    MatcherContract,
    RectifierContract,
    things_to_see,
)
from numpy.linalg import inv

from colmap_affrect.data import LocalFeatures, Photograph, RectificationPlan, View
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import fit_canvas, image_corners
from colmap_affrect.matchers.base import (
    MATCHERS,
    ImageFeatures,
    Matcher,
    MatcherContext,
    Matches,
)
from colmap_affrect.rectifiers.affine_warps import AsiftOptions, plan_whole_image
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    Rectifier,
    RectifierInputs,
    RectifierOptions,
)
from colmap_affrect.rectifiers.regions import Region

TILT = 2.0
ANGLE_RAD = 0.4


class OtherDirection:
    """Turns the wrong way: its warp is stretched in another direction than it says."""

    def plan(self, photograph: Photograph) -> RectificationPlan:
        centers = np.array([[TILT, np.pi - ANGLE_RAD]])
        plan = plan_whole_image(photograph.size, centers, AsiftOptions())
        (item,) = plan.items
        return replace(plan, items=(replace(item, tilt_angle_rad=ANGLE_RAD),))


class WrongWayRound:
    """Gives the map from the warp to the photograph."""

    def plan(self, photograph: Photograph) -> RectificationPlan:
        centers = np.array([[TILT, ANGLE_RAD]])
        plan = plan_whole_image(photograph.size, centers, AsiftOptions())
        (item,) = plan.items
        linear = inv(item.rectified_from_image)[:2, :2]
        matrix, canvas = fit_canvas(linear, image_corners(photograph.size), 0.0)
        warp = replace(item, rectified_from_image=matrix, canvas_size=canvas)
        return replace(plan, items=(warp,))


class OffItsCanvas:
    """Its map is half a pixel off."""

    def plan(self, photograph: Photograph) -> RectificationPlan:
        shift = np.eye(3)
        shift[:2, 2] = -0.5
        centers = np.array([[TILT, ANGLE_RAD]])
        plan = plan_whole_image(photograph.size, centers, AsiftOptions())
        (item,) = plan.items
        matrix = shift @ item.rectified_from_image
        return replace(plan, items=(replace(item, rectified_from_image=matrix),))


class OtherRegion:
    """Says of a region that it is where its mask begins, not where that is in the photograph."""

    def plan(self, photograph: Photograph) -> RectificationPlan:
        region = Region(mask=np.ones((20, 20), bool), origin=(60, 40))
        item = AsiftOptions().warp(region, TILT, ANGLE_RAD, 0)
        return RectificationPlan(
            photograph.size, (replace(item, region_origin=(0, 0)),)
        )


class Remembers:
    """Plans for the first photograph alone."""

    def __init__(self) -> None:
        self.known = False

    def plan(self, photograph: Photograph) -> RectificationPlan:
        centers = np.array([[TILT, ANGLE_RAD]] * (not self.known)).reshape(-1, 2)
        self.known = True
        return plan_whole_image(photograph.size, centers, AsiftOptions())


class OneRectifier(RectifierContract):
    def __init__(self, rectifier: Rectifier) -> None:
        self.rectifier = rectifier

    def options(self) -> RectifierOptions:
        return AsiftOptions()

    def make(self) -> Rectifier:
        return self.rectifier


@pytest.mark.parametrize("rectifier", [OtherDirection(), WrongWayRound()])
def test_warps_in_another_direction_than_they_say_are_found(
    rectifier: Rectifier,
) -> None:
    with pytest.raises(AssertionError, match="stretched otherwise than tilt"):
        OneRectifier(
            rectifier
        ).test_plan_keeps_the_invariants_and_features_their_region("textured")


def test_warps_half_a_pixel_off_their_canvas_are_found() -> None:
    with pytest.raises(AssertionError, match="of a canvas of"):
        OneRectifier(
            OffItsCanvas()
        ).test_plan_keeps_the_invariants_and_features_their_region("textured")


def test_region_in_another_place_than_its_warp_is_found() -> None:
    with pytest.raises(AssertionError, match="of a canvas of"):
        OneRectifier(
            OtherRegion()
        ).test_plan_keeps_the_invariants_and_features_their_region("widened")


def test_rectifier_that_remembers_photographs_is_found() -> None:
    with pytest.raises(AssertionError):
        OneRectifier(Remembers()).test_plan_is_the_same_every_time()


def test_rectifier_that_warps_nothing_or_other_than_it_says_is_found() -> None:
    identity = RECTIFIERS.make(RECTIFIERS.options("identity"), RectifierInputs())
    with pytest.raises(AssertionError, match="is 'all tilts'"):
        OneRectifier(identity).test_warps_are_as_many_as_the_options_say()


class WrongExtractor(FeatureExtractor):
    """RootSIFT, whose features are changed."""

    descriptor_size = 128

    def __init__(
        self, change: Callable[[LocalFeatures, View], LocalFeatures | None]
    ) -> None:
        self.change = change

    def detect(self, view: View) -> LocalFeatures:
        features = RootSift(SiftOptions()).detect(view)
        return self.change(features, view) or features


CENTERS = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
"""Of frames: 1 where the keypoint is."""
OTHER_SIGNS = np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]])


def exchange(features: LocalFeatures, _: View) -> LocalFeatures:
    exchanged = np.where(CENTERS > 0.0, features.lafs[:, ::-1], features.lafs)
    return replace(features, lafs=exchanged)


def move_half_a_pixel(features: LocalFeatures, _: View) -> LocalFeatures:
    return replace(features, lafs=features.lafs + 0.5 * CENTERS)


def turn_the_other_way(features: LocalFeatures, _: View) -> LocalFeatures:
    return replace(features, lafs=features.lafs * OTHER_SIGNS)


def mix_up_descriptors(features: LocalFeatures, _: View) -> LocalFeatures:
    return replace(features, descriptors=features.descriptors[::-1])


def change_the_image(_: LocalFeatures, view: View) -> None:
    view[0][0, 0] += 1


class OneExtractor(ExtractorContract):
    def __init__(self, change: Callable[..., LocalFeatures | None]) -> None:
        self.change = change

    def make(self) -> FeatureExtractor:
        return WrongExtractor(self.change)


def test_extractor_that_exchanges_x_and_y_is_found() -> None:
    contract = OneExtractor(exchange)
    with pytest.raises(AssertionError, match="x comes first, then y"):
        contract.test_features_are_well_formed("textured")
    with pytest.raises(AssertionError, match="x is not before y"):
        contract.test_features_with_like_descriptors_show_the_same_place()


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (move_half_a_pixel, "pixel-centre px"),
        (turn_the_other_way, "turns the other way"),
    ],
)
def test_features_that_do_not_turn_with_the_image_are_found(
    change: Callable[..., LocalFeatures], what: str
) -> None:
    with pytest.raises(AssertionError, match=what):
        OneExtractor(change).test_features_turn_with_the_image()


def test_descriptors_of_other_keypoints_are_found() -> None:
    with pytest.raises(AssertionError, match="not those of the keypoints"):
        OneExtractor(
            mix_up_descriptors
        ).test_features_with_like_descriptors_show_the_same_place()


def test_extractor_that_changes_the_image_is_found() -> None:
    with pytest.raises(AssertionError, match="the image has been changed"):
        OneExtractor(change_the_image).test_image_and_mask_are_left_alone()


class WrongMatcher:
    """The usual matcher, for others to change."""

    right = MATCHERS.make(MATCHERS.options("nearest"), MatcherContext())

    def prepare(self, image: ImageFeatures) -> Any:
        return self.right.prepare(image)

    def match(self, first: Any, second: Any) -> Matches:
        return self.right.match(first, second)


class SwapsColumns(WrongMatcher):
    """Gives the features of image 2 first."""

    def match(self, first: Any, second: Any) -> Matches:
        found = super().match(first, second)
        return Matches(found.indices[:, ::-1], found.scores)


class NeedsFewer(WrongMatcher):
    """Fails where image 2 has more features."""

    def match(self, first: Any, second: Any) -> Matches:
        if second.nbytes > first.nbytes:
            raise IndexError
        return super().match(first, second)


class SmallerIsBetter(WrongMatcher):
    """Gives distances for scores."""

    def match(self, first: Any, second: Any) -> Matches:
        found = super().match(first, second)
        return Matches(found.indices, np.float32(1.0) - found.scores)


class ChangesFeatures(WrongMatcher):
    """Works on what it was given."""

    def prepare(self, image: ImageFeatures) -> Any:
        image.features.descriptors[:] *= -1.0
        return super().prepare(image)


class OneMatcher(MatcherContract):
    def __init__(self, matcher: Matcher) -> None:
        self.matcher = matcher

    def make(self) -> Matcher:
        return self.matcher


THINGS = things_to_see()


def test_matcher_that_swaps_columns_is_found() -> None:
    with pytest.raises(AssertionError, match="column 0 is of image 1"):
        OneMatcher(
            SwapsColumns()
        ).test_same_things_are_matched_in_rising_order_of_the_first_image(THINGS)


def test_matcher_that_needs_fewer_features_in_image_2_is_found() -> None:
    contract = OneMatcher(NeedsFewer())
    contract.test_same_things_are_matched_in_rising_order_of_the_first_image(THINGS)
    with pytest.raises(IndexError):
        contract.test_second_image_may_have_more_features(THINGS)


def test_matcher_whose_smaller_scores_are_better_is_found() -> None:
    with pytest.raises(AssertionError, match="larger scores have to be better"):
        OneMatcher(SmallerIsBetter()).test_scores_of_clear_matches_are_not_smaller(
            THINGS
        )


def test_matcher_that_changes_features_is_found() -> None:
    with pytest.raises(AssertionError, match="descriptors have been changed"):
        OneMatcher(ChangesFeatures()).test_features_are_left_alone(THINGS)
