"""The points of a finished model: all tracks, each where its errors are smallest, poses kept."""

from __future__ import annotations

import copy
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import SEED, mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers import final_points
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.final_points import complete_points
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.reliability import score_images
from colmap_affrect.mappers.tie_points import NO_TIE_POINTS, TiePoints
from colmap_affrect.project.report import kept_probability

NOISE_PX = 0.5


def placed(path: Path) -> pycolmap.Reconstruction:
    """Write a database of noisy keypoints; return its cameras where they are, without points."""
    model = synthesize(path, noise_px=NOISE_PX, num_rigs=5, num_points3D=200)
    for key in list(model.point3D_ids()):
        model.delete_point3D(key)
    return model


def complete(
    model: pycolmap.Reconstruction,
    path: Path,
    tie_points: TiePoints = NO_TIE_POINTS,
    *,
    all_unscored: bool = False,
) -> None:
    native = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    native.triangulation.ignore_two_view_tracks = False
    graph = PairGraph.read(path)
    if all_unscored:
        graph = replace(graph, pairs=(), unscored=graph.pairs)
    complete_points(model, graph, native, NOISE_PX, tie_points)


def bits(model: pycolmap.Reconstruction) -> list[bytes]:
    """Poses, and parameters of cameras."""
    frames = [
        model.frames[key].rig_from_world.params for key in sorted(model.reg_frame_ids())
    ]
    cameras = [model.cameras[key].params for key in sorted(model.cameras)]
    return [np.asarray(values).tobytes() for values in (*frames, *cameras)]


def test_all_tracks_become_points_and_poses_stay_to_the_bit(tmp_path: Path) -> None:
    model = placed(tmp_path / "database.db")
    for key in model.reg_frame_ids():  # quaternions as solvers leave them
        model.frames[key].rig_from_world.params[:4] *= 1.0 + 4e-16
    before = bits(model)
    complete(model, tmp_path / "database.db")
    assert bits(model) == before
    assert model.num_points3D() >= 195
    # Of 5 observations with 10 coordinates, a point takes up three.
    assert model.compute_mean_reprojection_error() < 1.05 * NOISE_PX * np.sqrt(
        np.pi / 2 * 0.7
    )


def test_no_fewer_points_than_by_colmap_and_no_larger_errors(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, noise_px=2.0, num_rigs=2, num_points3D=400)
    native = pycolmap.IncrementalPipelineOptions(random_seed=SEED, num_threads=1)
    native.triangulation.ignore_two_view_tracks = False
    theirs = pycolmap.triangulate_points(
        copy.deepcopy(truth),
        path,
        tmp_path,
        tmp_path,
        clear_points=True,
        options=native,
    )
    model = copy.deepcopy(truth)
    for key in list(model.point3D_ids()):
        model.delete_point3D(key)
    complete(model, path)
    theirs.update_point_3d_errors()
    assert model.num_points3D() >= theirs.num_points3D() > 200
    assert (
        model.compute_mean_reprojection_error()
        <= theirs.compute_mean_reprojection_error()
    )


def test_points_that_stood_badly_are_moved(tmp_path: Path) -> None:
    model = placed(tmp_path / "database.db")
    complete(model, tmp_path / "database.db")
    least = model.compute_mean_reprojection_error()
    random = np.random.default_rng(1)
    points = model.points3D
    for key in list(points):
        points[key].xyz = points[key].xyz + random.normal(0.0, 0.005, 3)
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() > 1.5 * least
    complete(model, tmp_path / "database.db")
    assert model.compute_mean_reprojection_error() == pytest.approx(least, rel=0.01)


@pytest.mark.parametrize("all_unscored", [False, True])
def test_pair_that_contradicts_the_model_makes_no_points(
    tmp_path: Path, *, all_unscored: bool
) -> None:
    """Neither does one that is not among the strongest of its images."""
    path = tmp_path / "database.db"
    model = placed(path)
    first, second = sorted(model.reg_image_ids())[:2]
    with closing(pycolmap.Database.open(path)) as database:
        pairs, geometries = database.read_two_view_geometries()
        database.clear_two_view_geometries()
        for pair_id, geometry in zip(pairs, geometries, strict=True):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            if set(ids) == {first, second}:
                shifted = np.array(geometry.inlier_matches)
                shifted[:, 1] = np.roll(shifted[:, 1], 7)
                geometry.inlier_matches = shifted
                database.write_two_view_geometry(*ids, geometry)
    complete(model, path, all_unscored=all_unscored)
    assert model.num_points3D() == 0


def test_pairs_that_are_not_among_the_strongest_make_points_too(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    model = placed(path)
    complete(model, path, all_unscored=True)
    assert model.num_points3D() >= 195


def test_points_that_fail_are_refined_again_alone_and_without_robust_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    model = placed(path)
    complete(model, path)
    ids = model.point3D_ids()
    failing = set(sorted(ids)[:3])
    refined = list[tuple[pycolmap.LossFunctionType, set[int]]]()

    def refine(**given: Any) -> None:
        refined.append((given["loss"], ids - given["constant"]))

    monkeypatch.setattr(final_points, "_refine", refine)
    monkeypatch.setattr(final_points, "_failing", lambda *_: set(failing))
    complete(model, path)
    assert refined == [
        (pycolmap.LossFunctionType.CAUCHY, ids),
        (pycolmap.LossFunctionType.TRIVIAL, failing),
    ]


def test_points_marked_by_hand_stay_where_they_are(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    model = placed(path)
    complete(model, path)
    key = min(model.point3D_ids())
    track = model.points3D[key].track.elements
    seen = {element.image_id: element.point2D_idx for element in track}
    far = model.points3D[key].xyz + 0.05
    model.points3D[key].xyz = far
    complete(model, path, TiePoints({"corner": seen}))
    image_id, keypoint = next(iter(seen.items()))
    kept = model.images[image_id].points2D[keypoint].point3D_id
    np.testing.assert_array_equal(model.points3D[kept].xyz, far)


def write_many_short_tracks(path: Path) -> None:
    """Write a scene of which 150 points are seen by all images, and the others by two."""
    truth = synthesize(path, noise_px=NOISE_PX, num_rigs=5, num_points3D=800)
    with closing(pycolmap.Database.open(path)) as database:
        pairs, geometries = database.read_two_view_geometries()
        database.clear_two_view_geometries()
        for number, (pair_id, geometry) in enumerate(
            zip(pairs, geometries, strict=True)
        ):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.array(geometry.inlier_matches)
            seen = np.array(
                [truth.images[ids[0]].points2D[k].point3D_id for k in matches[:, 0]]
            )
            geometry.inlier_matches = matches[
                (seen <= 150) | (seen % len(pairs) == number)
            ]
            database.write_two_view_geometry(*ids, geometry)


def mean_error_of_two_views(model: pycolmap.Reconstruction) -> float:
    return float(
        np.mean([p.error for p in model.points3D.values() if p.track.length() == 2])
    )


def test_tracks_of_two_images_are_refined_where_those_of_three_make_the_model(
    tmp_path: Path,
) -> None:
    write_many_short_tracks(tmp_path / "database.db")
    task = task_with_given_cameras(tmp_path / "database.db")
    (mapped,) = mapper_of("sparse").map(task, tmp_path, 0, lambda _: None)
    model = mapped.reconstruction
    before = bits(model), mean_error_of_two_views(model), model.num_points3D()
    assert mapped.add_last_points is not None
    mapped.add_last_points(mapped.reconstruction)
    assert bits(model) == before[0]
    assert (
        mean_error_of_two_views(model) < 0.95 * before[1]
    )  # they stood where poses were at first
    assert model.num_points3D() >= 0.99 * before[2] > 700


def test_models_are_scored_before_their_last_points(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize(path, noise_px=NOISE_PX, num_rigs=4, num_points3D=120)
    task = task_with_given_cameras(path)
    mapper = mapper_of("sparse")
    unfinished: list[MappedModel] = []

    class Kept:
        options = mapper.options

        def map(self, task: MappingTask, *rest: object) -> list[MappedModel]:
            found = mapper.map(task, *rest)
            unfinished[:] = [
                replace(
                    m,
                    reconstruction=copy.deepcopy(m.reconstruction),
                    add_last_points=None,
                )
                for m in found
            ]
            return list(found)

    (summary,) = map_database(Kept(), task, tmp_path / "sparse", lambda _: None)
    expected = score_images(unfinished[0], task)
    assert summary.probabilities == {
        k: kept_probability(v.probability) for k, v in expected.items()
    }
    written = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert bits(written) == bits(unfinished[0].reconstruction)
    assert written.num_points3D() == summary.num_points3D >= 118
    least = unfinished[0].reconstruction.compute_mean_reprojection_error()
    assert summary.mean_reprojection_error_px <= 1.01 * least
