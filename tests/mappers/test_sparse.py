"""The sparse mapper on scenes whose truth is known: chains without tracks of three views, loops."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import task_with_given_cameras, write_images
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.model_files import Poses, model_poses, pose_errors, relative_pose
from colmap_affrect.colmap.verification import VerificationOptions, verify
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.pair_graph import PairGraph, graph_of
from colmap_affrect.mappers.reliability import judge
from colmap_affrect.mappers.sparse import SparseMapper, SparseOptions
from colmap_affrect.mappers.tie_joining import BY_HAND
from colmap_affrect.mappers.tie_points import tie_points_of, tied_evidence

WIDTH, HEIGHT = 1000, 700
MATRIX = np.array([[900.0, 0.0, 480.0], [0.0, 910.0, 360.0], [0.0, 0.0, 1.0]])
NOISE_PX = 0.3
MAX_SCALE_ERROR = 0.03


def turned(about_x: float, about_y: float, about_z: float) -> NDArray[np.float64]:
    angles = np.deg2rad([about_x, about_y, about_z])
    return np.asarray(pycolmap.Rotation3d(angles).matrix())


def views(count: int) -> Poses:
    """Cameras that walk along a wall with unequal steps, up and down, and turn and roll."""
    steps = np.cumsum([1.0, 1.3, 0.8, 1.5, 1.1, 0.9][:count])
    found = {}
    for i, along in enumerate(steps):
        rotation = turned(3.0 * (-1) ** i, 9.0 - 4.0 * i, 5.0 * i)
        center = np.array([along, 0.25 * (-1) ** i, -0.3 * i % 0.7])
        found[f"{i}.jpg"] = rotation, -rotation @ center
    return found


def wall(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points of two slanted planes that meet in an edge."""
    x, y = random.uniform(-3, 9, count), random.uniform(-3, 3, count)
    return np.stack([x, y, 7.0 + 0.35 * np.abs(x - 3.0) + 0.1 * y], axis=1)


def write_scene(path: Path, poses: Poses, pairs: Iterable[tuple[int, int]]) -> None:
    """Write a verified database in which each pair of images has features of its own."""
    random = np.random.default_rng(5)
    names = list(poses)
    keypoints = {i: [np.zeros((0, 2))] for i in range(len(names))}
    matches = {}
    for first, second in pairs:
        points = wall(random, 600)
        seen = [project(points, poses[names[i]]) for i in (first, second)]
        inside = np.logical_and(*(is_inside(part) for part in seen))
        starts = [sum(map(len, keypoints[i])) for i in (first, second)]
        for i, part in zip((first, second), seen, strict=True):
            keypoints[i].append(part[inside] + random.normal(0, NOISE_PX, (inside.sum(), 2)))
        rows = np.arange(inside.sum())
        matches[first, second] = np.stack([starts[0] + rows, starts[1] + rows], axis=1)
    with closing(pycolmap.Database.open(path)) as database:
        camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT)
        camera.params = MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]]
        write_images(database, camera, names)
        for i, parts in keypoints.items():
            database.write_keypoints(i + 1, np.concatenate(parts).astype(np.float32))
        for (first, second), indices in matches.items():
            database.write_matches(first + 1, second + 1, indices.astype(np.uint32))
    verify(path, VerificationOptions())


def project(points: NDArray[np.float64], pose: tuple[NDArray, NDArray]) -> NDArray[np.float64]:
    seen = (points @ pose[0].T + pose[1]) @ MATRIX.T
    return np.where(seen[:, 2:] > 0, seen[:, :2] / seen[:, 2:], np.nan)


def is_inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(((points > 0) & (points < (WIDTH, HEIGHT))).all(axis=1))


def mapped(path: Path, output_path: Path, **values: Any) -> list[MappedModel]:
    output_path.mkdir()
    task = task_with_given_cameras(path, **values)
    return SparseMapper(SparseOptions()).map(task, output_path, 0, lambda _: None)


def relative_errors(
    model: MappedModel, truth: Poses, first: str, second: str
) -> tuple[float, float]:
    """Errors in degrees of rotation and direction between two images."""
    found = model_poses(model.reconstruction)
    return pose_errors(*(relative_pose(poses[first], poses[second]) for poses in (found, truth)))


def centers(poses: Poses) -> NDArray[np.float64]:
    return np.array([-poses[name][0].T @ poses[name][1] for name in sorted(poses)])


def test_chain_in_which_no_feature_is_seen_three_times_is_bridged(tmp_path: Path) -> None:
    truth = views(6)
    path = tmp_path / "database.db"
    write_scene(path, truth, [(i, i + 1) for i in range(5)])
    (model, *others) = mapped(path, tmp_path / "models")
    assert not others
    found = model_poses(model.reconstruction)
    assert sorted(found) == sorted(truth)
    steps, true_steps = (
        np.linalg.norm(np.diff(centers(poses), axis=0), axis=1) for poses in (found, truth)
    )
    ratios = (steps / true_steps) / (steps[0] / true_steps[0])
    np.testing.assert_allclose(ratios, 1.0, atol=MAX_SCALE_ERROR)
    for first, second in zip(sorted(truth), sorted(truth)[1:], strict=False):
        assert max(relative_errors(model, truth, first, second)) < 1.0
    assert len(model.bridges) == 4
    for name, bridge in model.bridges.items():
        assert bridge.by != name
        assert bridge.num_agreeing > 0.8 * bridge.num_ratios
        assert 0.0 < bridge.scale_error_frac < MAX_SCALE_ERROR
    (again,) = mapped(path, tmp_path / "again", before=[model])
    assert again.bridges == model.bridges


@pytest.mark.long
def test_wrong_pair_in_a_loop_of_four_is_outvoted(tmp_path: Path) -> None:
    truth = views(4)
    path = tmp_path / "database.db"
    write_scene(path, truth, [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)])
    wrong = dict(truth)
    wrong["3.jpg"] = turned(0, 25, 40) @ truth["3.jpg"][0], truth["3.jpg"][1] + (0.5, 0, 0)
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
def test_what_incremental_mapping_registers_is_left_as_it_is(tmp_path: Path, count: int) -> None:
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
            lines.append(f"{name},p{number},{y + 0.8 * shift:.2f},{x + 0.6 * shift:.2f}")
    table.write_text("\n".join(lines) + "\n")
    mapped_path, output_path = path.with_name("mapped.db"), path.with_name("models")
    tie_points = ByHand(tie_points_path=table).copy_database(path, mapped_path)
    output_path.mkdir()
    task = task_with_given_cameras(mapped_path, tie_points=tie_points)
    return SparseMapper(SparseOptions()).map(task, output_path, 0, lambda _: None), task


def test_lost_photograph_comes_back_by_six_points_in_two_others(tmp_path: Path) -> None:
    truth = views(4)
    (model,), task = tied(tmp_path, truth, TRIANGLE, {"1.jpg": 6, "2.jpg": 6, "3.jpg": 6})
    assert model.moves[-1] == BY_HAND
    assert model.reconstruction.num_reg_images() == 4
    assert relative_errors(model, truth, "0.jpg", "3.jpg")[0] < 2.0
    residuals = tie_points_of(task, graph_of(task, 15)).report(model.reconstruction)
    assert len(residuals) == 18
    assert residuals[0].error_px < 10.0
    assert judge(model, task)["3.jpg"].probability > 0.8


def test_a_mark_that_is_far_off_is_named_as_the_worst(tmp_path: Path) -> None:
    truth = views(4)
    marked = {"1.jpg": 8, "2.jpg": 8, "3.jpg": 8}
    (model,), task = tied(tmp_path, truth, TRIANGLE, marked, moved=("p5", "3.jpg"))
    worst = tie_points_of(task, graph_of(task, 15)).report(model.reconstruction)[0]
    assert (worst.point, worst.image) == ("p5", "3.jpg")
    assert worst.error_px > 50.0
    assert relative_errors(model, truth, "0.jpg", "3.jpg")[0] < 3.0


def test_photograph_in_a_wrong_place_is_placed_by_its_tie_points(tmp_path: Path) -> None:
    truth = views(4)
    wrong = {**truth, "3.jpg": (turned(0, 25, 40) @ truth["3.jpg"][0], truth["3.jpg"][1])}
    pairs = [*TRIANGLE, (2, 3)]
    write_scene(tmp_path / "before.db", wrong, pairs)
    (before,) = mapped(tmp_path / "before.db", tmp_path / "before")
    assert relative_errors(before, truth, "0.jpg", "3.jpg")[0] > 20.0
    (model,), _ = tied(tmp_path, truth, pairs, {"1.jpg": 6, "2.jpg": 6, "3.jpg": 6}, scene=wrong)
    assert model.reconstruction.num_reg_images() == 4
    assert relative_errors(model, truth, "0.jpg", "3.jpg")[0] < 3.0


def test_two_models_are_joined_by_seven_points(tmp_path: Path) -> None:
    truth = views(6)
    pairs = [*TRIANGLE, (3, 4), (4, 5), (3, 5)]
    models, _ = tied(tmp_path, truth, pairs, {f"{i}.jpg": 7 for i in (1, 2, 3, 4)})
    assert [model.reconstruction.num_reg_images() for model in models] == [6]
    for name in ("3.jpg", "5.jpg"):
        assert relative_errors(models[0], truth, "0.jpg", name)[0] < 3.0


def test_tie_points_of_too_few_photographs_join_nothing(tmp_path: Path) -> None:
    truth = views(4)
    (model,), task = tied(tmp_path, truth, TRIANGLE, {"1.jpg": 3, "2.jpg": 3, "3.jpg": 3})
    assert model.reconstruction.num_reg_images() == 3
    assert len(tie_points_of(task, graph_of(task, 15)).report(model.reconstruction)) == 6


def test_evidence_of_tie_points_grows_with_those_that_agree() -> None:
    agreeing = [(f"{point}", image_id, 2.0) for point in range(6) for image_id in (1, 2, 3)]
    assert tied_evidence(agreeing[:9])[1] == 0.0
    assert tied_evidence(agreeing)[1] > 2.0
    assert tied_evidence([*agreeing, ("q", 1, 50.0), ("q", 2, 1.0), ("q", 3, 1.0)])[2] > 2.0
    wrong = [(f"{point}", image_id, 20.0 * image_id) for point in "qrs" for image_id in (0, 1, 2)]
    assert tied_evidence(wrong)[2] < -5.0 < tied_evidence(wrong)[0]


def test_two_photographs_alone_prove_nothing() -> None:
    assert tied_evidence([(f"{point}", i, 0.0) for point in range(8) for i in (1, 2)]) == {}
