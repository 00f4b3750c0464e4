"""Verification by significance, on pairs whose frames are known and asymmetric."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import write_images
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    open_database,
    unverified_pairs,
    write_matches,
)
from colmap_affrect.colmap.database_verification import (
    verified_pairs,
    verify,
    verify_pairs,
)
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.colmap.verification import (
    Side,
    VerificationOptions,
    estimate_geometry,
    max_error_px,
    two_view_options,
)
from colmap_affrect.geometry.affine import project, rotation, transform_lafs
from colmap_affrect.geometry.parallax import text_line_matches

Array = NDArray[np.float64]
Frames = tuple[Array, Array]
"""(N, 2, 3) local affine frames of both images."""

SIZE = (640, 480)
K = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])
HOMOGRAPHY = np.array([[0.5, -0.6, 250.0], [0.8, 0.45, -90.0], [3e-4, -2e-4, 1.0]])


def camera(camera_id: int, scale: float = 1.0) -> pycolmap.Camera:
    size = [round(scale * side) for side in SIZE]
    found = pycolmap.Camera.create_from_model_name(
        camera_id, "PINHOLE", scale * 700, *size
    )
    found.has_prior_focal_length = True
    return found


def plane_homography(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Image 2 from image 1 of a plane; the camera turns, rolls by 40 degrees and moves."""
    turn = np.array([[0.94, 0.0, 0.342], [0.0, 1.0, 0.0], [-0.342, 0.0, 0.94]])
    roll = np.eye(3)
    roll[:2, :2] = rotation(np.deg2rad(40.0))
    motion = roll @ turn
    return K @ (motion - np.outer((-1.2, 0.3, 0.2), normal)) @ np.linalg.inv(K)


def frames_of(homographies: list[Array], num: int, seed: int) -> Frames:
    """Frames of image 1 at random, and those of image 2 that truly belong to them."""
    rng = np.random.default_rng(seed)
    lafs = np.zeros((num, 2, 3))
    stretch = rng.uniform(2.0, 6.0, (num, 1, 2))
    lafs[:, :, :2] = rotation(rng.uniform(0, 2 * np.pi, num)) * stretch
    lafs[:, :, 2] = rng.uniform((60, 50), (580, 430), (num, 2))
    parts = np.array_split(lafs, len(homographies))
    seen = [
        transform_lafs(h, part) for h, part in zip(homographies, parts, strict=True)
    ]
    return lafs, np.concatenate(seen)


def rows(lafs: NDArray[np.float64], columns: int = 6) -> NDArray[np.float32]:
    """Keypoints as in a database."""
    shapes = lafs[:, :, :2].reshape(-1, 4)
    if columns == 4:  # size and direction of the first axis
        shapes = np.stack(
            [
                np.hypot(shapes[:, 0], shapes[:, 2]),
                np.arctan2(shapes[:, 2], shapes[:, 0]),
            ],
            axis=1,
        )
    return np.concatenate([lafs[:, :, 2], shapes[:, : columns - 2]], axis=1).astype(
        np.float32
    )


def weak_pair(*, frames_agree: bool, planar: bool = False) -> Frames:
    """28 right matches among 130; their positions alone are too few."""
    homographies = [HOMOGRAPHY]
    if not planar:
        near = plane_homography(np.array((0.05, 0.02, 0.2)))
        homographies = [near, plane_homography(np.array((-0.1, 0.1, 0.3)))]
    first, second = frames_of(homographies, 28, 1)
    other1, other2 = frames_of([HOMOGRAPHY], 102, 2)
    other2[:, :, 2] = np.random.default_rng(3).uniform((0, 0), SIZE, (102, 2))
    if not frames_agree:
        turns = rotation(np.random.default_rng(6).uniform(0, 2 * np.pi, 28))
        second[:, :, :2] = turns @ second[:, :, :2]
    return np.concatenate([first, other1]), np.concatenate([second, other2])


def sides_of(frames: Frames, columns: int = 6) -> tuple[Side, Side]:
    """Both images of a pair, with their frames as keypoints."""
    first, second = frames
    return Side(camera(1), rows(first, columns)), Side(camera(2), rows(second, columns))


def row_by_row(count: int) -> NDArray[np.int64]:
    """Matches of each keypoint of one image with the same one of the other image."""
    numbers = np.arange(count)
    return np.stack([numbers, numbers], axis=1)


def num_inliers(frames: Frames, columns: int = 6, **options: float) -> int:
    matches = row_by_row(len(frames[0]))
    geometry = estimate_geometry(
        sides_of(frames, columns), matches, VerificationOptions(**options)
    )
    return len(geometry.inlier_matches)


@pytest.mark.long
@pytest.mark.parametrize("planar", [False, True])
def test_frames_decide_where_positions_do_not(planar: bool) -> None:
    # With a plane the epipolar geometry is arbitrary: only its homography can agree.
    right = weak_pair(frames_agree=True, planar=planar)
    wrong = weak_pair(frames_agree=False, planar=planar)
    by_colmap = VerificationOptions().min_num_inliers
    assert num_inliers(right, min_significance=0.0) >= by_colmap
    assert num_inliers(wrong, min_significance=0.0) == num_inliers(
        right, min_significance=0.0
    )
    limit = 60.0 if planar else 5.0
    assert num_inliers(right, min_significance=limit) >= by_colmap
    assert num_inliers(wrong, min_significance=limit) == 0


@pytest.mark.parametrize("frames_agree", [True, False])
def test_homography_is_judged_where_epipolar_lines_are_not_significant(
    frames_agree: bool,
) -> None:
    # Lines through 22 matches of a strongly tilted plane hold others of the 180 by chance.
    tilted = np.array([[0.33, 0.12, 180.0], [-0.1, 0.95, 40.0], [-5e-4, 1e-4, 1.0]])
    first, second = frames_of([tilted], 22, 11)
    other1, other2 = frames_of([tilted], 158, 12)
    rng = np.random.default_rng(13)
    other2[:, :, 2] = rng.uniform((0, 0), SIZE, (158, 2))
    other2[:, :, :2] = rotation(rng.uniform(0, 2 * np.pi, 158)) @ other2[:, :, :2]
    second[:, :, 2] += rng.normal(0.0, 0.7, (22, 2))
    if not frames_agree:
        second[:, :, :2] = rotation(rng.uniform(0, 2 * np.pi, 22)) @ second[:, :, :2]
    frames = np.concatenate([first, other1]), np.concatenate([second, other2])
    sides = sides_of(frames)

    def estimated(**options: float) -> pycolmap.TwoViewGeometry:
        return estimate_geometry(sides, row_by_row(180), VerificationOptions(**options))

    lines = estimated(min_significance=0.0)
    plane = estimated(min_significance=30.0)
    assert lines.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    if not frames_agree:
        assert len(plane.inlier_matches) == 0
        return
    assert plane.config == pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC
    inliers = np.asarray(plane.inlier_matches, np.int64)
    assert len(lines.inlier_matches) > len(inliers) >= 20
    assert (inliers < 22).all()
    np.testing.assert_allclose(
        project(plane.H, first[:, :, 2]), second[:, :, 2], atol=6.0
    )
    assert (
        len(estimated(min_significance=30.0, min_inlier_ratio=0.13).inlier_matches) == 0
    )


@pytest.mark.long
def test_database_without_shapes_needs_more_inliers() -> None:
    frames = weak_pair(frames_agree=True)
    assert num_inliers(frames, min_significance=5.0) > 0
    assert num_inliers(frames, columns=4, min_significance=5.0) > 0
    assert num_inliers(frames, columns=2, min_significance=5.0) == 0
    upright = [lafs.copy() for lafs in frames]
    for lafs in upright:
        lafs[:, :, :2] = 3.0 * np.eye(2)
    assert num_inliers((upright[0], upright[1]), min_significance=5.0) == 0
    many = (
        np.concatenate([frames[0], frames[0]]),
        np.concatenate([frames[1], frames[1]]),
    )
    assert num_inliers(many, columns=2, min_significance=5.0) > 0


def write_pairs(path: Path) -> None:
    """Write images 1 to 4: a right pair (1, 2) and a wrong one (3, 4)."""
    right = weak_pair(frames_agree=True)
    wrong = weak_pair(frames_agree=False)
    with open_database(path) as database:
        write_images(database, camera(1), "1234")
        for image_id, lafs in enumerate((*right, *wrong), 1):
            database.write_keypoints(image_id, rows(lafs))
        same = row_by_row(len(right[0]))
        for pair in ((1, 2), (3, 4)):
            write_matches(database, *pair, same)


def test_rejected_pair_is_done_and_not_verified(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    calls = []
    write_pairs(path)
    assert unverified_pairs(path).tolist() == [[1, 2], [3, 4]]
    verify(path, VerificationOptions(min_significance=5.0), advance=calls.append)
    assert list(verified_pairs(path, 1)) == [(1, 2)]
    assert unverified_pairs(path).tolist() == []
    assert sum(calls) == 2
    verify(path, VerificationOptions(min_significance=0.0))
    assert list(verified_pairs(path, 1)) == [(1, 2)]


def test_pairs_before_an_interruption_are_judged_and_the_others_come_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    options = VerificationOptions(min_significance=5.0)
    write_pairs(path)

    def interrupted(
        sides: tuple[Side, Side], *given: object
    ) -> pycolmap.TwoViewGeometry:
        if np.array_equal(sides[1].keypoints, last):
            raise KeyboardInterrupt
        return estimate_geometry(sides, *given)

    with open_database(path) as database:
        last = database.read_keypoints(4)
    with monkeypatch.context() as patched:
        patched.setattr(
            "colmap_affrect.colmap.database_verification.estimate_geometry",
            interrupted,
        )
        patched.setattr(
            "colmap_affrect.colmap.database_verification.PAIRS_PER_WRITE", 1
        )
        with pytest.raises(KeyboardInterrupt):
            verify(path, options)
    assert unverified_pairs(path).tolist() == [[3, 4]]
    verify(path, options)
    assert list(verified_pairs(path, 1)) == [(1, 2)]


class Elsewhere:
    """An executor that sends functions, tasks and results as a cluster does."""

    def map(
        self,
        function: Callable[[Any], Any],
        tasks: Iterable[Any],
        files: Sequence[Path] = (),
    ) -> Iterator[Any]:
        assert not files
        for task in tasks:
            there = pickle.loads(pickle.dumps(function))
            result = there(pickle.loads(pickle.dumps(task)))
            yield pickle.loads(pickle.dumps(result))


def test_verification_elsewhere_leaves_what_threads_here_leave(tmp_path: Path) -> None:
    options = VerificationOptions(min_significance=5.0)
    digests = []
    for name, executor in (("here", None), ("elsewhere", Elsewhere())):
        path = tmp_path / f"{name}.db"
        write_pairs(path)
        with open_database(path) as database:
            todo = np.array([[1, 2], [3, 4]])
            verify_pairs(database, todo, options, executor=executor)
        assert list(verified_pairs(path, 1)) == [(1, 2)]
        digests.append(rows_digest(path))
    assert digests[0] == digests[1]


def test_preset_colmap_writes_what_pycolmap_does(tmp_path: Path) -> None:
    paths = [tmp_path / "ours.db", tmp_path / "theirs.db"]
    for path in paths:
        write_pairs(path)
    options = VerificationOptions.preset("colmap", max_num_trials=300)
    verify(paths[0], options)
    pycolmap.geometric_verification(
        paths[1], two_view_geometry_options=two_view_options(options)
    )
    found = []
    for path in paths:
        with open_database(path) as database:
            found.append(
                [database.read_two_view_geometry(*pair) for pair in ((1, 2), (3, 4))]
            )
    for ours, theirs in zip(*found, strict=True):
        assert ours.config == theirs.config
        np.testing.assert_array_equal(ours.inlier_matches, theirs.inlier_matches)
        np.testing.assert_array_equal(ours.E, theirs.E)


def test_threshold_grows_with_photographs_that_were_shrunk() -> None:
    options = VerificationOptions(max_error_px=3.0)
    cameras = (camera(1, 2.5), camera(2))
    assert max_error_px(cameras, options, None) == 3.0
    assert max_error_px(cameras, options, 640) == pytest.approx(3.0 * (2.5 + 1.0) / 2)
    assert max_error_px(cameras, options, 6400) == 3.0
    colmap = VerificationOptions.preset("colmap", max_error_px=3.0)
    assert max_error_px(cameras, colmap, 640) == 3.0


def with_caption(frames: Frames) -> Frames:
    """Add forty matches of print below, which is a little larger and elsewhere in image 2."""
    lafs, _ = frames_of([np.eye(3)], 40, 11)
    lafs[:, :, 2] = np.random.default_rng(12).uniform((200, 440), (350, 446), (40, 2))
    moved = transform_lafs(
        np.array([[1.05, 0.02, 60.0], [-0.02, 1.05, -390.0], [0, 0, 1]]), lafs
    )
    return np.concatenate([frames[0], lafs]), np.concatenate([frames[1], moved])


def test_writing_at_another_place_ties_no_pair_and_leaves_none() -> None:
    normals = (0.05, 0.02, 0.2), (-0.1, 0.1, 0.3)
    scene = frames_of([plane_homography(np.array(n)) for n in normals], 80, 1)
    wrong = np.random.default_rng(3).permutation(80)
    unrelated = scene[0], scene[1][wrong]
    for frames, expected in (scene, 80), (unrelated, 0):
        sides = sides_of(with_caption(frames))
        matches = row_by_row(120)
        found = estimate_geometry((sides[0], sides[1]), matches, VerificationOptions())
        inliers = np.asarray(found.inlier_matches).reshape(-1, 2)[:, 0]
        assert (inliers < 80).sum() >= 0.95 * expected
        assert (
            inliers >= 80
        ).sum() <= 4  # those that the epipolar geometry explains by chance
        accepted = estimate_geometry(
            (sides[0], sides[1]), matches, VerificationOptions(min_significance=0.0)
        )
        assert len(accepted.inlier_matches) >= 40


def test_a_tenth_of_the_matches_on_a_ledge_are_no_writing() -> None:
    plane = np.array([[0.9, 0.0, 40.0], [0.02, 0.95, 20.0], [4e-4, 3e-4, 1.0]])
    scene = frames_of([plane], 80, 1)
    ledge, _ = frames_of([np.eye(3)], 12, 11)
    ledge[:, 0, 2] = np.linspace(300.0, 400.0, 12)
    ledge[:, 1, 2] = 250.0
    lafs1 = np.concatenate([scene[0], ledge])
    lafs2 = np.concatenate([scene[1], transform_lafs(plane, ledge)])
    sizes = ((640, 480), (640, 480))
    written = text_line_matches(lafs1[:, :, 2], lafs2[:, :, 2], sizes)
    assert written[80:].all()
    assert written.mean() < 0.15
    sides = sides_of((lafs1, lafs2))
    found = estimate_geometry(
        (sides[0], sides[1]), row_by_row(92), VerificationOptions()
    )
    assert len(found.inlier_matches) == 92


def search_for(
    frames: Frames, monkeypatch: pytest.MonkeyPatch, columns: int = 6, **options: float
) -> pycolmap.RANSACOptions:
    """What COLMAP is asked for to verify a pair."""
    asked = list[pycolmap.RANSACOptions]()

    def without_trials(*given: object) -> pycolmap.TwoViewGeometry:
        search = given[-1]
        assert isinstance(search, pycolmap.TwoViewGeometryOptions)
        asked.append(search.ransac)
        return pycolmap.TwoViewGeometry()

    monkeypatch.setattr(pycolmap, "estimate_two_view_geometry", without_trials)
    num_inliers(frames, columns, **options)
    (search,) = asked
    return search


def trials_for(
    frames: Frames, monkeypatch: pytest.MonkeyPatch, columns: int = 6, **options: float
) -> int:
    """Most trials that COLMAP is asked for to verify a pair."""
    return search_for(frames, monkeypatch, columns, **options).max_num_trials


def some_right_matches(num: int, num_wrong: int, seed: int = 0) -> Frames:
    """Frames of a few right matches of one plane, and of wrong ones."""
    first, second = frames_of([HOMOGRAPHY], num, seed + 1)
    other1, other2 = frames_of([HOMOGRAPHY], num_wrong, seed + 2)
    random = np.random.default_rng(seed + 3)
    other2[:, :, 2] = random.uniform((0, 0), SIZE, (num_wrong, 2))
    other2[:, :, :2] = (
        rotation(random.uniform(0, 2 * np.pi, num_wrong)) @ (other2[:, :, :2])
    )
    return np.concatenate([first, other1]), np.concatenate([second, other2])


def test_pairs_without_anything_in_common_are_not_searched_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usual = VerificationOptions().max_num_trials
    for seed in range(0, 30, 10):
        nothing = some_right_matches(0, 70, seed)
        assert trials_for(nothing, monkeypatch) == usual // 100
        something = some_right_matches(20, 50, seed)
        assert trials_for(something, monkeypatch) == usual
    # one of these agrees with its neighbours, and three
    for num_right in (7, 12):
        little = some_right_matches(num_right, 70 - num_right)
        assert trials_for(little, monkeypatch) == usual // 10


def test_the_search_is_as_long_as_asked_where_neighbours_say_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usual = VerificationOptions().max_num_trials
    nothing = some_right_matches(0, 70)
    assert trials_for(nothing, monkeypatch, columns=2) == usual
    assert trials_for(nothing, monkeypatch, min_significance=0.0) == usual
    assert trials_for(nothing, monkeypatch, max_num_trials=50) == 50
    assert trials_for(some_right_matches(0, 310), monkeypatch) == usual
    assert trials_for(some_right_matches(0, 290), monkeypatch) <= usual // 10


def test_the_search_ends_when_its_confidence_is_reached(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def asked(num_matches: int, **options: float) -> tuple[float, float]:
        frames = some_right_matches(num_matches, 0)
        search = search_for(frames, monkeypatch, **options)
        return search.dyn_num_trials_multiplier, search.min_inlier_ratio

    # 15 inliers make a verified pair
    assert asked(50) == (3.0, 0.3)  # few at most
    assert asked(20) == (3.0, 0.5)
    assert asked(125) == (1.0, 0.12)
    assert asked(400) == (1.0, 0.1)
    assert asked(125, ransac_min_inlier_ratio=0.4) == (1.0, 0.4)
    assert asked(125, min_num_inliers=20) == (1.0, 0.16)
    # what COLMAP accepts is looked for as COLMAP does
    assert asked(50, min_significance=0.0) == (3.0, 0.1)


def test_pairs_of_which_a_third_are_inliers_are_verified_with_all_of_them() -> None:
    for seed in range(0, 20, 10):
        frames = some_right_matches(30, 60, seed)
        assert num_inliers(frames) >= 28
