"""Bundle adjustment with priors on intrinsics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyceres
import pytest
from mapping_tasks import synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers.adjustment import (
    FINAL,
    Adjuster,
    CostStop,
    IntrinsicsCost,
)
from colmap_affrect.mappers.camera_priors import (
    CameraPrior,
    PrincipalPointPrior,
    camera_prior,
    usual_principal_point,
)
from colmap_affrect.mappers.tie_points import TiePoints

TRUE_FOCAL = 1280.0
SIZE = (1024, 768)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> pycolmap.Reconstruction:
    """A right model of images with a camera each, whose distortion is 0.05."""
    path: Path = tmp_path_factory.mktemp("scene") / "database.db"
    return synthesize(path, num_rigs=4, num_points3D=150, noise_px=0.5)


@pytest.mark.parametrize(("num_points", "min_track_length"), [(60, 2), (200, 3)])
def test_tracks_of_two_are_left_out_where_all_images_see_a_hundred_longer_ones(
    tmp_path: Path, num_points: int, min_track_length: int
) -> None:
    seen_by_all = synthesize(
        tmp_path / "database.db", num_rigs=4, num_points3D=num_points
    )
    priors = dict.fromkeys(seen_by_all.cameras, CameraPrior(TRUE_FOCAL, 0.1))
    adjuster = Adjuster(priors, 0.5, pycolmap.BundleAdjustmentOptions())
    assert adjuster._options(seen_by_all, ()).min_track_length == min_track_length


def mean_distortion(model: pycolmap.Reconstruction, noise_px: float) -> float:
    """Adjust a copy of a model, with known focal lengths, to keypoints of some noise."""
    trial = pycolmap.Reconstruction(model)
    priors = dict.fromkeys(model.cameras, CameraPrior(TRUE_FOCAL, 1e-4))
    Adjuster(priors, noise_px, pycolmap.BundleAdjustmentOptions()).adjust(trial, FINAL)
    return float(np.mean([camera.params[3] for camera in trial.cameras.values()]))


def test_distortion_is_found_by_exact_keypoints_and_stays_near_zero_by_noisy_ones(
    model: pycolmap.Reconstruction,
) -> None:
    assert 0.02 < mean_distortion(model, 0.5) < 0.08
    assert abs(mean_distortion(model, 5.0)) < 0.01


def cost_of(factor: float, **known: str) -> float:
    """What a focal length costs that is so many times the expected one."""
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", TRUE_FOCAL, *SIZE
    )
    prior = camera_prior(
        camera, CameraRecord(("a",), size=SIZE, focal_px=TRUE_FOCAL, **known)
    )
    return prior.cost(factor * prior.focal_px)


def test_lenses_from_wide_to_long_cost_little_and_others_much() -> None:
    for factor in (0.5, 0.7, 1.0, 1.4, 2.0):
        assert cost_of(factor, source="guess") < 4.0
    assert cost_of(5.0, source="guess") > 4.0


def test_a_focal_length_by_exif_may_be_off_by_a_tenth_and_not_by_half() -> None:
    assert cost_of(1.1, source="exif") < 1.0
    assert cost_of(1.5, source="exif") > 4.0


def deviations(
    model: pycolmap.Reconstruction, prior: CameraPrior
) -> pycolmap.Reconstruction:
    """Adjust a copy of a model, whose cameras all have one prior."""
    trial = pycolmap.Reconstruction(model)
    priors = dict.fromkeys(model.cameras, prior)
    Adjuster(priors, 0.5, pycolmap.BundleAdjustmentOptions()).adjust(trial, FINAL)
    return trial


def test_cost_of_an_adjustment_and_of_a_score_have_the_same_prior() -> None:
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", TRUE_FOCAL, *SIZE
    )
    for factor in (0.4, 0.8, 1.0, 2.5):
        prior = CameraPrior(TRUE_FOCAL / factor, 0.3, usual_principal_point(camera))
        camera.params = [TRUE_FOCAL, SIZE[0] / 2 + 9.0, SIZE[1] / 2 - 5.0, 0.0]
        cost = IntrinsicsCost(camera, prior, 0.5, constant=[])
        residuals = np.zeros(4)
        jacobian = np.zeros(16)
        assert cost.Evaluate([camera.params], residuals, [jacobian])
        assert 0.5 * (residuals @ residuals) / 0.5**2 == pytest.approx(
            prior.cost_of(camera)
        )
        for index, step in enumerate([1e-3, 1e-3, 1e-3, 1e-6]):
            moved = camera.params.copy()
            moved[index] += step
            changed = np.zeros(4)
            cost.Evaluate([moved], changed, None)
            slopes = (changed - residuals) / step
            assert jacobian.reshape(4, 4)[:, index] == pytest.approx(
                slopes, rel=1e-4, abs=1e-6
            )


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_two_focal_lengths_of_a_camera_cost_as_much_as_one(model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, TRUE_FOCAL, *SIZE)
    prior = CameraPrior(0.7 * TRUE_FOCAL, 0.3)
    cost = IntrinsicsCost(camera, prior, 0.5, constant=[])
    residuals = np.zeros(len(camera.params))
    assert cost.Evaluate([camera.params], residuals, None)
    nats = 0.5 * (residuals @ residuals) / 0.5**2
    assert nats == pytest.approx(prior.cost_of(camera))


def test_a_distortion_of_a_seventh_costs_as_much_as_two_deviations() -> None:
    distorted = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", TRUE_FOCAL, *SIZE
    )
    distorted.params = [TRUE_FOCAL, SIZE[0] / 2, SIZE[1] / 2, 0.14]
    cost = IntrinsicsCost(distorted, CameraPrior(TRUE_FOCAL, 0.3), 0.5, constant=[])
    residuals = np.zeros(4)
    assert cost.Evaluate([distorted.params], residuals, None)
    assert residuals == pytest.approx([0.0, 0.0, 0.0, 2.0 * 0.5])


def test_focal_lengths_without_information_go_to_their_prior_also_from_far_away(
    model: pycolmap.Reconstruction,
) -> None:
    trial = pycolmap.Reconstruction(model)
    for camera in trial.cameras.values():
        camera.params = [TRUE_FOCAL * 1.2, *camera.params[1:]]
    priors = dict.fromkeys(model.cameras, CameraPrior(TRUE_FOCAL, 1e-5))
    Adjuster(priors, 0.5, pycolmap.BundleAdjustmentOptions()).adjust(trial, FINAL)
    for camera in trial.cameras.values():
        assert camera.params[0] == pytest.approx(TRUE_FOCAL, rel=1e-3)


def test_principal_points_move_only_where_they_are_unknown(
    model: pycolmap.Reconstruction,
) -> None:
    shifted = pycolmap.Reconstruction(model)
    for camera in shifted.cameras.values():
        camera.params = [
            *camera.params[:2],
            camera.params[2] - 40.0,
            *camera.params[3:],
        ]
    known = CameraPrior(TRUE_FOCAL, 0.05)
    for camera in deviations(shifted, known).cameras.values():
        assert camera.params[2] == SIZE[1] / 2 - 40.0
    unknown = replace(known, principal_point=PrincipalPointPrior(
        (SIZE[0] / 2, SIZE[1] / 2), (20.0, 20.0)
    ))  # fmt: skip
    found = deviations(shifted, unknown).cameras.values()
    assert np.mean([camera.params[2] for camera in found]) > SIZE[1] / 2 - 20.0


def test_distortion_that_images_cannot_tell_stays_as_it_is(
    model: pycolmap.Reconstruction,
) -> None:
    straight = pycolmap.Reconstruction(model)
    for camera in straight.cameras.values():
        camera.params = [*camera.params[:3], 0.0]
    told = CameraPrior(TRUE_FOCAL, 0.05)
    held = replace(told, has_distortion=False)
    assert all(c.params[3] == 0.0 for c in deviations(straight, held).cameras.values())
    assert all(c.params[3] != 0.0 for c in deviations(straight, told).cameras.values())


@pytest.mark.parametrize(("gain", "ends"), [(0.003, True), (0.05, False), (3.0, False)])
def test_an_adjustment_that_is_compared_ends_where_steps_gain_next_to_nothing(
    gain: float, *, ends: bool
) -> None:
    stop = CostStop()
    stop.noise_px = 2.0
    found = []
    for iteration in range(6):
        step = SimpleNamespace(
            iteration=iteration,
            step_is_successful=True,
            cost_change=gain * 4.0,  # in squared px
        )
        found.append(stop(step))
    kinds = pyceres.CallbackReturnType
    ended = kinds.SOLVER_TERMINATE_SUCCESSFULLY in found
    assert ended == ends
    assert found[:3] == [kinds.SOLVER_CONTINUE] * 3


def test_a_model_that_is_only_compared_has_the_cost_of_a_converged_one(
    model: pycolmap.Reconstruction,
) -> None:
    priors = dict.fromkeys(model.cameras, CameraPrior(TRUE_FOCAL, 0.1))
    converging = Adjuster(priors, 0.5, pycolmap.BundleAdjustmentOptions())
    comparing = replace(converging, compares_only=True)
    costs = []
    for adjuster in (converging, comparing):
        trial = pycolmap.Reconstruction(model)
        for camera in trial.cameras.values():
            camera.params = [1.1 * camera.params[0], *camera.params[1:3], 0.0]
        costs.append(adjuster.adjust(trial, FINAL))
    assert costs[0] <= costs[1] < costs[0] + 0.5


def test_distortion_has_its_prior_where_the_focal_length_is_given(
    model: pycolmap.Reconstruction,
) -> None:
    """Else noisy keypoints of few points bend the lens."""
    trial = pycolmap.Reconstruction(model)
    priors = dict.fromkeys(model.cameras, CameraPrior(TRUE_FOCAL, 0.0))
    Adjuster(priors, 5.0, pycolmap.BundleAdjustmentOptions()).adjust(trial, FINAL)
    cameras = trial.cameras.values()
    assert [camera.params[0] for camera in cameras] == [TRUE_FOCAL] * len(cameras)
    assert max(abs(camera.params[3]) for camera in cameras) < 0.02


@pytest.mark.parametrize("num_images", [2, 3])
def test_tie_points_are_adjusted_also_where_tracks_of_two_images_are_left_out(
    tmp_path: Path, num_images: int
) -> None:
    truth = synthesize(tmp_path / "database.db", num_rigs=4, num_points3D=200)
    place = np.array([0.1, 0.2, 0.1])
    keypoints = {}
    for image_id in sorted(truth.reg_image_ids())[:num_images]:
        image = truth.images[image_id]
        keypoints[image_id] = image.num_points2D()
        image.points2D.append(pycolmap.Point2D(image.project_point(place)))
    tie_points = TiePoints({"p": keypoints})
    tie_points.observe(truth)
    (first, *_) = tie_points.observed(truth)
    truth.points3D[first[2].point3D_id].xyz = place + np.array([0.05, 0.0, 0.0])
    priors = dict.fromkeys(truth.cameras, CameraPrior(TRUE_FOCAL, 0.1))
    adjuster = Adjuster(
        priors, 0.5, pycolmap.BundleAdjustmentOptions(), tie_points=tie_points
    )
    assert adjuster._options(truth, ()).min_track_length == 3
    adjuster.adjust(truth, FINAL)
    residuals = tie_points.residuals(truth)
    assert len(residuals) == num_images
    assert max(residual.error_px for residual in residuals) < 0.01


def test_a_tie_point_of_an_image_that_is_not_adjusted_stays_where_it_is(
    tmp_path: Path,
) -> None:
    truth = synthesize(tmp_path / "database.db", num_rigs=4, num_points3D=200)
    keypoints = {}
    first, second, *_ = sorted(truth.reg_image_ids())
    for image_id in (first, second):
        image = truth.images[image_id]
        keypoints[image_id] = image.num_points2D()
        image.points2D.append(pycolmap.Point2D(image.project_point(np.zeros(3))))
    tie_points = TiePoints({"p": keypoints})
    tie_points.observe(truth)
    (mark, *_) = tie_points.observed(truth)
    moved = np.array([0.05, 0.0, 0.0])
    truth.points3D[mark[2].point3D_id].xyz = moved
    priors = dict.fromkeys(truth.cameras, CameraPrior(TRUE_FOCAL, 0.1))
    adjuster = Adjuster(
        priors, 0.5, pycolmap.BundleAdjustmentOptions(), tie_points=tie_points
    )
    adjuster.adjust(truth, FINAL, [first])
    assert truth.points3D[mark[2].point3D_id].xyz.tolist() == moved.tolist()
