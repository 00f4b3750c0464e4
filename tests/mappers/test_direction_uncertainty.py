"""How uncertain directions between photographs are: as much as noise moves them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from seen_by_all import FAR, NEAR, adjuster, model_of

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers import covariance, direction_uncertainty
from colmap_affrect.mappers.adjustment import FINAL, NOISE_PX
from colmap_affrect.mappers.direction_uncertainty import direction_sigmas_deg


def direction(
    model: pycolmap.Reconstruction, first: int, second: int
) -> NDArray[np.float64]:
    poses = [model.images[i].cam_from_world() for i in (first, second)]
    translation = (poses[1] * poses[0].inverse()).translation
    return translation / np.linalg.norm(translation)


@pytest.mark.parametrize("focal_sigma", [0.0, 0.3])
def test_noise_moves_directions_as_far_as_is_said(focal_sigma: float) -> None:
    adjusting = adjuster(focal_sigma)
    errors_deg = list[float]()
    for seed in range(20):
        model = model_of(NEAR, 0.3, seed)
        adjusting.adjust(model, FINAL)
        cosine = direction(model, 1, 2) @ direction(model_of(NEAR), 1, 2)
        errors_deg.append(np.degrees(np.arccos(min(1.0, cosine))))
    found = float(np.sqrt(np.mean(np.square(errors_deg))))
    said = direction_sigmas_deg(model_of(NEAR), adjusting)
    expected = said[1] * 0.3 / NOISE_PX
    assert 0.6 < found / expected < 1.6


def test_photographs_at_one_place_are_uncertain_and_others_are_not() -> None:
    near = direction_sigmas_deg(model_of(NEAR), adjuster(0.3))
    far = direction_sigmas_deg(model_of(FAR), adjuster(0.3))
    assert min(near[i] for i in (1, 2, 3)) > 5.0
    assert max(far.values()) < 1.0
    # Its directions to two of the three are as certain as those between far ones.
    assert near[4] < 1.0


def test_images_that_were_taken_out_are_passed_over() -> None:
    model = model_of(NEAR)
    before = direction_sigmas_deg(model, adjuster(0.3))
    model.deregister_frame(model.images[4].frame_id)
    found = direction_sigmas_deg(model, adjuster(0.3))
    assert list(found) == [1, 2, 3]
    assert found[1] > before[1]  # no far image holds the near ones
    assert model.num_frames() == 4


def test_images_whose_distance_tracks_do_not_tell_are_left_out() -> None:
    model = model_of(FAR)
    for index in range(model.num_points3D()):
        # Image 4 keeps points that only image 1 sees beside it.
        leaving = (2, 3) if index % 2 else (4,)
        for image_id in leaving:
            model.delete_observation(image_id, index)
    found = direction_sigmas_deg(model, adjuster(0.3))
    assert list(found) == [1, 2, 3]


def test_known_focal_lengths_make_directions_surer() -> None:
    known = direction_sigmas_deg(model_of(NEAR), adjuster(0.0))
    unknown = direction_sigmas_deg(model_of(NEAR), adjuster(0.3))
    assert known[1] < 0.7 * unknown[1]


def test_it_does_not_depend_on_the_frame_of_the_model() -> None:
    model = model_of(NEAR)
    before = direction_sigmas_deg(model, adjuster(0.3))
    turn = pycolmap.Rotation3d(np.array([0.5, -0.4, 0.9]))
    model.transform(pycolmap.Sim3d(3.0, turn, np.array([30.0, -20.0, 50.0])))
    assert direction_sigmas_deg(model, adjuster(0.3)) == pytest.approx(before, rel=1e-3)


def test_two_images_and_very_many_are_not_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert not direction_sigmas_deg(model_of(FAR[:2]), adjuster(0.3))
    monkeypatch.setattr(direction_uncertainty, "MAX_COVARIANCE_IMAGES", 3)
    assert not direction_sigmas_deg(model_of(FAR), adjuster(0.3))


def test_it_does_not_depend_on_the_points_that_fix_the_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = model_of(NEAR)
    before = direction_sigmas_deg(model, adjuster(0.3))
    monkeypatch.setattr(covariance, "NUM_FRAME_POINTS", 3)
    assert direction_sigmas_deg(model, adjuster(0.3)) == pytest.approx(before, rel=1e-3)


def test_of_points_on_a_line_nothing_is_said() -> None:
    model = model_of(FAR)
    for index, point_id in enumerate(sorted(model.point3D_ids())):
        model.points3D[point_id].xyz = np.array([0.0, 0.1 * index, 12.0])
    assert not direction_sigmas_deg(model, adjuster(0.3))
