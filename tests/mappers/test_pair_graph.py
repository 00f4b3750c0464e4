"""Graphs of verified pairs, of which mapping takes a part."""

import copy
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from mapping_tasks import synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord, with_shared_cameras
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import model_poses
from colmap_affrect.geometry.arrays import rows_in
from colmap_affrect.mappers import pair_graph, sparse
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.incremental import IncrementalMapper
from colmap_affrect.mappers.pair_graph import (
    PairGraph,
    VerifiedPair,
    _split_by_strength,
    cameras_of,
    compared_with_pose,
    poses_of,
)
from colmap_affrect.mappers.some_tracks import (
    GROWTH_OF_LARGE,
    NEVER,
    SELDOM,
    SOME_TRACKS,
    adjust_seldom,
)
from colmap_affrect.mappers.sparse import SparseMapper, SparseOptions
from colmap_affrect.mappers.thinning import (
    NUM_MATCHES_OF_PAIR,
    NUM_MATCHES_OF_PAIR_OF_LARGE,
    NUM_TRACKS,
    NUM_TRACKS_OF_LARGE,
    OF_LARGE_SETS,
    _ranks,
    matches_of_best_tracks,
)

NUM_IMAGES = 5


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A verified database of five images with a camera each, and with many tracks."""
    path = tmp_path_factory.mktemp("scene") / "database.db"
    synthesize(path, num_rigs=NUM_IMAGES, num_points3D=2500)
    return path


def features_of_pairs(graph: PairGraph) -> dict[int, set[int]]:
    """Return the features that are matched, by image id."""
    found = defaultdict[int, set[int]](set)
    for pair in graph.pairs:
        for image_id, features in zip(pair.ids, pair.matches.T, strict=True):
            found[image_id].update(features.tolist())
    return found


def test_a_thinned_graph_has_enough_matches_of_each_pair_and_image(path: Path) -> None:
    graph = PairGraph.read(path)
    thin = graph.thinned()
    assert [pair.ids for pair in thin.pairs] == [pair.ids for pair in graph.pairs]
    for pair, whole in zip(thin.pairs, graph.pairs, strict=True):
        assert NUM_MATCHES_OF_PAIR <= len(pair.matches) < len(whole.matches) / 2
        assert rows_in(pair.matches, whole.matches).all()
    assert min(map(len, features_of_pairs(thin).values())) >= NUM_TRACKS
    assert thin.thinned() is thin


def test_tracks_of_most_images_come_first_and_ambiguous_ones_last() -> None:
    num_features = np.array([2, 5, 3, 4, 2])
    num_images = np.array([2, 4, 3, 4, 1])  # the second and the last one are ambiguous
    assert _ranks(num_features, num_images).tolist() == [2, 3, 1, 0, 4]


def test_features_say_how_many_tracks_are_left_out_not_matches() -> None:
    # 600 tracks of six images, of which 500 are kept, make ten times as many matches as 900 of two.
    long_tracks = np.repeat(np.arange(600)[:, None], 2, axis=1)
    pairs = [(ids, long_tracks) for ids in combinations(range(6), 2)]
    for first in (0, 2, 4):
        short_tracks = np.repeat(np.arange(600, 1500)[:, None], 2, axis=1)
        ids = first, first + 1
        index = [pair for pair, _ in pairs].index(ids)
        pairs[index] = (ids, np.concatenate([long_tracks, short_tracks]))
    best = matches_of_best_tracks(pairs, dict.fromkeys(range(6), 1500))
    assert best.share_of_features == pytest.approx(500 / 1500)
    num_kept = sum(int(is_kept.sum()) for is_kept in best.is_kept)
    assert num_kept == len(pairs) * NUM_TRACKS
    assert num_kept > sum(map(len, best.is_kept)) / 2


def test_large_sets_have_fewer_tracks_of_each_image_and_pair(path: Path) -> None:
    graph = PairGraph.read(path)
    thin = graph.thinned(OF_LARGE_SETS)
    num_of_small = sum(len(pair.matches) for pair in graph.thinned().pairs)
    assert sum(len(pair.matches) for pair in thin.pairs) < num_of_small / 2
    for pair in thin.pairs:
        assert len(pair.matches) >= NUM_MATCHES_OF_PAIR_OF_LARGE
    assert min(map(len, features_of_pairs(thin).values())) >= NUM_TRACKS_OF_LARGE


def test_large_sets_are_adjusted_seldom_but_as_the_user_says() -> None:
    given = {"ba_global_points_ratio": 1.2}
    native = pycolmap.IncrementalPipelineOptions(ba_global_points_ratio=1.2)
    adjust_seldom(native, given)
    assert native.ba_global_points_ratio == 1.2
    assert native.ba_global_frames_ratio == GROWTH_OF_LARGE
    assert native.ba_global_frames_freq == native.ba_global_points_freq == NEVER
    assert native.ba_local_max_refinements == 1
    assert native.check()


@pytest.mark.parametrize("num_images", [99, 100])
def test_only_large_sets_are_adjusted_seldom_by_colmap(num_images: int) -> None:
    """Also where they are extended, which COLMAP does with small ones, too."""
    mapper = SparseMapper(SparseOptions())
    keypoints = dict.fromkeys(range(num_images), np.zeros((0, 2), np.float32))
    graph = cast("PairGraph", SimpleNamespace(keypoints=keypoints))
    task = MappingTask(Path("database.db"), None)
    native = mapper._native_of_colmap(task, graph, 0)
    usual = mapper.native(task, 0)
    for key in SELDOM:
        assert (getattr(native, key) == getattr(usual, key)) == (num_images == 99)


def test_a_thinned_graph_has_its_tracks_whole(path: Path) -> None:
    graph = PairGraph.read(path)
    thin = graph.thinned()
    kept = features_of_pairs(thin)
    for pair, whole in zip(thin.pairs, graph.pairs, strict=True):
        in_first = np.isin(whole.matches[:, 0], list(kept[whole.ids[0]]))
        in_second = np.isin(whole.matches[:, 1], list(kept[whole.ids[1]]))
        assert (in_first == in_second).all()
        assert in_first.sum() == len(pair.matches)


def test_a_model_of_some_tracks_gets_the_points_of_all(
    path: Path, tmp_path: Path
) -> None:
    (model,) = SparseMapper(SparseOptions()).map(
        task_with_given_cameras(path), tmp_path, 0, lambda _: None
    )
    assert len(model_poses(model.reconstruction)) == NUM_IMAGES
    assert model.reconstruction.num_points3D() > 2000
    assert model.hypotheses[-1] == SOME_TRACKS


def test_colmap_maps_a_large_set_from_some_of_the_tracks(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sparse, "MIN_LARGE_SET", NUM_IMAGES)
    task = task_with_given_cameras(path)
    num_inliers = []
    by_colmap = IncrementalMapper.map_by

    def map_and_count(
        mapper: IncrementalMapper, native: Any, task: MappingTask, **named: Any
    ) -> list[MappedModel]:
        assert native.ba_global_frames_ratio == GROWTH_OF_LARGE
        with open_database(task.database_path) as database:
            num_inliers.append(database.num_inlier_matches())
        return by_colmap(mapper, native, task, **named)

    monkeypatch.setattr(IncrementalMapper, "map_by", map_and_count)
    (model,) = SparseMapper(SparseOptions()).map(task, tmp_path, 0, lambda _: None)
    assert model.hypotheses == (SOME_TRACKS,)
    thin = PairGraph.read(path).thinned(OF_LARGE_SETS)
    assert num_inliers == [sum(len(pair.matches) for pair in thin.verified)]
    assert list(tmp_path.glob("**/*.db")) == []
    num_thin = len(set().union(*features_of_pairs(thin).values()))
    assert len(model_poses(model.reconstruction)) == NUM_IMAGES
    assert model.reconstruction.num_points3D() > 2000 > num_thin
    assert model.add_last_points is not None


def test_pairs_leave_a_graph_and_what_the_mappers_see(path: Path) -> None:
    graph = PairGraph.read(path)
    first, second, third, *others = [pair.ids for pair in graph.pairs]
    less = graph.without([first, third])
    assert [pair.ids for pair in less.pairs] == [second, *others]
    assert (less.pairs[0].matches == graph.pairs[1].matches).all()
    counts = less.cache.correspondence_graph.num_matches_between_all_images()
    assert {
        pycolmap.pair_id_to_image_pair(key): count for key, count in counts.items()
    } == {pair.ids: len(pair.matches) for pair in less.pairs}


def test_images_get_the_cameras_of_records(path: Path) -> None:
    graph = PairGraph.read(path)
    sizes = [(1024, 768)] * 3 + [(768, 1024)] * 2
    records = {
        camera.camera_id: CameraRecord((graph.names[i],), "guess", 1000.0, size=size)
        for (i, camera), size in zip(sorted(graph.cameras.items()), sizes, strict=True)
    }
    shared = with_shared_cameras(records)
    assert len(shared) == 2
    together = graph.with_cameras(shared)
    assert {together.cameras[i].camera_id for i in together.cameras} == shared.keys()
    model = pycolmap.Reconstruction()
    model.load(together.cache)
    assert set(model.cameras) == shared.keys()
    assert len(model.rigs) == 2
    for image in model.images.values():
        assert image.name in shared[image.camera_id].names
    assert len({camera.camera_id for camera in graph.cameras.values()}) == NUM_IMAGES


def test_most_connected_is_the_largest_part(path: Path) -> None:
    graph = PairGraph.read(path)
    assert graph.largest_component == set(graph.keypoints)
    part = set(sorted(graph.keypoints)[:2])
    apart = graph.without(
        [p.ids for p in graph.pairs if len(part.intersection(p.ids)) == 1]
    )
    assert apart.largest_component == set(graph.keypoints) - part
    assert not graph.without([pair.ids for pair in graph.pairs]).largest_component


def test_agreement_of_a_pair_is_computed_anew_where_a_pose_or_a_camera_is_another(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = PairGraph.read(path)
    pair = graph.pairs[0]
    cameras = {key: copy.copy(camera) for key, camera in graph.cameras.items()}
    poses = {key: (np.eye(3), np.array([0.1 * key, 0.0, 1.0])) for key in cameras}
    computed = list[str]()
    compute = pair_graph.compared_with_pose

    def counting(*given: Any) -> Any:
        computed.append("")
        return compute(*given)

    monkeypatch.setattr(pair_graph, "compared_with_pose", counting)
    share = graph.agreement(pair, poses, cameras)
    assert graph.agreement(pair, dict(poses), cameras) == share
    assert len(computed) == 1
    first = pair.ids[0]
    poses[first] = poses[first][0], poses[first][1] + 1e-12
    graph.agreement(pair, poses, cameras)
    assert len(computed) == 2
    cameras[first].params *= 1.5
    graph.agreement(pair, poses, cameras)
    assert len(computed) == 3
    graph.agreement(replace(pair, matches=pair.matches[:50]), poses, cameras)
    assert len(computed) == 4


def shifted(graph: PairGraph, distance_px: float) -> PairGraph:
    """Move all keypoints by so many px, in all directions."""
    random = np.random.default_rng(1)
    keypoints = {}
    for image_id, points in graph.keypoints.items():
        angles = random.uniform(0, 2 * np.pi, len(points))
        shifts = distance_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        keypoints[image_id] = (points + shifts).astype(np.float32)
    return replace(graph, keypoints=keypoints)


def enlarged(model: pycolmap.Reconstruction, factor: float) -> pycolmap.Reconstruction:
    """Return a copy of a model of images so many times as large."""
    large = pycolmap.Reconstruction(model)
    for camera in large.cameras.values():
        camera.rescale(factor)
    return large


def lowest_agreement(graph: PairGraph, model: pycolmap.Reconstruction) -> float:
    poses = poses_of(model)
    cameras = cameras_of(model)
    return min(graph.agreement(pair, poses, cameras) for pair in graph.pairs)


def test_matches_agree_that_are_a_few_pixels_off_their_epipolar_lines(
    tmp_path: Path,
) -> None:
    model = synthesize(tmp_path / "database.db", num_rigs=3, num_points3D=300)
    graph = PairGraph.read(tmp_path / "database.db")
    assert lowest_agreement(shifted(graph, 3.0), model) > 0.9
    assert lowest_agreement(shifted(graph, 60.0), model) < 0.3


def test_a_pose_explains_matches_of_cameras_with_other_focal_lengths() -> None:
    wide = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480)
    narrow = pycolmap.Camera.create_from_model_name(
        2, "SIMPLE_PINHOLE", 1500.0, 640, 480
    )
    points = np.random.default_rng(2).uniform((-1, -1, 9), (1, 1, 12), (50, 3))
    rotation = pycolmap.Rotation3d(np.array([0.03, -0.05, 0.1])).matrix()
    translation = np.array([0.8, 0.3, 0.1])
    there = points @ rotation.T + translation
    seen = wide.img_from_cam(points), narrow.img_from_cam(there)
    pose = rotation, translation / np.linalg.norm(translation)
    found = compared_with_pose(pose, (wide, narrow), seen)
    assert found.errors_px.max() < 1e-6
    assert found.agrees.all()
    length = np.linalg.norm(translation)
    np.testing.assert_allclose(found.depths.first, points[:, 2] / length)
    np.testing.assert_allclose(found.depths.second, there[:, 2] / length)


def test_in_large_images_matches_may_be_farther_off(tmp_path: Path) -> None:
    model = synthesize(tmp_path / "database.db", num_rigs=3, num_points3D=300)
    graph = PairGraph.read(tmp_path / "database.db")
    keypoints = {i: 4.0 * points for i, points in graph.keypoints.items()}
    large, model = replace(graph, keypoints=keypoints), enlarged(model, 4.0)  # 4096 px
    assert lowest_agreement(shifted(large, 9.0), model) > 0.9
    assert lowest_agreement(shifted(large, 200.0), model) < 0.3


def test_only_the_strongest_pairs_of_an_image_score_models(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db", num_rigs=20, num_points3D=40)
    graph = PairGraph.read(tmp_path / "database.db")
    counts = Counter(image_id for pair in graph.pairs for image_id in pair.ids)
    assert min(counts.values()) == 15
    assert graph.unscored
    assert len(graph.verified) == 190


def test_a_pair_scores_models_that_is_among_the_strongest_of_one_of_its_images() -> (
    None
):
    matches = np.zeros((20, 2), np.int64)
    geometry = pycolmap.TwoViewGeometry()
    star = [VerifiedPair((1, leaf), matches, geometry) for leaf in range(2, 22)]
    scored, unscored = _split_by_strength(star)
    assert len(scored) == 20
    assert not unscored


def test_pairs_of_fewer_than_fifteen_inliers_are_left_out(tmp_path: Path) -> None:
    for num_points in (14, 16):
        path = tmp_path / f"{num_points}.db"
        synthesize(path, num_rigs=2, num_points3D=num_points)
        with open_database(path) as database:
            database.clear_matches()  # which would say whether a few are sure
        assert len(PairGraph.read(path).pairs) == (num_points > 15)
