"""Prints of one negative show one view; photographs of other things where they are do not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from mapping_tasks import write_images

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import num_long_tracks
from colmap_affrect.geometry.affine import project
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.same_viewpoint import same_viewpoint_pairs, viewpoints

WIDTH = 480
HEIGHT = 320
PRINT = np.array([[0.55, -0.01, 130.0], [0.01, 0.55, 40.0], [0.0, 0.0, 1.0]])
TURNED = np.array([[0.9, 0.05, 10.0], [-0.02, 0.95, 8.0], [5e-4, 0.0, 1.0]])
"""Px of the photograph to those of its print and of another view, the corner of each at (0, 0)."""


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 40, (HEIGHT // 4, WIDTH // 4))
    return np.asarray(
        cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) + 128
    )


def printed(photograph: np.ndarray, homography: np.ndarray = PRINT) -> np.ndarray:
    """A print on white paper, of half the contrast."""
    centres = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    moved = centres @ homography @ np.linalg.inv(centres)
    faded = 0.5 * photograph + 60
    return np.asarray(
        cv2.warpPerspective(faded, moved, (WIDTH, HEIGHT), borderValue=250.0)
    )


def test_prints_of_one_negative_are_one_view(tmp_path: Path) -> None:
    photographs = {
        "a.png": texture(1),
        "b.png": printed(texture(1)),
        "c.png": printed(texture(2)),
    }
    photographs["d.png"] = printed(texture(1), TURNED)
    photographs["e.png"] = printed(0.5 * texture(1) + 0.6 * texture(3))
    for name, content in photographs.items():
        cv2.imwrite(str(tmp_path / name), np.clip(content, 0, 255).astype(np.uint8))
    points = np.random.default_rng(3).uniform(
        (20, 20), (WIDTH - 20, HEIGHT - 20), (60, 2)
    )
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", 500, WIDTH, HEIGHT
    )
    moved = project(PRINT, points)
    moved[:8] += 30.0  # wrong ones
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = np.stack([np.arange(60, dtype=np.uint32)] * 2, axis=1)
    with open_database(tmp_path / "database.db") as database:
        write_images(database, camera, photographs)
        positions = (points, moved, moved, project(TURNED, points), moved)
        for image_id, keypoints in enumerate(positions, 1):
            database.write_keypoints(image_id, keypoints.astype(np.float32))
        # The matches of 2, 3 and 5 are the same; 4 is another view of the plane. Image 5 shows
        # half of what 1 does, as a photograph of the same thing from nearby may.
        for other in (2, 3, 4, 5):
            database.write_two_view_geometry(1, other, geometry)
    graph = PairGraph.read(tmp_path / "database.db")
    assert same_viewpoint_pairs(graph, tmp_path) == {(1, 2)}
    assert same_viewpoint_pairs(graph, None) == frozenset()


def test_points_that_one_view_sees_twice_are_of_two_views() -> None:
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(num_points3D=30)
    )
    images = sorted(model.reg_image_ids())
    for point_id in sorted(model.point3D_ids()):
        model.delete_point3D(point_id)
    track = pycolmap.Track(
        [pycolmap.TrackElement(image_id, 0) for image_id in images[:3]]
    )
    model.add_point3D(np.zeros(3), track)
    assert num_long_tracks(model, {}) == dict.fromkeys(images[:3], 1)
    assert not num_long_tracks(model, {images[2]: images[0]})


def test_photographs_that_share_a_viewpoint_with_a_third_one_have_the_same() -> None:
    assert viewpoints([(1, 3), (2, 3), (5, 9)]) == {1: 1, 2: 1, 3: 1, 5: 5, 9: 5}
    assert viewpoints([]) == {}
