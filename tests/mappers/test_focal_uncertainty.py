"""How uncertain focal lengths are: as much as noise and priors move them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import synthesize
from seen_by_all import FAR, FOCAL_PX, adjuster, model_of

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers import focal_observability
from colmap_affrect.mappers.adjustment import FINAL, NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.camera_priors import USUAL_SIGMA, CameraPrior
from colmap_affrect.mappers.focal_observability import (
    MIN_GROWTH,
    FreedFocals,
    _growths,
    focal_growths,
    freed_focals,
)
from colmap_affrect.mappers.focal_uncertainty import focal_sigmas

IDS = (1, 2, 3, 4)
CONVERGING_DEG = (0.0, 18.0, -14.0, 5.0)  # all cameras look at the middle of the points


def task_of(model: pycolmap.Reconstruction) -> MappingTask:
    """What is known of the cameras of a model: nothing."""
    records = {}
    for key in model.cameras:
        records[key] = CameraRecord((f"{key}.jpg",), "guess", FOCAL_PX)
    return MappingTask(Path("none.db"), None, cameras=records)


def test_focal_lengths_of_cameras_that_do_not_turn_slide_together() -> None:
    """Depths grow with the focal lengths: only the four priors hold these, all in one."""
    found = focal_sigmas(model_of(FAR), adjuster(0.3), IDS)
    assert found is not None
    assert found == pytest.approx(dict.fromkeys(IDS, 0.15), rel=0.03)


def test_cameras_that_turn_tell_their_focal_lengths() -> None:
    model = model_of(FAR, turns_deg=CONVERGING_DEG)
    found = focal_sigmas(model, adjuster(0.3), IDS)
    assert found is not None
    assert max(found.values()) < 0.01


def test_noise_moves_focal_lengths_as_far_as_is_said() -> None:
    adjusting = adjuster(0.3)
    errors = []
    for seed in range(20):
        model = model_of(FAR, 0.3, seed, CONVERGING_DEG)
        adjusting.adjust(model, FINAL)
        focals_px = [model.cameras[key].mean_focal_length() for key in IDS]
        errors.append(np.log(np.array(focals_px) / FOCAL_PX))
    said = focal_sigmas(model_of(FAR, turns_deg=CONVERGING_DEG), adjusting, IDS)
    assert said is not None
    expected = np.array(list(said.values())) * 0.3 / NOISE_PX
    found = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (np.abs(np.log(found / expected)) < np.log(1.7)).all()


def test_two_focal_lengths_of_a_camera_count_as_their_mean() -> None:
    model = model_of(FAR, turns_deg=CONVERGING_DEG)
    before = focal_sigmas(model, adjuster(0.3), IDS)
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [FOCAL_PX, FOCAL_PX, 800.0, 600.0, 0.0, 0.0, 0.0, 0.0]
    found = focal_sigmas(model, adjuster(0.3), IDS)
    assert before is not None
    assert found is not None
    assert 0.5 < found[1] / before[1] < 2.0


def test_rigs_have_no_covariance(tmp_path: Path) -> None:
    rig = synthesize(
        tmp_path / "rig.db", num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=4,
        num_points3D=100,
    )  # fmt: skip
    keys = sorted(rig.cameras)
    priors = {key: CameraPrior(1280.0, 0.3) for key in keys}
    adjusting = Adjuster(priors, NOISE_PX, pycolmap.BundleAdjustmentOptions())
    assert focal_sigmas(rig, adjusting, keys) is None


def test_growths_tell_cameras_that_turn_from_those_that_do_not() -> None:
    sliding = model_of(FAR, 0.3)
    told = model_of(FAR, 0.3, turns_deg=CONVERGING_DEG)
    assert max(focal_growths(sliding, task_of(sliding)).values()) < 10.0 * MIN_GROWTH
    assert min(focal_growths(told, task_of(told)).values()) == 1.0


def test_growths_are_those_of_the_covariance() -> None:
    """Of focal lengths that only priors hold: by hand, 0.5 (ln 1.25 / sigma)^2 / cost / 2.5."""
    model = model_of(FAR, 1.0)
    found = focal_growths(model, task_of(model))
    priors = {key: CameraPrior(FOCAL_PX, USUAL_SIGMA) for key in IDS}
    adjusting = Adjuster(priors, NOISE_PX, pycolmap.BundleAdjustmentOptions())
    cost = adjusting.adjust(model, FINAL)
    sigma = USUAL_SIGMA / 2.0  # four priors of one number
    expected = 0.5 * (np.log(1.25) / sigma) ** 2 / cost / 2.5
    assert found == pytest.approx(dict.fromkeys(IDS, expected), rel=0.2)


def test_where_there_is_no_covariance_other_focal_lengths_are_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = model_of(FAR, 0.5, turns_deg=(0.0, 2.0, -1.5, 0.5))
    by_covariance = focal_growths(model, task_of(model))
    monkeypatch.setattr(focal_observability, "focal_sigmas", lambda *_: None)
    by_trials = focal_growths(model, task_of(model))
    assert by_trials.keys() == by_covariance.keys()
    for key, growth in by_trials.items():
        assert 0.2 < by_covariance[key] / growth < 5.0


def freed_by(factor: float) -> FreedFocals:
    """Free focal lengths that were given so many times too long."""
    model = model_of(FAR, 0.7, turns_deg=(0.0, 3.0, -2.0, 1.0))
    records = {}
    for key in IDS:
        focal_px = factor * FOCAL_PX
        model.cameras[key].params = [focal_px, 800.0, 600.0, 0.0]
        given = ("focal", "distortion")
        records[key] = CameraRecord((f"{key}.jpg",), "given", focal_px, given=given)
    priors = {key: CameraPrior(factor * FOCAL_PX, 0.0) for key in IDS}
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=False)
    Adjuster(priors, NOISE_PX, refining).adjust(model, FINAL)
    task = MappingTask(Path("none.db"), None, cameras=records)
    return freed_focals(model, task, priors)


@pytest.mark.parametrize("factor", [0.8, 1.3])
def test_given_focal_lengths_that_are_wrong_by_one_factor_are_told_as_one(
    factor: float,
) -> None:
    """Each alone may be right by the points: that all change together is one parameter."""
    found = freed_by(factor)
    expected = dict.fromkeys(IDS, FOCAL_PX)
    assert found.fitting_px == pytest.approx(expected, rel=0.05)
    assert found.other.log_odds > 0.5
    assert min(found.other.turns_deg.values()) > 0.3


def test_given_focal_lengths_that_are_right_are_as_likely_as_before_and_turn_nothing() -> (
    None
):
    found = freed_by(1.0)
    assert not found.fitting_px
    assert found.other.log_odds == pytest.approx(np.log(1.0 / 9.0), abs=0.3)
    turns_deg = found.other.turns_deg
    assert turns_deg == pytest.approx(dict.fromkeys(turns_deg, 0.0), abs=0.3)
    assert len(turns_deg) == len(IDS)


class FakeTrials:
    """Growths that are known beforehand."""

    def __init__(self, by_covariance: dict[int, float], by_trial: float) -> None:
        self.by_covariance = by_covariance
        self.by_trial = by_trial

    def growths_by_covariance(self, _: list[int]) -> dict[int, float]:
        return dict(self.by_covariance)

    def growth(self, _: list[int]) -> float:
        return self.by_trial


@pytest.mark.parametrize(
    ("by_covariance", "by_trial", "expected"),
    [
        ({1: 0.016}, -0.026, {1: -0.026}),  # the cost falls again far from here
        ({1: 0.016}, 0.4, {1: 0.016}),
        ({1: 1.0}, -0.026, {1: 1.0}),  # sure of it: nothing is tried
        ({1: 0.016, 2: 0.5}, -0.026, {1: 0.016, 2: 0.5}),
    ],
)
def test_another_focal_length_is_tried_of_one_camera_that_is_not_sure_of_it(
    by_covariance: dict[int, float], by_trial: float, expected: dict[int, float]
) -> None:
    trials: Any = FakeTrials(by_covariance, by_trial)
    assert _growths(trials, sorted(by_covariance)) == expected
