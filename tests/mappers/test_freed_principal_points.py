"""When the cost says that principal points are not in the middle, and how far rotations change."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers import principal_points
from colmap_affrect.mappers.camera_priors import (
    CameraPrior,
    shifted_principal_point,
    usual_principal_point,
)
from colmap_affrect.mappers.principal_points import (
    _only_up_and_down,
    contradict_constant,
    median_turns_deg,
)

NUM_OBSERVATIONS = 1000  # half of whose logarithm is 3.45


def search_of(cost: float) -> Any:
    """Return a search whose models have a cost, as they are and from a straight lens."""
    return SimpleNamespace(costs_of_starts=lambda _: (cost + 50.0, cost))


@pytest.mark.parametrize(
    ("gain_of_crops", "gain_of_shifts", "is_contradicted"),
    [
        (15.0, 0.0, True),  # two of each of two cameras are worth 13.8
        (12.0, 5.0, False),
        (12.0, 8.0, True),  # one of each is worth 6.9
        (5.0, 5.0, False),
    ],
)
def test_free_principal_points_must_be_worth_two_parameters_or_one_that_shifts(
    gain_of_crops: float,
    gain_of_shifts: float,
    *,
    is_contradicted: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fewer = SimpleNamespace(compute_num_observations=lambda: NUM_OBSERVATIONS)
    monkeypatch.setattr(principal_points, "with_fewer_points", lambda _: fewer)
    monkeypatch.setattr(principal_points, "_freed", lambda *_: {1: None, 2: None})
    shifted = search_of(100.0 - gain_of_shifts)
    monkeypatch.setattr(principal_points, "_only_up_and_down", lambda *_: shifted)
    nothing: Any = None
    found = contradict_constant(
        nothing, search_of(100.0), search_of(100.0 - gain_of_crops)
    )
    assert found == is_contradicted


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
