"""Contracts find what they are for: each of these parts is wrong in one way, and fails."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contracts.contracts import MapperContract, RectifierContract
from numpy.linalg import inv

from colmap_affrect.data import Photograph, RectificationPlan
from colmap_affrect.geometry.affine import fit_canvas, image_corners
from colmap_affrect.mappers.base import MAPPERS, MappedModel, Mapper, MappingTask
from colmap_affrect.rectifiers.affine_warps import AsiftOptions, plan_whole_image
from colmap_affrect.rectifiers.base import Rectifier

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


class OneRectifier(RectifierContract):
    def __init__(self, rectifier: Rectifier) -> None:
        self.rectifier = rectifier

    def make(self) -> Rectifier:
        return self.rectifier


@pytest.mark.parametrize("rectifier", [OtherDirection(), WrongWayRound()])
def test_warps_in_another_direction_than_they_say_are_found(
    rectifier: Rectifier,
) -> None:
    contract = OneRectifier(rectifier)
    with pytest.raises(AssertionError, match="Not equal to tolerance"):
        contract.test_plan_keeps_the_invariants_and_features_their_region("textured")


class Incremental:
    """COLMAP's incremental mapper, for others to change what it does."""

    def __init__(self) -> None:
        self.right = MAPPERS.make(MAPPERS.options("incremental"))
        self.options = self.right.options

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        return self.right.map(task, *others)


class MovesCameras(Incremental):
    """Changes cameras that are given."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        models = super().map(task, *others)
        for camera in models[0].reconstruction.cameras.values():
            camera.params = [*camera.params[:-1], camera.params[-1] + 0.01]
        return models


class NeverStops(Incremental):
    """Does not look at the token."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        task = replace(task, cancellation=None)
        return super().map(task, *others)


class FailsAsItLikes(Incremental):
    """Does not expect that there may be no model."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        models = super().map(task, *others)
        return [models[0]]


class HandlesSignals(Incremental):
    """Works in the main thread alone."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return super().map(task, *others)


class OneMapper(MapperContract):
    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper

    def make(self) -> Mapper:
        return self.mapper


def test_mapper_that_moves_given_cameras_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(MovesCameras())
    with pytest.raises(AssertionError, match="a given camera has changed"):
        contract.test_mapper_registers_tells_of_it_and_keeps_given_cameras(
            task, tmp_path
        )


def test_mapper_that_does_not_stop_is_found(task: MappingTask, tmp_path: Path) -> None:
    contract = OneMapper(NeverStops())
    with pytest.raises(pytest.fail.Exception, match="DID NOT RAISE"):
        contract.test_mapper_that_is_stopped_raises_and_leaves_no_model(task, tmp_path)


def test_mapper_that_fails_by_errors_of_its_own_is_found(
    unmatched_task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(FailsAsItLikes())
    with pytest.raises(IndexError):
        contract.test_mapper_makes_no_model_or_says_why_where_no_pair_is_verified(
            unmatched_task, tmp_path
        )


def test_mapper_for_the_main_thread_alone_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(HandlesSignals())
    with pytest.raises(ValueError, match="signal only works in main thread"):
        contract.test_mapper_makes_the_same_model_in_two_threads_at_once(task, tmp_path)
