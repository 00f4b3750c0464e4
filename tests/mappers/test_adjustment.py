"""Bundle adjustment with priors on intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers.adjustment import FINAL, Adjuster
from colmap_affrect.mappers.camera_priors import CameraPrior, camera_prior

TRUE_FOCAL = 1280.0
SIZE = (1024, 768)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> pycolmap.Reconstruction:
    """A right model of images with a camera each, whose distortion is 0.05."""
    path: Path = tmp_path_factory.mktemp("scene") / "database.db"
    return synthesize(path, num_rigs=4, num_points3D=150, noise_px=0.5)


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
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", TRUE_FOCAL, *SIZE)
    prior = camera_prior(camera, CameraRecord(("a",), size=SIZE, focal_px=TRUE_FOCAL, **known))
    return prior.cost(factor * prior.focal_px)


def test_lenses_from_wide_to_long_cost_little_and_others_much() -> None:
    for factor in (0.5, 0.7, 1.0, 1.4, 2.0):
        assert cost_of(factor, source="guess") < 4.0
    assert cost_of(5.0, source="guess") > 4.0


def test_a_focal_length_by_exif_may_be_off_by_a_tenth_and_not_by_half() -> None:
    assert cost_of(1.1, source="exif") < 1.0
    assert cost_of(1.5, source="exif") > 4.0
