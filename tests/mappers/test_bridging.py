"""Bridges: images registered by one verified pair, whichever of its images the model has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tasks import SEED, mapper_of, task_with_given_cameras
from wall_scene import views, write_scene

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose, pose_errors, relative_pose
from colmap_affrect.geometry.two_views import ScaleEstimate
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import (
    BridgeFinder,
    BridgeHypothesis,
    _OpenPair,
    _PosedModel,
)
from colmap_affrect.mappers.camera_priors import camera_priors
from colmap_affrect.mappers.growing import Grower, register_bridges
from colmap_affrect.mappers.model_score import ModelScorer
from colmap_affrect.mappers.pair_graph import PairGraph, poses_of
from colmap_affrect.project.report import Bridge

CHAIN = [(0, 1), (1, 2), (2, 3)]
TRUTH = dict(enumerate(views(4).values(), 1))
MIDDLE = (2, 3)  # ids of the images that the model begins with


@pytest.fixture(scope="module")
def grower(tmp_path_factory: pytest.TempPathFactory) -> Grower:
    """What grows models of a chain of four images without tracks of three."""
    path = tmp_path_factory.mktemp("chain") / "database.db"
    write_scene(path, views(4), CHAIN)
    task = task_with_given_cameras(path)
    graph = PairGraph.read(path)
    native = mapper_of("sparse").native(task, SEED)
    priors = camera_priors(graph.cameras.values(), task.cameras, {})
    fixed = frozenset(priors)
    adjuster = Adjuster(priors, NOISE_PX, native.get_global_bundle_adjustment(), fixed)
    return Grower(graph, adjuster, native, lambda _: None)


@pytest.fixture(scope="module")
def middle(grower: Grower) -> pycolmap.Reconstruction:
    """The model of the two images in the middle of the chain."""
    model = grower.grow(MIDDLE)
    assert model is not None
    assert sorted(model.reg_image_ids()) == list(MIDDLE)
    return model


def scale_of(poses: dict[int, Pose], first: int, second: int) -> float:
    """How long the step between two images is, in units of its true length."""
    steps = [relative_pose(found[first], found[second])[1] for found in (poses, TRUTH)]
    return float(np.linalg.norm(steps[0]) / np.linalg.norm(steps[1]))


@pytest.mark.parametrize(("image_id", "neighbor"), [(1, 2), (4, 3)])
def test_bridge_begins_at_the_first_or_at_the_second_image_of_a_pair(
    grower: Grower, middle: pycolmap.Reconstruction, image_id: int, neighbor: int
) -> None:
    found = BridgeFinder(grower.graph, grower.adjuster, SEED).find(middle)
    best = next(hypothesis for hypothesis in found if hypothesis.image_id == image_id)
    assert best.bridge.by == grower.graph.names[neighbor]
    poses = {**poses_of(middle), image_id: best.pose}
    for other in MIDDLE:
        estimated = relative_pose(poses[other], poses[image_id])
        errors_deg = pose_errors(
            estimated, relative_pose(TRUTH[other], TRUTH[image_id])
        )
        assert max(errors_deg) < 1.0
    scale = scale_of(poses, neighbor, image_id) / scale_of(poses, *MIDDLE)
    assert scale == pytest.approx(1.0, abs=0.03)


def keep_points(
    model: pycolmap.Reconstruction, image_id: int, right_px: float
) -> pycolmap.Reconstruction:
    """Return a copy with the points that an image sees left of a column."""
    part = pycolmap.Reconstruction(model)
    for keypoint in list(part.images[image_id].get_observation_points2D()):
        if keypoint.xy[0] >= right_px:
            part.delete_point3D(keypoint.point3D_id)
    return part


def bridged(grower: Grower, model: pycolmap.Reconstruction) -> set[int]:
    found = BridgeFinder(grower.graph, grower.adjuster, SEED).find(model)
    return {hypothesis.image_id for hypothesis in found}


def test_depths_far_from_the_features_of_a_pair_tell_no_scale(
    grower: Grower, middle: pycolmap.Reconstruction
) -> None:
    (pair,) = [pair for pair in grower.graph.pairs if pair.ids == (3, 4)]
    left_px = grower.graph.keypoints[3][pair.matches[:, 0], 0].min()
    near = keep_points(middle, 3, left_px + 150)
    far = keep_points(
        middle, 3, left_px - 125
    )  # depths 120 px away may be on the same plane
    assert far.num_points3D() > 20
    assert 4 in bridged(grower, near)
    assert 4 not in bridged(grower, far)


@pytest.mark.parametrize(("hole_px", "is_told"), [(50.0, True), (160.0, False)])
def test_a_plane_around_features_tells_their_scale_up_to_an_eighth_of_the_image(
    hole_px: float, *, is_told: bool
) -> None:
    """Depths are known on a slanted wall, but for a hole in which the features of the pair are."""
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    middle = np.array([600.0, 300.0])
    x, y = np.meshgrid(np.arange(300.0, 900.0, 15.0), np.arange(0.0, 600.0, 15.0))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    known = grid[np.linalg.norm(grid - middle, axis=1) > hole_px]
    features = middle + np.random.default_rng(1).uniform(-10.0, 10.0, (30, 2))
    posed: Any = SimpleNamespace(
        cameras={8: camera}, known_depths=lambda _: (known, depths_of_wall(known))
    )
    keypoints = np.concatenate([np.zeros((5, 2)), features]).astype(np.float32)
    graph: Any = SimpleNamespace(keypoints={8: keypoints})
    open_pair: Any = SimpleNamespace(inside=8, side=1)
    rows = np.arange(30)
    relative: Any = SimpleNamespace(
        matches=np.stack([rows, rows + 5], axis=1),
        depths=(np.ones(30), depths_of_wall(features) / 2.5),
    )
    adjuster: Any = None
    scale = BridgeFinder(graph, adjuster, SEED)._scale(posed, open_pair, relative)
    assert (scale is not None) == is_told
    if scale:
        assert scale.scale == pytest.approx(2.5, rel=1e-3)


@pytest.mark.parametrize(
    ("of_large", "of_small", "weight"),
    [(0.9, 0.3, 21.0), (0.4, 1.0, 18.0), (0.4, 0.6, None)],
)
def test_pairs_say_whether_a_bridge_is_right_by_the_roots_of_their_matches(
    of_large: float, of_small: float, weight: float | None
) -> None:
    """Image 5 has a pair of 400 matches with the model, and one of 100 matches."""
    shares = {(1, 5): of_large, (5, 7): of_small, (1, 7): 0.0}
    pairs = []
    for ids, num in (((1, 5), 400), ((5, 7), 100), ((1, 7), 900)):
        pairs.append(SimpleNamespace(ids=ids, matches=np.zeros((num, 2))))
    graph: Any = SimpleNamespace(
        pairs_inside=lambda poses: pairs if poses.keys() == {1, 5, 7} else [],
        agreement=lambda pair, *_: shares[pair.ids],
    )
    posed: Any = SimpleNamespace(poses={1: None, 7: None}, cameras={})
    nothing: Any = None
    finder = BridgeFinder(graph, nothing, SEED)
    found = finder._agreeing_weight(posed, 5, nothing, nothing)
    assert found == (None if weight is None else pytest.approx(weight))


def test_a_bridge_ranks_by_the_pairs_and_the_depths_that_agree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph: Any = SimpleNamespace(names={1: "one.jpg"})
    nothing: Any = None
    finder = BridgeFinder(graph, nothing, SEED)
    relative = SimpleNamespace(pose=(np.eye(3), np.array([1.0, 0.0, 0.0])))
    scale = ScaleEstimate(2.0, num_agreeing=12, num_ratios=16, error_frac=0.01)
    monkeypatch.setattr(finder, "_poses_of_pair", lambda *_: [relative])
    monkeypatch.setattr(finder, "_scale", lambda *_: scale)
    monkeypatch.setattr(finder, "_agreeing_weight", lambda *_: 8.0)
    posed: Any = SimpleNamespace(
        poses={1: (np.eye(3), np.array([0.0, 5.0, 0.0]))}, cameras={1: None}
    )
    pair: Any = SimpleNamespace(ids=(1, 5))
    (found,) = finder._hypotheses(posed, _OpenPair(pair, 0, nothing))
    assert found.rank == 8.0 * 12 / 16
    assert found.image_id == 5
    assert found.bridge == Bridge("one.jpg", 12, 16, 0.01)
    assert found.pose[1].tolist() == [2.0, 5.0, 0.0]


def test_points_behind_a_camera_have_no_known_depth() -> None:
    """The camera is turned, and its depths are along its own axis."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    model.add_camera_with_trivial_rig(camera)
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.6, -0.4, 0.2])), np.array([1.0, 2.0, 3.0])
    )
    pixels = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]])
    image = pycolmap.Image("8.jpg", pixels, 1, 8)
    model.add_image_with_trivial_frame(image, pose)
    for index, depth in enumerate((5.0, -4.0, 7.0)):
        track = pycolmap.Track()
        track.add_element(8, index)
        model.add_point3D(pose.inverse() * np.array([0.3, -0.2, depth]), track)
    positions, depths = _PosedModel(model).known_depths(8)
    assert positions.tolist() == [[10.0, 20.0], [50.0, 60.0]]
    assert depths == pytest.approx([5.0, 7.0])


def depths_of_wall(points_px: np.ndarray) -> np.ndarray:
    """Return the depths of a slanted wall at (N, 2) px."""
    return 1.0 / (0.1 + points_px @ [1e-4, 5e-5])


def test_few_depths_tell_no_scale(
    grower: Grower, middle: pycolmap.Reconstruction
) -> None:
    ids = sorted(middle.point3D_ids())
    few = pycolmap.Reconstruction(middle)
    for point_id in ids[3:]:
        few.delete_point3D(point_id)
    assert bridged(grower, middle) == {1, 4}
    assert bridged(grower, few) == set()


class Trials:
    """A finder of bridges that lead nowhere, and what tries them."""

    def __init__(self, model: pycolmap.Reconstruction, number: int) -> None:
        pose = np.eye(3), np.zeros(3)
        camera = next(iter(model.cameras.values()))
        bridge = Bridge("2.jpg", 10, 10, 0.01)
        self.hypotheses = [
            BridgeHypothesis(bridge, image_id, pose, camera, 1.0)
            for image_id in range(number)
        ]
        self.num_tried = 0

    def find(self, _: pycolmap.Reconstruction) -> list[BridgeHypothesis]:
        return self.hypotheses

    def register_at(self, _: Any, __: Any, model: pycolmap.Reconstruction) -> Any:
        self.num_tried += 1
        return model


def test_a_model_is_complete_after_five_bridges_in_vain(
    grower: Grower, middle: pycolmap.Reconstruction
) -> None:
    trials: Any = Trials(middle, 20)
    scorer = ModelScorer(grower.graph, grower.adjuster.priors)
    found = register_bridges(MappedModel(middle), trials, trials, scorer)
    assert found.reconstruction is middle
    assert found.bridges == {}
    assert trials.num_tried == 5
