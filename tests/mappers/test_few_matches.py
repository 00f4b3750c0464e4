"""Pairs with few matches: sure where chance does not explain them, and enough for a model."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import (
    model_poses,
    pose_errors,
    read_poses,
    relative_pose,
)
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.mappers import few_matches
from colmap_affrect.mappers.few_matches import (
    MAX_RAW,
    MIN_INLIER_SHARE,
    _ThirdImages,
    sure_few_matches,
)
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.pair_graph import PairGraph

NUM_TARGETS = 14  # fewer than the inliers of a verified pair


def without_geometries(path: Path) -> None:
    with open_database(path) as database:
        database.clear_two_view_geometries()


def targets(path: Path, num_points: int = NUM_TARGETS) -> pycolmap.Reconstruction:
    """Make a database of five photographs of a few targets, matched and not verified."""
    truth = synthesize(path, num_rigs=5, num_points3D=num_points)
    without_geometries(path)
    return truth


def sure_ids(path: Path) -> set[tuple[int, int]]:
    with open_database(path) as database:
        return {one.ids for one in sure_few_matches(database, {})}


def largest_error_deg(folder: Path, truth: pycolmap.Reconstruction) -> float:
    found = read_poses(folder)
    true = model_poses(truth)
    assert found.keys() == true.keys()
    errors = [0.0]
    for first, second in combinations(sorted(found), 2):
        estimated = relative_pose(found[first], found[second])
        errors += pose_errors(estimated, relative_pose(true[first], true[second]))
    return max(errors)


def test_few_targets_that_all_agree_make_a_model(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = targets(path)
    task = task_with_given_cameras(path)
    (model,) = map_database(
        mapper_of("sparse"), task, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 5
    assert largest_error_deg(tmp_path / "sparse" / "0", truth) < 0.5


def change_matches(path: Path, change: dict[tuple[int, int], Indices]) -> None:
    with open_database(path) as database:
        for ids, matches in change.items():
            database.delete_matches(*ids)
            database.write_matches(*ids, matches.astype(np.uint32))


def test_few_matches_drawn_at_random_are_never_sure(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    targets(path, 200)
    drawn = np.random.default_rng(0)
    change = {}
    for ids in combinations(range(1, 6), 2):
        features = [drawn.choice(100, NUM_TARGETS, replace=False) for _ in ids]
        change[ids] = np.stack(features, axis=1)
    change_matches(path, change)
    assert sure_ids(path) == set()


def test_no_more_samples_are_drawn_than_find_what_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    targets(path)
    shares = set[float]()
    estimate = pycolmap.estimate_two_view_geometry

    def estimate_and_note(*arguments: Any) -> pycolmap.TwoViewGeometry:
        shares.add(arguments[-1].ransac.min_inlier_ratio)
        return estimate(*arguments)

    noted = SimpleNamespace(
        estimate_two_view_geometry=estimate_and_note,
        pair_id_to_image_pair=pycolmap.pair_id_to_image_pair,
    )
    monkeypatch.setattr(few_matches, "pycolmap", noted)
    assert len(sure_ids(path)) == 10
    assert shares == {MIN_INLIER_SHARE}


@pytest.mark.parametrize("is_confirmed", [True, False])
def test_seven_matches_are_sure_where_a_third_image_confirms_them(
    tmp_path: Path, *, is_confirmed: bool
) -> None:
    path = tmp_path / "database.db"
    targets(path)
    with open_database(path) as database:
        seven = np.asarray(database.read_matches(1, 2), np.int64)[:7]
    change = {(1, 2): seven}
    if not is_confirmed:
        for other in (3, 4, 5):
            change[1, other] = seven[:0]
    change_matches(path, change)
    assert ((1, 2) in sure_ids(path)) == is_confirmed


@pytest.mark.parametrize(
    ("num_wrong", "is_confirmed"), [(0, True), (1, True), (4, False), (20, False)]
)
def test_a_third_image_may_contradict_a_tenth_of_the_matches_that_it_confirms(
    num_wrong: int, *, is_confirmed: bool
) -> None:
    """The features of each image are in an order of their own."""
    first, second, third = np.random.default_rng(1).permuted(
        np.tile(np.arange(50), (3, 1)), axis=1
    )[:, :20]
    of_third = second.copy()
    of_third[:num_wrong] += 50  # other features of the second image
    matches = {
        (1, 2): np.stack([first, second], axis=1),
        (1, 3): np.stack([first, third], axis=1),
        (2, 3): np.stack([of_third, third], axis=1),
    }
    evidence = _ThirdImages(matches).log10_evidence((1, 2), matches[1, 2])
    num_agreeing = 20 - num_wrong
    choices = math.log10(math.comb(20, num_wrong))  # which of them agree
    expected = num_agreeing * math.log10(20.0) - choices if is_confirmed else 0.0
    assert evidence == pytest.approx(expected)


@pytest.mark.parametrize(("num_wrong", "is_sure"), [(2, True), (6, False)])
def test_of_few_matches_four_fifths_must_agree(
    tmp_path: Path, num_wrong: int, *, is_sure: bool
) -> None:
    path = tmp_path / "database.db"
    targets(path, 24)
    with open_database(path) as database:
        raw = np.asarray(database.read_matches(1, 2), np.int64)
    right = raw[:NUM_TARGETS]
    others = raw[NUM_TARGETS : NUM_TARGETS + num_wrong]
    wrong = np.stack([others[:, 0], np.roll(others[:, 1], 1)], axis=1)
    change_matches(path, {(1, 2): np.concatenate([right, wrong])})
    assert ((1, 2) in sure_ids(path)) == is_sure


def test_of_two_third_images_the_better_one_counts_as_if_chance_had_tried_both() -> (
    None
):
    rows = np.stack([np.arange(10), 9 - np.arange(10)], axis=1)
    same = np.stack([np.arange(10), np.arange(10)], axis=1)
    one = {(1, 2): rows, (1, 3): same, (2, 3): rows[:, ::-1]}
    two = {**one, (1, 4): same, (2, 4): rows[:, ::-1]}
    by_one = _ThirdImages(one).log10_evidence((1, 2), rows)
    assert by_one == pytest.approx(10.0)
    by_two = _ThirdImages(two).log10_evidence((1, 2), rows)
    assert by_two == pytest.approx(10.0 - np.log10(2.0))


def test_chance_matches_any_feature_that_the_second_image_has_in_common_with_the_third() -> (
    None
):
    """The third image has 10 features with the first one, and 40 with the second one."""
    ten = np.stack([np.arange(10), np.arange(10)], axis=1)
    forty = np.stack([np.arange(40), np.arange(40)], axis=1)
    third_images = _ThirdImages({(1, 2): ten, (1, 3): ten, (2, 3): forty})
    expected = 10.0 * math.log10(40.0)
    assert third_images.log10_evidence((1, 2), ten) == pytest.approx(expected)


def test_few_matches_that_chance_explains_are_sure_where_third_images_confirm_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    targets(path, 8)
    monkeypatch.setattr(few_matches, "significance", lambda *_, **__: -20.0)
    assert len(sure_ids(path)) == 10


def test_many_raw_matches_are_not_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    targets(path, MAX_RAW + 1)
    assert sure_ids(path) == set()


def test_tie_points_alone_begin_a_model(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = targets(path, 8)
    tie_points = {}
    for number, point in enumerate(truth.points3D.values()):
        seen = {}
        for element in point.track.elements:
            seen[truth.images[element.image_id].name] = element.point2D_idx
        tie_points[f"T{number}"] = seen
    with open_database(path) as database:
        database.clear_matches()
    assert not PairGraph.read(path).pairs
    with_points = task_with_given_cameras(path, tie_points=tie_points)
    (model,) = map_database(
        mapper_of("sparse"), with_points, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 5
    assert len(model.tie_points) == 5 * 8
    assert largest_error_deg(tmp_path / "sparse" / "0", truth) < 2.0


def test_frames_of_rigs_that_other_images_tie_need_no_few_matches(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    synthesize(
        path,
        num_rigs=1,
        num_cameras_per_rig=2,
        num_frames_per_rig=3,
        num_points3D=NUM_TARGETS,
    )
    without_geometries(path)
    with open_database(path) as database:
        frame_of = {i.image_id: i.frame_id for i in database.read_all_images()}
        all_sure = sure_few_matches(database, {})
        tie = all_sure[0]
        others = sure_few_matches(database, {tie.ids: tie.matches})
    tied = {frame_of[image_id] for image_id in tie.ids}
    frames = [{frame_of[image_id] for image_id in one.ids} for one in others]
    assert len(tied) == 2
    assert len(all_sure) == 3 * 4  # of each two frames two images by two
    assert len(others) == 2 * 4
    assert tied not in frames
