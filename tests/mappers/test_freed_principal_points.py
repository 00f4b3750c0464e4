"""Where view cameras have their axes, and how far rotations change with free ones."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tasks import searches_with_axes, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers import principal_points
from colmap_affrect.mappers.camera_priors import (
    CameraPrior,
    shifted_principal_point,
    usual_principal_point,
)
from colmap_affrect.mappers.principal_points import (
    FreedomGains,
    _only_up_and_down,
    gains_of_freedom,
    median_turns_deg,
)
from colmap_affrect.mappers.search import Search

PARAMS = [900.0, 512.0, 384.0, 0.0]
UNKNOWN = CameraRecord(("a",), "guess", 1200.0, size=(1024, 768))
# Of axes from the middle, px: right and down
OFFSETS_PX = np.array([[150, -40], [-90, 120], [30, 160], [-160, -60]], float)


def test_view_cameras_shift_up_and_down_as_prints_and_are_in_the_middle_across(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    free = CameraPrior(900.0, 0.3, shifted_principal_point(camera))
    search: Any = SimpleNamespace(
        adjuster=SimpleNamespace(priors={1: free}),
        graph=SimpleNamespace(cameras={7: camera}),
    )
    monkeypatch.setattr(principal_points, "_with_priors", lambda _, priors: priors)
    priors: Any = _only_up_and_down(search, {1})
    point = priors[1].principal_point
    assert point.center_px == (500.0, 350.0)
    across_px, down_px = point.sigmas_px
    assert across_px == usual_principal_point(camera).sigmas_px[0]
    assert down_px == shifted_principal_point(camera).sigmas_px[1]
    assert across_px < down_px
    assert _only_up_and_down(search, set()) == {1: free}


def model_of(turns: dict[int, pycolmap.Rotation3d]) -> pycolmap.Reconstruction:
    """Return a model of images with rotations."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    model.add_camera_with_trivial_rig(camera)
    for image_id, turn in turns.items():
        image = pycolmap.Image(f"{image_id}.jpg", np.zeros((0, 2)), 1, image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, np.ones(3)))
    return model


def test_an_image_turns_as_the_median_of_its_rotations_to_the_others_does() -> None:
    """The frame of the changed model is another one, and one of four images has turned."""
    turns = {}
    for image_id in range(1, 5):
        axis = np.array([0.3, -0.2, 0.1]) * image_id + np.array([0.0, 0.5, -0.4])
        turns[image_id] = pycolmap.Rotation3d(axis)
    frame = pycolmap.Rotation3d(np.array([0.7, 0.2, -0.9]))
    changed = {image_id: turn * frame for image_id, turn in turns.items()}
    ten_deg = pycolmap.Rotation3d(np.deg2rad([0.0, 6.0, 8.0]))
    changed[4] = ten_deg * changed[4]
    found = median_turns_deg(model_of(turns), model_of(changed))
    expected = {"1.jpg": 0.0, "2.jpg": 0.0, "3.jpg": 0.0, "4.jpg": 10.0}
    assert found == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("share", "contradict"), [(0.15, False), (1.0, True)])
def test_axes_of_whole_photographs_are_not_just_in_the_middle(
    tmp_path: Path, share: float, *, contradict: bool
) -> None:
    """Off by up to two per cent they move points by many deviations, and are usual."""
    path = tmp_path / "database.db"
    truth = synthesize(
        path,
        num_rigs=len(OFFSETS_PX),
        num_points3D=200,
        noise_px=0.4,
        camera_params=PARAMS,
    )
    for image in truth.images.values():
        for point in image.points2D:
            point.xy = point.xy + share * OFFSETS_PX[image.image_id - 1]
    records = dict.fromkeys(truth.cameras, UNKNOWN)
    constant, free = searches_with_axes(path, records)
    gains = gains_of_freedom(truth, constant, free)
    assert gains.num_freed == len(OFFSETS_PX)
    assert gains.contradict_constant == contradict


@pytest.mark.parametrize(
    ("crop_nats", "shift_nats", "contradict", "leave_open"),
    [
        (1.9, 0.9, False, False),
        (2.1, 0.9, False, True),  # crops move both ways
        (0.0, 1.1, False, True),
        (7.9, 3.9, False, True),
        (8.1, 3.9, True, True),
        (0.0, 4.1, True, True),  # that is enough for a shift up or down
    ],
)
def test_points_must_say_more_for_crops_than_for_shifts_up_or_down(
    crop_nats: float, shift_nats: float, *, contradict: bool, leave_open: bool
) -> None:
    """Of three principal points and observations whose logarithm is eight."""
    gains = FreedomGains(
        by_shifts=3 * shift_nats,
        by_crops=3 * crop_nats,
        num_freed=3,
        num_observations=round(math.exp(8.0)),
    )
    assert gains.contradict_constant == contradict
    assert gains.leave_constant_open == leave_open


@pytest.mark.parametrize(
    ("gain", "by_shifts"),
    [
        (30.0, 20.0),
        (3.1, 20.0),
        (2.9, 2.9),  # a nat for each camera: shifts are not tried
    ],
)
def test_gains_are_those_of_crops_and_of_shifts_up_and_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float, by_shifts: float
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=3, num_points3D=60, camera_params=PARAMS)
    constant, free = searches_with_axes(path, dict.fromkeys(truth.cameras, UNKNOWN))

    costs_of_starts = {  # by the deviations across and down, in longer sides
        (0.02, 0.02): (2000.0, 1000.0),
        (0.02, 0.15): (2000.0, 980.0),
        (0.15, 0.15): (1000.0 - gain, 2000.0),
    }

    def costs(search: Search, _: pycolmap.Reconstruction) -> tuple[float, float]:
        axis = search.adjuster.priors[1].principal_point
        assert axis is not None
        across_px, down_px = axis.sigmas_px
        return costs_of_starts[round(across_px / 1024, 2), round(down_px / 1024, 2)]

    monkeypatch.setattr(Search, "costs_of_starts", costs)
    gains = gains_of_freedom(truth, constant, free)
    assert (gains.by_shifts, gains.by_crops) == pytest.approx((by_shifts, gain))
    assert gains.num_freed == 3
    assert gains.num_observations == truth.compute_num_observations()
    assert gains_of_freedom(truth, free, free).num_freed == 0
