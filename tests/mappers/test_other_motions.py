"""Whether something moves as one between photographs, against the rest of what they show."""

from __future__ import annotations

from collections import Counter
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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
from colmap_affrect.colmap.verification import Side
from colmap_affrect.mappers import other_motions, scored_models
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.mapping import map_database, read_models
from colmap_affrect.mappers.other_cameras import OtherCameras
from colmap_affrect.mappers.other_motions import (
    _contradicting,
    _Motions,
    _showing_another_motion,
    share_moving_as_modelled,
)
from colmap_affrect.mappers.pair_graph import PairGraph, VerifiedPair
from colmap_affrect.mappers.small_motions import SmallMotion
from colmap_affrect.project.reasons import Doubt
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
    return share_moving_as_modelled(model, PairGraph.read(path))


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
    mapped = MappedModel(scene(path, -np.inf), share_as_modelled=0.4)
    found = summary(path, mapped)
    assert len(found.doubtful) == NUM_IMAGES
    assert max(found.probabilities.values()) < DOUBTFUL < SURE


@pytest.mark.parametrize(
    ("change_deg", "is_doubted"),
    [
        (9.0, True),
        (1.0, False),
    ],
)
def test_a_model_is_as_sure_as_a_small_motion_that_turns_it_is_not_the_scene(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change_deg: float,
    *,
    is_doubted: bool,
) -> None:
    changes_deg = {
        "0.jpg": change_deg,
        "1.jpg": 0.5,
    }
    small = SmallMotion(0.6, changes_deg)
    monkeypatch.setattr(scored_models, "small_motion", lambda _: small)
    path = tmp_path / "still.db"
    found = summary(path, MappedModel(scene(path, -np.inf)))
    assert bool(found.sure) != is_doubted
    if is_doubted:
        assert max(found.probabilities.values()) < 0.65
        doubts = {**found.doubtful, **found.unsure}
        assert len(doubts) == NUM_IMAGES
        assert doubts["0.jpg"][0] == Doubt("something_moves", {"percent": 60})


@pytest.mark.parametrize("are_shared", [True, False])
def test_models_that_are_gone_on_from_bring_what_is_not_looked_at_again(
    tmp_path: Path, *, are_shared: bool
) -> None:
    """Own cameras of shared ones are; what cameras hide that were freed, and one camera are not."""
    path = tmp_path / "still.db"
    other = OtherCameras(-1.0, {"1.jpg": 3.0}, are_shared=are_shared)
    summary(
        path,
        MappedModel(scene(path, -np.inf), other_cameras=other, share_as_modelled=0.4),
    )
    (found,) = read_models(tmp_path / "sparse")
    assert found.share_as_modelled == 0.4
    assert found.other_cameras == (other if are_shared else None)


CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 900.0, 800, 600)
NOTHING = pycolmap.TwoViewGeometry()
NO_MATCHES = np.zeros((0, 2), np.int64)


@pytest.mark.parametrize(("error_px", "num_far"), [(5.0, 0), (8.0, 60), (50.0, 60)])
def test_matches_contradict_a_model_that_are_half_as_far_again_as_those_that_agree(
    error_px: float, num_far: int
) -> None:
    """Those that agree are up to 4 px off. The second image is from the left of the first one."""
    random = np.random.default_rng(3)
    points = random.uniform((-2.0, -1.5, 5.0), (2.0, 1.5, 9.0), (120, 3))
    first = CAMERA.img_from_cam(points)
    second = CAMERA.img_from_cam(points + np.array([0.5, 0.0, 0.0]))
    second[:60, 1] += np.sqrt(2.0) * error_px  # Sampson's error is of both images
    rows = np.stack([np.arange(120)] * 2, axis=1)
    graph: Any = SimpleNamespace(
        keypoints={1: first.astype(np.float32), 2: second.astype(np.float32)},
        shaped_keypoints={},
        raw_matches={},
    )
    poses = {1: (np.eye(3), np.zeros(3)), 2: (np.eye(3), np.array([0.5, 0.0, 0.0]))}
    found = _contradicting(
        VerifiedPair((1, 2), rows, NOTHING), poses, {1: CAMERA, 2: CAMERA}, graph
    )
    assert (len(found.other) if found else 0) == num_far
    if found:
        assert found.own[:, 0].tolist() == list(range(60, 120))


@pytest.mark.parametrize(("num_contradicting", "is_verified"), [(1, False), (2, True)])
def test_nothing_is_verified_where_too_few_pairs_contradict_a_model(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    num_contradicting: int,
    *,
    is_verified: bool,
) -> None:
    verified = []

    def contradicting(pair: VerifiedPair, *_: Any) -> _Motions | None:
        if pair.ids not in [(1, 2), (1, 3)][:num_contradicting]:
            return None
        side = Side(CAMERA, np.zeros((0, 2), np.float32))
        return _Motions(pair, (side, side), NO_MATCHES, NO_MATCHES)

    def estimate(*_: Any) -> pycolmap.TwoViewGeometry:
        verified.append(1)
        return NOTHING

    monkeypatch.setattr(other_motions, "_contradicting", contradicting)
    monkeypatch.setattr(other_motions, "estimate_geometry", estimate)
    assert share(tmp_path / "still.db", -np.inf) == 1.0
    assert bool(verified) == is_verified


def test_pairs_are_not_searched_any_more_when_too_few_can_show_another_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched = []

    def estimate(*_: Any) -> pycolmap.TwoViewGeometry:
        searched.append(1)
        return NOTHING

    monkeypatch.setattr(other_motions, "estimate_geometry", estimate)
    monkeypatch.setattr(other_motions, "available_cores", lambda: 2)
    side = Side(CAMERA, np.zeros((0, 2), np.float32))
    pair = VerifiedPair((1, 2), NO_MATCHES, NOTHING)
    contradicting = [_Motions(pair, (side, side), NO_MATCHES, NO_MATCHES)] * 100
    assert _showing_another_motion(contradicting, least=95) == []
    assert 6 <= len(searched) <= 6 + 4  # the others were begun before


def test_a_cell_belongs_to_the_motion_with_more_matches_in_it() -> None:
    places = np.array([[50.0, 50.0]] * 5 + [[250.0, 50.0]] * 3 + [[50.0, 250.0]])
    side = Side(CAMERA, places.astype(np.float32))
    own = np.array([0, 1, 2, 5])  # three in the first cell and one in the second
    other = np.array([3, 4, 6, 7, 8])  # two, two, and one in the third
    motions = _Motions(
        VerifiedPair((1, 2), NO_MATCHES, NOTHING),
        (side, side),
        np.stack([own, own], axis=1),
        np.stack([other, other], axis=1),
    )
    assert motions.cells().tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("feature", "is_chained"),
    [((1, 10), True), ((2, 20), True), ((1, 20), False), ((2, 10), False)],
)
def test_motion_is_chained_by_a_third_of_its_features_in_either_image(
    feature: tuple[int, int], *, is_chained: bool
) -> None:
    motions = _Motions(
        VerifiedPair((1, 2), NO_MATCHES, NOTHING),
        (Side(CAMERA, np.zeros((0, 2), np.float32)),) * 2,
        NO_MATCHES,
        np.array([[10, 20], [11, 21], [12, 22]]),
    )
    assert motions.is_chained(Counter({feature: 2})) == is_chained
    assert not motions.is_chained(Counter({feature: 1}))
