"""Whether something moves as one between photographs, against the rest of what they show."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import mapper_of, task_with_given_cameras, write_images
from numpy.typing import NDArray
from wall_scene import (
    is_inside,
    posed_model,
    project,
    views,
    wall,
    wall_camera,
)

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.other_motions import share_of_motion
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.project.report import DOUBTFUL, SURE, ModelSummary

NUM_POINTS = 1200
NUM_IMAGES = 4
SHIFT = 0.25  # of what moves, from image to image, in the units of the wall
Points = NDArray[np.float64]
Bools = NDArray[np.bool_]


def moving_part(points: Points, left_of: float) -> Bools:
    return np.asarray(points[:, 0] < left_of)


def scene(
    path: Path, left_of: float, *, repeats: bool = False
) -> pycolmap.Reconstruction:
    """Write a database of images before a wall, a part of which moves down from image to image.

    Args:
        path: Of the database.
        left_of: The part of the wall that moves, in units of the wall.
        repeats: Whether matches of this part are of other features in each pair, as those of
            equal windows are.

    Returns:
        The model of the part that stays, with the true poses.
    """
    random = np.random.default_rng(2)
    points = wall(random, NUM_POINTS)
    moves = moving_part(points, left_of)
    poses = views(NUM_IMAGES)
    pixels = {}
    orders = {}  # of the points, as each image has its keypoints
    rows = {}  # keypoint of each point, by image
    for image_id, name in enumerate(poses, 1):
        orders[image_id] = random.permutation(NUM_POINTS)
        rows[image_id] = np.argsort(orders[image_id])
        now = points.copy()
        now[moves, 1] += SHIFT * image_id
        pixels[image_id] = project(now, poses[name])
    with open_database(path) as database:
        write_images(database, wall_camera(), poses)
        for image_id, of_image in pixels.items():
            keypoints = of_image[orders[image_id]]
            database.write_keypoints(image_id, keypoints.astype(np.float32))
        for number, (first, second) in enumerate(combinations(pixels, 2)):
            seen = is_inside(pixels[first]) & is_inside(pixels[second])
            if repeats:
                of_pair = np.arange(NUM_POINTS) % 6 == number
                seen &= of_pair | ~moves
            both = np.stack([rows[first], rows[second]], axis=1).astype(np.uint32)
            database.write_matches(first, second, both[seen])
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = both[seen & ~moves]
            database.write_two_view_geometry(first, second, geometry)
    model = posed_model(path, poses)
    for point in np.flatnonzero(~moves):
        track = pycolmap.Track()
        for image_id, of_image in pixels.items():
            if is_inside(of_image[point : point + 1])[0]:
                track.add_element(image_id, int(rows[image_id][point]))
        if track.length() > 1:
            model.add_point3D(points[point], track)
    return model


def share(path: Path, left_of: float, *, repeats: bool = False) -> float:
    model = scene(path, left_of, repeats=repeats)
    return share_of_motion(model, PairGraph.read(path))


def left_part_of_wall(part: float) -> float:
    """Return up to where so large a part of the points of the wall is."""
    return float(np.quantile(wall(np.random.default_rng(2), NUM_POINTS)[:, 0], part))


def middle_of_wall() -> float:
    return left_part_of_wall(0.5)


@pytest.mark.parametrize("part", [0.25, 0.5])
def test_of_a_wall_of_which_a_part_moves_the_rest_moves_as_the_model_says(
    tmp_path: Path, part: float
) -> None:
    path = tmp_path / "moving.db"
    found = share(path, left_part_of_wall(part))
    assert found == pytest.approx(1.0 - part, abs=0.15)


def test_where_nothing_moves_all_moves_as_the_model_says(tmp_path: Path) -> None:
    assert share(tmp_path / "still.db", -np.inf) == 1.0


def test_other_matches_in_each_pair_are_no_surface_that_moves(tmp_path: Path) -> None:
    path = tmp_path / "repeats.db"
    assert share(path, middle_of_wall(), repeats=True) == 1.0


def summary(path: Path, mapped: MappedModel) -> ModelSummary:
    """Score and write a model as if a mapper had made it."""
    mapper = mapper_of("sparse")
    mapper.map = lambda *_: [mapped]
    task = task_with_given_cameras(path)
    (found,) = map_database(mapper, task, path.with_name("sparse"), lambda _: None)
    return found


def test_model_beside_which_as_much_moves_is_not_sure_and_says_so(
    tmp_path: Path,
) -> None:
    path = tmp_path / "half.db"
    found = summary(path, MappedModel(scene(path, middle_of_wall())))
    assert len(found.registered_names) == NUM_IMAGES
    assert not found.sure
    for doubts in {**found.doubtful, **found.unsure}.values():
        assert doubts[0].code == "something_moves"


def test_what_freed_cameras_hide_is_doubted_all_the_same(tmp_path: Path) -> None:
    path = tmp_path / "still.db"
    mapped = MappedModel(scene(path, -np.inf), motion_share=0.4)
    found = summary(path, mapped)
    assert len(found.doubtful) == NUM_IMAGES
    assert max(found.probabilities.values()) < DOUBTFUL < SURE
