"""The sparse mapper on scenes whose truth is known: chains without tracks of three views, loops."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import task_with_given_cameras
from numpy.typing import NDArray
from wall_scene import is_inside, project, turned, views, wall, write_scene

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.model_files import (
    Poses,
    model_poses,
    pose_errors,
    relative_pose,
)
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.pair_graph import PairGraph, graph_of
from colmap_affrect.mappers.reliability import score_images
from colmap_affrect.mappers.sparse import SparseMapper, SparseOptions
from colmap_affrect.mappers.tie_joining import BY_HAND
from colmap_affrect.mappers.tie_points import (
    ImageResidual,
    TiePoints,
    _NearbyDepths,
    tie_point_log_odds,
    tie_points_of,
)
from colmap_affrect.project.report import DOUBTFUL, SURE

MAX_SCALE_ERROR = 0.03


def mapped(path: Path, output_path: Path, **values: Any) -> list[MappedModel]:
    output_path.mkdir()
    task = task_with_given_cameras(path, **values)
    return SparseMapper(SparseOptions()).map(task, output_path, 0, lambda _: None)


def relative_errors(
    model: MappedModel, truth: Poses, first: str, second: str
) -> tuple[float, float]:
    """Errors in degrees of rotation and direction between two images."""
    found = model_poses(model.reconstruction)
    return pose_errors(
        *(relative_pose(poses[first], poses[second]) for poses in (found, truth))
    )


def centers(poses: Poses) -> NDArray[np.float64]:
    return np.array([-poses[name][0].T @ poses[name][1] for name in sorted(poses)])


def step_ratios(model: MappedModel, truth: Poses) -> NDArray[np.float64]:
    """How long the steps from image to image are, in units of the first one and of true ones."""
    steps = np.diff(centers(model_poses(model.reconstruction)), axis=0)
    true_steps = np.diff(centers(truth), axis=0)
    ratios = np.linalg.norm(steps, axis=1) / np.linalg.norm(true_steps, axis=1)
    return np.asarray(ratios / ratios[0])


def test_chain_in_which_no_feature_is_seen_three_times_is_bridged(
    tmp_path: Path,
) -> None:
    truth = views(6)
    path = tmp_path / "database.db"
    write_scene(path, truth, [(i, i + 1) for i in range(5)])
    (model,) = mapped(path, tmp_path / "models")
    assert sorted(model_poses(model.reconstruction)) == sorted(truth)
    np.testing.assert_allclose(step_ratios(model, truth), 1.0, atol=MAX_SCALE_ERROR)
    for first, second in pairwise(sorted(truth)):
        assert max(relative_errors(model, truth, first, second)) < 1.0
    assert len(model.bridges) == 4
    for name, bridge in model.bridges.items():
        assert bridge.by != name
        assert bridge.num_agreeing > 0.8 * bridge.num_ratios
        assert 0.0 < bridge.scale_error_frac < MAX_SCALE_ERROR
    (again,) = mapped(path, tmp_path / "again", previous_models=[model])
    assert again.bridges == model.bridges


@pytest.mark.long
def test_wrong_pair_in_a_loop_of_four_is_outvoted(tmp_path: Path) -> None:
    truth = views(4)
    path = tmp_path / "database.db"
    write_scene(path, truth, [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)])
    wrong = dict(truth)
    wrong["3.jpg"] = (
        turned(0, 25, 40) @ truth["3.jpg"][0],
        truth["3.jpg"][1] + (0.5, 0, 0),
    )
    other = tmp_path / "other.db"
    write_scene(other, wrong, [(0, 3)])
    right_graph = PairGraph.read(path, 15)
    with (
        closing(pycolmap.Database.open(path)) as database,
        closing(pycolmap.Database.open(other)) as second,
    ):
        # The wrong pair's features come after those of the others.
        indices = second.read_two_view_geometry(1, 4).inlier_matches.astype(np.int64)
        for image_id, column in ((1, 0), (4, 1)):
            own = database.read_keypoints(image_id)
            both = np.concatenate([own, second.read_keypoints(image_id)])
            database.update_keypoints(image_id, both)
            indices[:, column] += len(own)
        database.write_matches(1, 4, indices.astype(np.uint32))
    verify(path, VerificationOptions())
    graph = PairGraph.read(path, 15)
    assert len(graph.pairs) == len(right_graph.pairs) + 1
    model, *_ = mapped(path, tmp_path / "models")
    assert sorted(model_poses(model.reconstruction)) == sorted(truth)
    for pair in (("0.jpg", "3.jpg"), ("1.jpg", "2.jpg")):
        assert max(relative_errors(model, truth, *pair)) < 1.0


@pytest.mark.parametrize("count", [2, 3])
def test_what_incremental_mapping_registers_is_left_as_it_is(
    tmp_path: Path, count: int
) -> None:
    path = tmp_path / "database.db"
    write_scene(path, views(count), [(0, 1)])
    (model,) = mapped(path, tmp_path / "models")
    assert model.bridges == {}
    assert model.reconstruction.num_reg_images() == 2


TRIANGLE = [(0, 1), (1, 2), (0, 2)]


def tied(
    folder: Path,
    truth: Poses,
    pairs: Iterable[tuple[int, int]],
    marked: dict[str, int],
    *,
    moved: tuple[str, str] | None = None,
    scene: Poses | None = None,
) -> tuple[list[MappedModel], MappingTask]:
    """Map pairs with tie points of the wall: of each image so many, with a noise of 2 px.

    The mark of one point in one image, ``moved``, is 100 px off. Features may be of another scene.
    """
    path = folder / "database.db"
    write_scene(path, scene or truth, pairs)
    random = np.random.default_rng(3)
    points = wall(random, 4000)
    seen = {name: project(points, truth[name]) for name in marked}
    common = points[np.logical_and.reduce([is_inside(xy) for xy in seen.values()])]
    corners = [int(np.argmax(common @ way)) for way in random.normal(size=(40, 3))]
    points = common[list(dict.fromkeys(corners))]
    table = path.with_suffix(".csv")
    lines = ["photograph,point,y,x"]
    for name, count in marked.items():
        noisy = project(points, truth[name]) + random.normal(0, 2.0, (len(points), 2))
        for number, (x, y) in enumerate(noisy[:count]):
            shift = 100.0 * (moved == (f"p{number}", name))
            lines.append(
                f"{name},p{number},{y + 0.8 * shift:.2f},{x + 0.6 * shift:.2f}"
            )
    table.write_text("\n".join(lines) + "\n")
    mapped_path = path.with_name("mapped.db")
    output_path = path.with_name("models")
    tie_points = ByHand(tie_points_path=table).copy_database(path, mapped_path)
    output_path.mkdir()
    task = task_with_given_cameras(mapped_path, tie_points=tie_points)
    return SparseMapper(SparseOptions()).map(task, output_path, 0, lambda _: None), task


def test_lost_photograph_comes_back_by_six_points_in_two_others(tmp_path: Path) -> None:
    truth = views(4)
    (model,), task = tied(
        tmp_path, truth, TRIANGLE, {"1.jpg": 6, "2.jpg": 6, "3.jpg": 6}
    )
    assert model.hypotheses[-1] == BY_HAND
    assert model.reconstruction.num_reg_images() == 4
    assert relative_errors(model, truth, "0.jpg", "3.jpg")[0] < 2.0
    residuals = tie_points_of(task, graph_of(task, 15)).report(model.reconstruction)
    assert len(residuals) == 18
    assert residuals[0].error_px < 10.0
    # The noise of six marks moves its direction by up to seven degrees.
    assert DOUBTFUL < score_images(model, task)["3.jpg"].probability < SURE


def test_a_mark_that_is_far_off_is_named_as_the_worst(tmp_path: Path) -> None:
    truth = views(4)
    marked = {"1.jpg": 8, "2.jpg": 8, "3.jpg": 8}
    (model,), task = tied(tmp_path, truth, TRIANGLE, marked, moved=("p5", "3.jpg"))
    worst = tie_points_of(task, graph_of(task, 15)).report(model.reconstruction)[0]
    assert (worst.point, worst.image) == ("p5", "3.jpg")
    assert worst.error_px > 50.0
    assert relative_errors(model, truth, "0.jpg", "3.jpg")[0] < 3.0


@pytest.mark.long
def test_photograph_in_a_wrong_place_is_placed_by_its_tie_points(
    tmp_path: Path,
) -> None:
    truth = views(4)
    wrong = {
        **truth,
        "3.jpg": (turned(0, 25, 40) @ truth["3.jpg"][0], truth["3.jpg"][1]),
    }
    pairs = [*TRIANGLE, (2, 3)]
    write_scene(tmp_path / "before.db", wrong, pairs)
    (before,) = mapped(tmp_path / "before.db", tmp_path / "before")
    assert relative_errors(before, truth, "0.jpg", "3.jpg")[0] > 20.0
    (model,), _ = tied(
        tmp_path, truth, pairs, {"1.jpg": 6, "2.jpg": 6, "3.jpg": 6}, scene=wrong
    )
    assert model.reconstruction.num_reg_images() == 4
    assert relative_errors(model, truth, "0.jpg", "3.jpg")[0] < 3.0


@pytest.mark.long
def test_two_models_are_joined_by_seven_points(tmp_path: Path) -> None:
    truth = views(6)
    pairs = [*TRIANGLE, (3, 4), (4, 5), (3, 5)]
    models, _ = tied(tmp_path, truth, pairs, {f"{i}.jpg": 7 for i in (1, 2, 3, 4)})
    assert [model.reconstruction.num_reg_images() for model in models] == [6]
    for name in ("3.jpg", "5.jpg"):
        assert relative_errors(models[0], truth, "0.jpg", name)[0] < 3.0


def test_tie_points_of_too_few_photographs_join_nothing(tmp_path: Path) -> None:
    truth = views(4)
    (model,), task = tied(
        tmp_path, truth, TRIANGLE, {"1.jpg": 3, "2.jpg": 3, "3.jpg": 3}
    )
    assert model.reconstruction.num_reg_images() == 3
    assert (
        len(tie_points_of(task, graph_of(task, 15)).report(model.reconstruction)) == 6
    )


def marked(
    points: str, image_ids: Iterable[int], error_px: float
) -> list[ImageResidual]:
    """Residuals of points, by the letters of their names, that are the same in all images."""
    found = []
    for point in points:
        for image_id in image_ids:
            found.append(ImageResidual(point, image_id, error_px))
    return found


def test_log_odds_of_tie_points_grow_with_those_that_agree() -> None:
    agreeing = marked("abcdef", (1, 2, 3), 2.0)
    assert tie_point_log_odds(agreeing[:9])[1] == 0.0
    assert tie_point_log_odds(agreeing)[1] > 2.0
    one_wrong = [ImageResidual("q", 1, 50.0), *marked("q", (2, 3), 1.0)]
    assert tie_point_log_odds([*agreeing, *one_wrong])[2] > 2.0
    wrong = (
        marked("qrs", [0], 0.0) + marked("qrs", [1], 20.0) + marked("qrs", [2], 40.0)
    )
    assert tie_point_log_odds(wrong)[2] < -5.0 < tie_point_log_odds(wrong)[0]


def test_many_tie_points_make_a_pose_hardly_surer_than_six_do() -> None:
    six = tie_point_log_odds(marked("abcdef", (1, 2, 3), 2.0))[1]
    many = tie_point_log_odds(marked("abcdefghijklmnopqrst", (1, 2, 3), 2.0))[1]
    assert many == six
    assert 0.9 < 1.0 / (1.0 + math.exp(-many)) < 0.95  # twelve of thirteen are right


def test_two_photographs_alone_prove_nothing() -> None:
    assert tie_point_log_odds(marked("abcdefgh", (1, 2), 0.0)) == {}


def test_what_an_image_sees_is_looked_up_once_for_all_its_marks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=2, num_points3D=400
    )
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    image_id = min(model.reg_image_ids())
    keypoints = {}
    places = {}
    for number, point in enumerate(model.images[image_id].points2D):
        if point.has_point3D():
            keypoints[f"p{number}"] = {image_id: number}
            places[f"p{number}"] = model.points3D[point.point3D_id].xyz
    look_up = _NearbyDepths._observed_by
    looked_up = list[int]()

    def counted(surroundings: _NearbyDepths, image_id: int) -> object:
        looked_up.append(image_id)
        return look_up(surroundings, image_id)

    monkeypatch.setattr(_NearbyDepths, "_observed_by", counted)
    found = TiePoints(keypoints).positions(model)
    assert looked_up == [image_id]
    assert len(found) > 0.9 * len(keypoints) > 100
    pose = model.images[image_id].cam_from_world()
    for name, place in found.items():
        ray = (pose * place) / np.linalg.norm(pose * place)
        true_ray = (pose * places[name]) / np.linalg.norm(pose * places[name])
        assert ray @ true_ray > 0.999999
