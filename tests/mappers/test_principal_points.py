"""Models of prints whose optical axes are not in the middle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import WHOLE, mapper_of, searches_with_axes, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.camera_priors import (
    camera_prior,
    is_off_center,
    shifted_principal_point,
)
from colmap_affrect.mappers.hypotheses import SHIFTED_AXES
from colmap_affrect.mappers.principal_points import (
    freed_principal_point_cost,
)

pytestmark = pytest.mark.long

NUM_IMAGES = 6
NOISE_PX = 0.4
TRUE_FOCAL_PX = 900.0
SIZE = (1024, 768)
# Of the axes from the middle, px: right and down, each print in its own way
OFFSETS_PX = np.array(
    [[150, -40], [-90, 120], [30, 160], [-160, -60], [110, 80], [-20, -150]], float
)
PARAMS = [TRUE_FOCAL_PX, 512.0, 384.0, 0.0]
UNKNOWN = CameraRecord(("a",), "guess", 1200.0, size=SIZE)


def write_prints(path: Path, share: float) -> pycolmap.Reconstruction:
    """Write verified pairs of prints that are off centre by a share of the offsets.

    Returns:
        The truth, with principal points in the middle.
    """
    truth = synthesize(
        path,
        num_rigs=NUM_IMAGES,
        num_points3D=400,
        noise_px=NOISE_PX,
        camera_params=PARAMS,
    )
    with open_database(path) as database:
        for image in database.read_all_images():
            keypoints = database.read_keypoints(image.image_id)
            keypoints[:, :2] += share * OFFSETS_PX[image.image_id - 1]
            database.update_keypoints(image.image_id, keypoints)
    return truth


def mapped(path: Path, records: Mapping[int, CameraRecord]) -> MappedModel:
    task = MappingTask(path, None, cameras=records)
    found = mapper_of("sparse").map(task, path.parent, 0, lambda _: None)
    return found[0]


def rotation_errors_deg(
    model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction
) -> list[float]:
    """Return by how much the rotations between images are off."""
    found = []
    ids = sorted(model.reg_image_ids())
    for first in ids:
        for second in ids:
            if first < second:
                by_model = relative_rotation(model, first, second)
                by_truth = relative_rotation(truth, first, second)
                angle = (by_model * by_truth.inverse()).angle()
                found.append(np.degrees(angle))
    return found


def relative_rotation(
    model: pycolmap.Reconstruction, first: int, second: int
) -> pycolmap.Rotation3d:
    from_world = model.images[first].cam_from_world().rotation
    return model.images[second].cam_from_world().rotation * from_world.inverse()


def center_of(camera: pycolmap.Camera) -> Array:
    return np.array([camera.principal_point_x, camera.principal_point_y])


def records_of(
    truth: pycolmap.Reconstruction, record: CameraRecord
) -> dict[int, CameraRecord]:
    return dict.fromkeys(truth.cameras, record)


@pytest.mark.long
def test_axes_off_the_middle_are_found_and_better_rotations_with_them(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    truth = write_prints(path, 1.0)
    constant_record = replace(UNKNOWN, given=("principal-point",))
    constant = mapped(path, records_of(truth, constant_record))
    free = mapped(path, records_of(truth, UNKNOWN))
    assert SHIFTED_AXES in free.hypotheses
    assert free.reconstruction.num_reg_images() == NUM_IMAGES
    constant_errors_deg = rotation_errors_deg(constant.reconstruction, truth)
    free_errors_deg = rotation_errors_deg(free.reconstruction, truth)
    assert max(free_errors_deg) < 0.6 * max(constant_errors_deg)
    for image in free.reconstruction.images.values():
        true_center = np.array(SIZE) / 2.0 + OFFSETS_PX[image.image_id - 1]
        assert np.abs(center_of(image.camera) - true_center).max() < 80.0


@pytest.mark.parametrize(
    ("share", "is_off"),
    [
        (1.0, True),
        (0.0, False),
    ],
)
def test_prints_of_one_size_that_were_cut_in_different_places_share_no_camera(
    tmp_path: Path, share: float, *, is_off: bool
) -> None:
    path = tmp_path / "database.db"
    truth = write_prints(path, share)
    records = {}
    for key in truth.cameras:
        records[key] = replace(UNKNOWN, names=(f"{key}.jpg",))
    task = MappingTask(path, None, cameras=records, may_share=True)
    model = mapper_of("sparse").map(task, path.parent, 0, lambda _: None)[0]
    images = model.reconstruction.images.values()
    num_cameras = len({image.camera_id for image in images})
    assert (SHIFTED_AXES in model.hypotheses) == is_off
    assert not is_off or num_cameras == NUM_IMAGES
    for image in images:
        offset_px = center_of(image.camera) - np.array(SIZE) / 2.0
        expected_px = share * OFFSETS_PX[image.image_id - 1]
        assert np.abs(offset_px - expected_px).max() < 80.0


def test_rotations_are_unclear_where_free_axes_make_no_better_model(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    truth = write_prints(path, 0.5)
    model = mapped(path, records_of(truth, UNKNOWN))
    assert SHIFTED_AXES not in model.hypotheses
    turns_deg = model.axis_turns_deg
    assert len(turns_deg) == NUM_IMAGES
    assert 2.0 < min(turns_deg.values()) < max(turns_deg.values()) < 20.0


@pytest.mark.parametrize(
    ("share", "record"),
    [
        (0.0, UNKNOWN),
        (0.05, UNKNOWN),
        (0.5, replace(UNKNOWN, given=("principal-point",))),
    ],
)
def test_axes_stay_where_they_are_in_the_middle_or_given(
    tmp_path: Path, share: float, record: CameraRecord
) -> None:
    path = tmp_path / "database.db"
    truth = write_prints(path, share)
    model = mapped(path, records_of(truth, record))
    assert SHIFTED_AXES not in model.hypotheses
    assert max(model.axis_turns_deg.values(), default=0.0) < 4.0
    for camera in model.reconstruction.cameras.values():
        assert not is_off_center(camera)


@pytest.mark.long
def test_a_model_with_free_axes_is_gone_on_with_as_such(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = write_prints(path, 1.0)
    records = records_of(truth, UNKNOWN)
    first = mapped(path, records)
    task = MappingTask(path, None, previous_models=[first], cameras=records)
    (again,) = mapper_of("sparse").map(task, tmp_path, 0, lambda _: None)
    assert SHIFTED_AXES in again.hypotheses
    before_deg = rotation_errors_deg(first.reconstruction, truth)
    after_deg = rotation_errors_deg(again.reconstruction, truth)
    assert after_deg == pytest.approx(before_deg, abs=0.5)


def test_an_axis_that_mapping_moved_has_the_prior_of_a_print() -> None:
    params = [1200.0, 512.0, 384.0, 0.0]
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=1024, height=768, params=params
    )
    assert camera_prior(camera, UNKNOWN).principal_point is None
    camera.principal_point_y += 40.0
    prior = camera_prior(camera, UNKNOWN).principal_point
    assert prior == shifted_principal_point(camera)
    assert prior.center_px == (512.0, 384.0)
    assert prior.sigmas_px == pytest.approx((0.15 * 1024, 0.15 * 1024))
    given = replace(UNKNOWN, given=("principal-point",))
    assert camera_prior(camera, given).principal_point is None
    assert camera_prior(camera, WHOLE).principal_point is None


def test_only_principal_points_that_were_freed_are_paid_for(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=3, num_points3D=60, camera_params=PARAMS)
    constant, free = searches_with_axes(path, records_of(truth, UNKNOWN))
    first, second, third = sorted(truth.cameras)
    crop = shifted_principal_point(truth.cameras[first])
    priors = dict(constant.adjuster.priors)
    priors[first] = replace(priors[first], principal_point=crop)
    adjuster = replace(constant.adjuster, priors=priors)
    knows_a_crop = replace(constant, adjuster=adjuster)
    sigma_px = 0.15 * 1024
    truth.cameras[first].principal_point_x += 2.0 * sigma_px
    assert freed_principal_point_cost(truth, knows_a_crop, free) == 0.0
    truth.cameras[second].principal_point_x += 2.0 * sigma_px
    truth.cameras[third].principal_point_y -= sigma_px
    paid = freed_principal_point_cost(truth, knows_a_crop, free)
    assert paid == pytest.approx(2.0 + 0.5)
