"""Single pairs are verified in the order in which they are asked for; print leaves all the rest."""

from __future__ import annotations

import numpy as np
from strategies import Array

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_verification import PairVerifier, _each_once
from colmap_affrect.colmap.verification import (
    Side,
    VerificationOptions,
    estimate_geometry,
)
from colmap_affrect.geometry.affine import lafs_from_keypoints, transform_lafs
from colmap_affrect.geometry.arrays import rows_in

SIZE = (640, 480)
WALL = np.array([[0.5, -0.6, 250.0], [0.8, 0.45, -90.0], [3e-4, -2e-4, 1.0]])
NUM = 40


def camera(camera_id: int) -> pycolmap.Camera:
    found = pycolmap.Camera.create_from_model_name(camera_id, "PINHOLE", 700.0, *SIZE)
    found.has_prior_focal_length = True
    return found


def frames_of_a_wall() -> Array:
    """(N, 2, 3) frames, turned and large as chance wants."""
    random = np.random.default_rng(1)
    points = random.uniform((60, 50), (580, 430), (NUM, 2))
    return lafs_from_keypoints(
        points, random.uniform(5.0, 40.0, NUM), random.uniform(-3.0, 3.0, NUM)
    )


def test_inliers_are_in_the_order_of_the_names_whichever_id_is_lower() -> None:
    """The features of both images are numbered in different orders."""
    first = frames_of_a_wall()
    order = np.random.default_rng(7).permutation(NUM)
    second = transform_lafs(WALL, first)[order]
    matches = np.stack([order, np.arange(NUM)], axis=1)
    cameras = {"a.jpg": camera(1), "b.jpg": camera(2)}
    for ids in ({"a.jpg": 1, "b.jpg": 2}, {"a.jpg": 2, "b.jpg": 1}):
        verifier = PairVerifier(ids, cameras, VerificationOptions())
        found = verifier.inliers(("a.jpg", "b.jpg"), (first, second), matches)
        assert len(found) == NUM
        assert rows_in(found, matches).all()


def seen_by_two_cameras(points: Array) -> tuple[Array, Array]:
    """(N, 2) px of (N, 3) points in the first image, and in one from beside it."""
    motion = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.05, -0.15, 0.1])), np.array([1.5, 0.3, 0.2])
    )
    there = np.array([motion * point for point in points])
    return camera(1).img_from_cam(points), camera(2).img_from_cam(there)


def test_where_print_made_the_geometry_all_other_matches_are_tried() -> None:
    """Most matches are of a caption: what explains it explains a part of the scene at most."""
    random = np.random.default_rng(5)
    scene = seen_by_two_cameras(
        random.uniform((-2.0, -1.5, 6.0), (2.0, 1.0, 12.0), (NUM, 3))
    )
    caption = random.uniform((200.0, 440.0), (350.0, 446.0), (100, 2))
    first = np.concatenate([scene[0], caption])
    second = np.concatenate([scene[1], 1.05 * caption + (60.0, -390.0)])
    rows = np.arange(len(first))
    geometry = estimate_geometry(
        (
            Side(camera(1), first.astype(np.float32)),
            Side(camera(2), second.astype(np.float32)),
        ),
        np.stack([rows, rows], axis=1),
        VerificationOptions(),
    )
    inliers = np.asarray(geometry.inlier_matches, np.int64)[:, 0]
    assert set(range(NUM)) <= set(inliers.tolist())
    assert len(inliers) <= NUM + 4


def test_repeated_matches_are_evidence_once_in_their_order() -> None:
    matches = np.array([[7, 1], [2, 3], [7, 1], [2, 5], [2, 3]])
    assert _each_once(matches).tolist() == [[7, 1], [2, 3], [2, 5]]
    assert _each_once(matches[:2]).tolist() == [[7, 1], [2, 3]]
