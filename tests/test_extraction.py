"""From a file to the database: where features end up, at several sizes of processing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_affrect import stages
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.extraction import prepare
from colmap_affrect.options import CameraOptions
from colmap_affrect.recipes import load_recipe
from colmap_affrect.workspace import Workspace

WIDTH, HEIGHT = 480, 360
GRID = np.stack(np.meshgrid(np.arange(30, WIDTH - 20, 45), np.arange(30, HEIGHT - 20, 45)), -1)
BLOBS = GRID.reshape(-1, 2) + np.random.default_rng(5).uniform(-2, 2, (GRID.size // 2, 2))
BLOB_SIGMA_PX = 5.2
MAX_BIAS_PX = 0.06
"""Half a pixel too much or too little at any step would be a bias of 0.17 px or more."""
MAX_ERROR_PX = 0.3


def write_blobs(path: Path) -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = np.full((HEIGHT, WIDTH), 100.0)
    for center_x, center_y in BLOBS:
        squared = (x - center_x) ** 2 + (y - center_y) ** 2
        image += 120.0 * np.exp(-squared / (2 * BLOB_SIGMA_PX**2))
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.clip(np.rint(image), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("max_size", [WIDTH, 360, 240])
def test_blob_is_half_a_pixel_further_in_the_database_at_every_size(tmp_path, max_size):
    write_blobs(tmp_path / "photos" / "blobs.png")
    workspace = Workspace(tmp_path / "out")
    recipe = load_recipe("default", [f"max_image_size_px={max_size}"])
    with workspace.locked():
        stages.extract(workspace, tmp_path / "photos", recipe, CameraOptions())
    with open_database(workspace.database) as database:
        keypoints = database.read_keypoints(image_ids(workspace.database)["blobs.png"])
    assert keypoints.shape[1] == 6
    centers = keypoints[:, None, :2] - (BLOBS + 0.5)[None]
    nearest = np.linalg.norm(centers, axis=2).argmin(axis=0)
    offsets = keypoints[nearest, :2] - (BLOBS + 0.5)
    found = np.linalg.norm(offsets, axis=1) < 2.0
    assert found.mean() > 0.5  # DoG misses round blobs of some sizes
    assert np.abs(offsets[found]).max() < MAX_ERROR_PX
    assert np.abs(offsets[found].mean(axis=0)).max() < MAX_BIAS_PX


def test_features_of_a_shrunk_image_lie_within_the_stored_one(tmp_path):
    path = tmp_path / "noise.png"
    noise = np.random.default_rng(3).integers(0, 255, (301, 457), dtype=np.uint8)
    cv2.imwrite(str(path), cv2.GaussianBlur(noise, (0, 0), 2.0))
    recipe = load_recipe("default", ["max_image_size_px=200"])
    extracted = prepare(recipe.extraction).extract_file(path)
    features, size = extracted.features, extracted.image_size
    assert size == (457, 301)
    assert len(features) > 20
    assert features.keypoints[:, 0].max() > 380
    assert features.inside(size).all()
