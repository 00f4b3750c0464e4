"""Random correspondences must not become edges of the view graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database, write_keypoints, write_matches
from colmap_affrect.colmap.verification import VerificationOptions, verified_pairs, verify
from colmap_affrect.geometry.affine import rotation

SIZE = (1600, 1200)


@pytest.mark.parametrize("prior", [False, True], ids=["no prior", "prior"])
@pytest.mark.parametrize(
    ("count", "num_pairs"),
    [(200, 1), (1000, 1), pytest.param(1000, 50, marks=pytest.mark.slow)],
)
def test_random_matches_are_rejected(
    tmp_path: Path, count: int, num_pairs: int, prior: bool
) -> None:
    rng, path = np.random.default_rng([count, prior]), tmp_path / "database.db"
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.2 * SIZE[0], *SIZE)
    camera.has_prior_focal_length = prior
    lafs, same = np.zeros((count, 2, 3)), np.stack([np.arange(count)] * 2, axis=1)
    with open_database(path) as database:
        database.write_camera(camera, use_camera_id=True)
        for image_id in range(1, 2 * num_pairs + 1):
            image = pycolmap.Image(name=f"{image_id}.png", image_id=image_id, camera_id=1)
            database.write_image(image, use_image_id=True)
            lafs[:, :, :2] = rotation(rng.uniform(0, 2 * np.pi, count)) * rng.uniform(6, 30, 2)
            lafs[:, :, 2] = rng.uniform(0, np.subtract(SIZE, 1), (count, 2))
            write_keypoints(database, image_id, lafs)
            if image_id % 2 == 0:
                write_matches(database, image_id - 1, image_id, same)
    verify(path, VerificationOptions())
    assert verified_pairs(path, 1) == {}
