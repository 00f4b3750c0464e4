"""Matches of keypoints below painted masks leave a database, and their pairs their geometries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mapping_tasks import write_images

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.masked_matches import _free_matches, leave_out_masked


def test_matches_are_free_of_which_no_keypoint_is_masked() -> None:
    """The second keypoint of the first image is masked, and the sixth one of the second image."""
    matches = np.array([[0, 5], [1, 6], [2, 7], [3, 0]])
    free_in_first = np.array([True, False, True, True])
    free_in_second = np.array([True, True, True, True, True, False, True, True])
    found = _free_matches(matches, (1, 2), {1: free_in_first})
    assert found.tolist() == [[0, 5], [2, 7], [3, 0]]
    found = _free_matches(matches, (1, 2), {2: free_in_second})
    assert found.tolist() == [[1, 6], [2, 7], [3, 0]]
    found = _free_matches(matches, (1, 2), {1: free_in_first, 2: free_in_second})
    assert found.tolist() == [[2, 7], [3, 0]]


def test_keypoints_are_masked_by_the_pixel_that_they_are_in(tmp_path: Path) -> None:
    """Pixels from the eleventh column on are masked in one of three images."""
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 40, 30)
    mask = np.ones((30, 40), bool)
    mask[:, 10:] = False
    columns = np.array([3.0, 9.9, 10.1, 30.0], np.float32)
    keypoints = np.stack([columns, np.full(4, 5.0, np.float32)], axis=1)
    rows = np.stack([np.arange(4)] * 2, axis=1).astype(np.uint32)
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = rows
    with open_database(tmp_path / "database.db") as database:
        write_images(database, camera, ["a.jpg", "b.jpg", "c.jpg"])
        for image_id in (1, 2, 3):
            database.write_keypoints(image_id, keypoints)
        for pair in ((1, 2), (1, 3), (2, 3)):
            database.write_matches(*pair, rows)
            database.write_two_view_geometry(*pair, geometry)
        assert leave_out_masked(database, {2: mask}) == [(1, 2), (2, 3)]
        for pair in ((1, 2), (2, 3)):
            assert database.read_matches(*pair).tolist() == [[0, 0], [1, 1]]
            assert not database.exists_two_view_geometry(*pair)
        assert len(database.read_matches(1, 3)) == 4
        assert database.exists_two_view_geometry(1, 3)
