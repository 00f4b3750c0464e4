"""Images whose tie points say that they are in a wrong place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.tie_points import TiePoints

NUM_POINTS = 12


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    """A right model of three images."""
    return synthesize(tmp_path / "database.db", num_rigs=3, num_points3D=80)


def tie_points_of(model: pycolmap.Reconstruction, number: int) -> TiePoints:
    """Return tie points that are marked in all three images, and one in two."""
    keypoints = dict[str, dict[int, int]]()
    for point_id, point in sorted(model.points3D.items()):
        seen = {mark.image_id: mark.point2D_idx for mark in point.track.elements}
        if len(seen) == 3 and len(keypoints) < number:
            keypoints[f"p{point_id}"] = seen
    first = dict(list(keypoints["p1"].items())[:2])
    return TiePoints({**keypoints, "in two": first})


def turn_last(model: pycolmap.Reconstruction) -> int:
    """Turn the last image by 11 degrees; return its id."""
    image_id = int(max(model.reg_image_ids()))
    image = model.images[image_id]
    turn = pycolmap.Rotation3d(np.array([0.0, 0.2, 0.0]))
    wrong = pycolmap.Rigid3d(turn, np.zeros(3)) * image.cam_from_world()
    image.frame.set_cam_from_world(image.camera_id, wrong)
    return image_id


def test_the_image_is_misplaced_that_marks_in_two_others_contradict(
    model: pycolmap.Reconstruction,
) -> None:
    tie_points = tie_points_of(model, NUM_POINTS)
    assert tie_points.misplaced(model) == []
    turned = turn_last(model)
    assert tie_points.misplaced(model) == [turned]


def test_three_tie_points_contradict_no_image(model: pycolmap.Reconstruction) -> None:
    tie_points = tie_points_of(model, 3)
    turn_last(model)
    assert tie_points.misplaced(model) == []


@pytest.mark.parametrize(("num_wrong", "is_misplaced"), [(5, False), (7, True)])
def test_half_of_the_marks_of_an_image_must_be_wrong(
    model: pycolmap.Reconstruction, num_wrong: int, *, is_misplaced: bool
) -> None:
    tie_points = tie_points_of(model, NUM_POINTS)
    last = int(max(model.reg_image_ids()))
    for keypoints in list(tie_points.keypoints.values())[:num_wrong]:
        model.images[last].points2D[keypoints[last]].xy += [0.0, 90.0]
    assert (last in tie_points.misplaced(model)) == is_misplaced
