"""Matches that never move: captions go, everything that moves somewhere stays."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_store import MatchStore, PairMatches
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.stages.stationary import StationaryFilter

SIZE = (960, 640)
CAPTION = np.random.default_rng(1).uniform((100, 590), (500, 620), (40, 2))
SCENE = np.random.default_rng(2).uniform((0, 0), (700, 500), (200, 2))
SCENE_MOTION_PX = np.array([31.0, 17.0])


def stores(
    folder: Path,
    points: list[NDArray[np.float64]],
    sizes: list[tuple[int, int]] | None = None,
) -> tuple[FeatureStore, MatchStore, list[tuple[str, str]]]:
    """Write images whose features of one number are matched with each other."""
    features = FeatureStore(folder / "features.h5")
    matches = MatchStore(folder / "matches.h5")
    names = [f"{k}.jpg" for k in range(len(points))]
    for name, places, size in zip(
        names, points, sizes or [SIZE] * len(points), strict=True
    ):
        ones = np.ones(len(places))
        count = len(places)
        lafs = lafs_from_keypoints(places, 5.0 * ones, 0.0 * ones)
        descriptors = np.ones((count, 8), np.float32) / np.sqrt(8)
        features.write(name, LocalFeatures(lafs, np.float32(ones), descriptors), size)
    pairs = list(combinations(names, 2))
    count = len(points[0])
    indices = np.stack([np.arange(count)] * 2, axis=1)
    scores = np.linspace(0.1, 0.9, count, dtype=np.float32)
    matches.write(PairMatches(pair, indices, scores, count) for pair in pairs)
    return features, matches, pairs


def scans(count: int) -> list[NDArray[np.float64]]:
    jitter = np.random.default_rng(3).uniform(-0.5, 0.5, (count, *CAPTION.shape))
    return [
        np.concatenate([SCENE + k * SCENE_MOTION_PX, CAPTION + jitter[k]])
        for k in range(count)
    ]


STANDS_STILL = StageWarning("camera_stands_still", "matches")


def left_out(num_matches: int, num_pairs: int) -> StageWarning:
    values = {"num_matches": num_matches, "num_pairs": num_pairs}
    return StageWarning("stationary_matches", "matches", values)


def test_caption_is_left_out_and_what_moves_stays(tmp_path: Path) -> None:
    features, matches, pairs = stores(tmp_path, scans(4))
    assert StationaryFilter(features, matches).learn(pairs) == [
        left_out(6 * len(CAPTION), 6)
    ]
    for found in matches.read(pairs):
        assert found.indices.tolist() == [[k, k] for k in range(len(SCENE))]
        assert found.scores[-1] == pytest.approx(0.1 + 0.8 * 199 / 239, abs=0.01)
        assert found.num_keypoints1 == len(SCENE) + len(CAPTION)
    assert StationaryFilter(features, matches).learn(pairs) == []


def test_captions_of_large_photographs_stand_still_though_they_are_some_pixels_off(
    tmp_path: Path,
) -> None:
    """Features were found in photographs that had been shrunk."""
    large = (4 * SIZE[0], 4 * SIZE[1])
    points = [4.0 * scan for scan in scans(4)]
    features, matches, pairs = stores(tmp_path, points, [large] * 4)
    assert StationaryFilter(features, matches).learn(pairs) == [
        left_out(6 * len(CAPTION), 6)
    ]


def test_of_a_watermark_all_over_only_what_does_not_move_is_left_out(
    tmp_path: Path,
) -> None:
    marks = np.stack(
        np.meshgrid(np.arange(30, 960, 60), np.arange(30, 640, 60)), -1
    ).reshape(-1, 2)
    scene = np.random.default_rng(4).uniform((0, 0), SIZE, (3, 4000, 2))
    points = [np.concatenate([marks + 0.1 * k, scene[k]]) for k in range(3)]
    features, matches, pairs = stores(tmp_path, points)
    assert StationaryFilter(features, matches).learn(pairs)
    for found in matches.read(pairs):
        is_mark = found.indices[:, 0] < len(marks)
        assert not is_mark.any()
        assert np.count_nonzero(~is_mark) > 0.95 * 4000


def test_pair_that_is_matched_later_is_filtered_by_what_is_known(
    tmp_path: Path,
) -> None:
    features, matches, pairs = stores(tmp_path, scans(4))
    given = next(matches.read(pairs))
    StationaryFilter(features, matches).learn(pairs)
    again = StationaryFilter(features, MatchStore(matches.path)).without_stationary(
        given
    )
    assert len(again.indices) == len(SCENE)


def test_match_of_equal_letters_at_two_places_of_a_caption_is_left_out(
    tmp_path: Path,
) -> None:
    """It moves, as a match of the scene does, but both of its ends are where nothing moves."""
    features, matches, pairs = stores(tmp_path, scans(4))
    given = next(matches.read(pairs))
    StationaryFilter(features, matches).learn(pairs)
    swapped = given.indices.copy()
    swapped[len(SCENE) :, 1] = swapped[: len(SCENE) - 1 : -1, 1]
    to_caption = replace(given, indices=np.roll(given.indices, len(CAPTION), axis=0))
    to_caption.indices[:, 0] = given.indices[
        :, 0
    ]  # from the scene to the caption and back
    again = StationaryFilter(features, MatchStore(matches.path))
    assert len(
        again.without_stationary(replace(given, indices=swapped)).indices
    ) == len(SCENE)
    kept = again.without_stationary(to_caption).indices
    assert len(kept) == len(SCENE) + len(CAPTION)


def test_call_that_was_killed_is_repeated_to_the_same_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    features, matches, pairs = stores(tmp_path, scans(4))
    write = MatchStore.write
    written = list[str]()

    def killed(store: MatchStore, found: list[PairMatches]) -> None:
        if len(written) == 4:
            raise KeyboardInterrupt
        written.append(str(found[0].names))
        write(store, found)

    with monkeypatch.context() as patch:
        patch.setattr(MatchStore, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            StationaryFilter(features, matches).learn(pairs)
    assert StationaryFilter(features, matches).learn(pairs) == [
        left_out(2 * len(CAPTION), 2)
    ]
    assert all(len(found.indices) == len(SCENE) for found in matches.read(pairs))


def test_two_images_are_too_little_evidence(tmp_path: Path) -> None:
    features, matches, pairs = stores(tmp_path, scans(2))
    assert StationaryFilter(features, matches).learn(pairs) == []
    assert all(len(found.indices) == 240 for found in matches.read(pairs))


def turned(points: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Photograph points around the origin after they, or the camera, turned about it."""
    c = np.cos(np.deg2rad(degrees))
    s = np.sin(np.deg2rad(degrees))
    x, y, z = (points @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])).T
    noise = np.random.default_rng(int(degrees) + 100).normal(0.0, 0.2, (len(points), 2))
    return (
        np.stack([480 + 1100 * x / (z + 4), 320 + 1100 * y / (z + 4)], axis=1) + noise
    )


@pytest.mark.parametrize(
    "depth", [0.0, 0.1, 0.5], ids=["a plane", "a relief", "an object"]
)
def test_what_a_camera_turns_about_is_kept(tmp_path: Path, depth: float) -> None:
    """In the middle of all photographs motions are small, but not to the pixel."""
    spread = np.random.default_rng(5).uniform(-1, 1, (1200, 3)) * (1.2, 0.9, depth)
    orbit = [turned(spread, degrees) for degrees in range(-25, 26, 10)]
    features, matches, pairs = stores(tmp_path, orbit)
    filtered = StationaryFilter(features, matches)
    assert filtered.learn(pairs) == []
    assert all(len(found.indices) == 1200 for found in matches.read(pairs))


def turntable(
    count: int, num_behind: int = 600
) -> tuple[list[NDArray[np.float64]], int]:
    """Photographs of an object that turns before a still camera; how many points it has."""
    shape = np.random.default_rng(5).uniform(-0.6, 0.6, (200, 3))
    behind = np.random.default_rng(6).uniform((0, 0), SIZE, (num_behind, 2))
    behind = behind[np.linalg.norm(behind - (480, 320), axis=1) > 300]
    jitter = np.random.default_rng(7).normal(0.0, 0.2, (count, *behind.shape))
    views = [turned(shape, 12.0 * k) for k in range(count)]
    return [np.concatenate([views[k], behind + jitter[k]]) for k in range(count)], len(
        shape
    )


def test_background_of_an_object_that_turns_before_a_still_camera_is_left_out(
    tmp_path: Path,
) -> None:
    points, num = turntable(6)
    features, matches, pairs = stores(tmp_path, points)
    (warning,) = StationaryFilter(features, matches).learn(pairs)
    assert warning.code == "stationary_matches"
    for found in matches.read(pairs):
        of_object = found.indices[:, 0] < num
        assert np.count_nonzero(of_object) > 0.9 * num
        assert np.count_nonzero(~of_object) < 0.02 * len(points[0])


def test_what_begins_or_ends_on_the_background_of_a_pair_is_left_out(
    tmp_path: Path,
) -> None:
    """As of windows that look alike, or of something on the object that looks like one."""
    points, num = turntable(6, 2000)
    features, matches, pairs = stores(tmp_path, points)
    random = np.random.default_rng(10)
    for found in list(matches.read(pairs)):
        behind = random.choice(np.arange(num, len(points[0])), (60, 2), replace=False)
        behind[:20, 1] = random.choice(num, 20, replace=False)
        indices = np.concatenate([found.indices, behind])
        scores = np.full(len(indices), 0.5, np.float32)
        matches.write([replace(found, indices=indices, scores=scores)])
    StationaryFilter(features, matches).learn(pairs)
    for found in matches.read(pairs):
        are_of_object = (found.indices < num).all(axis=1)
        assert np.count_nonzero(are_of_object) > 0.9 * num
        assert np.count_nonzero(~are_of_object) < 0.2 * 60


def test_what_stands_still_is_left_out_of_later_matches_anywhere(
    tmp_path: Path,
) -> None:
    """Other features lie at other places, where nothing was seen that does not move."""
    points, num = turntable(6)
    hidden = np.array([[470.0, 30.0], [300.0, 610.0]])
    points = [np.concatenate([one, hidden]) for one in points]
    features, matches, pairs = stores(tmp_path, points)
    all_matched = list(matches.read(pairs))
    for found in all_matched:
        matches.write(
            [replace(found, indices=found.indices[:-2], scores=found.scores[:-2])]
        )
    StationaryFilter(features, matches).learn(pairs)
    again = StationaryFilter(features, MatchStore(matches.path))
    for found in all_matched:
        left = again.without_stationary(found).indices[:, 0]
        assert left.max() < num
        assert len(left) > 0.9 * num


def test_background_of_a_photograph_that_is_gone_is_forgotten(tmp_path: Path) -> None:
    points, _ = turntable(6)
    features, matches, pairs = stores(tmp_path, points)
    StationaryFilter(features, matches).learn(pairs)
    known = [name for name, _ in matches.state.backgrounds]
    matches.remove(images=["2.jpg"])
    left = [name for name, _ in matches.state.backgrounds]
    assert set(known) - set(left) == {"2.jpg"}
    assert matches.state.still_cameras == (SIZE,)


def test_background_ties_photographs_from_elsewhere(tmp_path: Path) -> None:
    """Something turns before a tripod, and the same background is seen from another place."""
    points, _ = turntable(6, 2000)
    elsewhere = points[0] * (1.05, 1.0) + SCENE_MOTION_PX
    features, matches, pairs = stores(tmp_path, [*points, elsewhere])
    StationaryFilter(features, matches).learn(pairs)
    for found in matches.read(pairs):
        if found.names[1] == "6.jpg":
            assert len(found.indices) == len(points[0])


def test_where_nothing_else_moves_nothing_is_left_out_and_is_said(
    tmp_path: Path,
) -> None:
    features, matches, pairs = stores(tmp_path, [np.concatenate([SCENE, CAPTION])] * 6)
    assert StationaryFilter(features, matches).learn(pairs) == [STANDS_STILL]
    assert all(len(found.indices) == 240 for found in matches.read(pairs))


def test_wrong_matches_of_a_still_camera_are_no_object_that_moves(
    tmp_path: Path,
) -> None:
    random = np.random.default_rng(8)
    anywhere = [random.uniform((720, 0), SIZE, (60, 2)) for _ in range(6)]
    points = [np.concatenate([SCENE, one]) for one in anywhere]
    features, matches, pairs = stores(tmp_path, points)
    assert StationaryFilter(features, matches).learn(pairs) == [STANDS_STILL]
    assert all(len(found.indices) == 260 for found in matches.read(pairs))


def test_photographs_from_one_place_among_others_keep_what_ties_them(
    tmp_path: Path,
) -> None:
    """Six of a tripod, two of another: pairs of both kinds keep all their matches."""
    moved = SCENE * (1.05, 1.0) + SCENE_MOTION_PX
    features, matches, pairs = stores(tmp_path, [SCENE] * 6 + [moved] * 2)
    StationaryFilter(features, matches).learn(pairs)
    assert all(len(found.indices) == len(SCENE) for found in matches.read(pairs))


@pytest.mark.parametrize("shift_px", [0.0, 1.5])
def test_caption_of_sheets_that_were_laid_anew_is_left_out(
    tmp_path: Path, shift_px: float
) -> None:
    random = np.random.default_rng(9)
    points = []
    for k, scan in enumerate(scans(5)):
        from_centre = scan[len(SCENE) :] - (480, 320)
        turn = np.deg2rad(random.uniform(-0.1, 0.1))
        laid = turn * np.stack([-from_centre[:, 1], from_centre[:, 0]], axis=1)
        laid += random.uniform(-shift_px, shift_px, 2)
        points.append(
            np.concatenate([SCENE + k * SCENE_MOTION_PX, scan[len(SCENE) :] + laid])
        )
    features, matches, pairs = stores(tmp_path, points)
    assert StationaryFilter(features, matches).learn(pairs)
    for found in matches.read(pairs):
        num_left = np.count_nonzero(found.indices[:, 0] >= len(SCENE))
        assert num_left <= 2
        assert len(found.indices) - num_left == len(SCENE)


def test_place_where_other_pairs_move_is_kept(tmp_path: Path) -> None:
    """The centre of a turn stands still in some pairs, and features pass it in others."""
    turned = [np.concatenate([SCENE, CAPTION])]
    for k in range(1, 7):
        moved = SCENE + k * SCENE_MOTION_PX
        moved[:40] = (
            SCENE[:40] if k < 4 else moved[:40]
        )  # four images agree there, three do not
        turned.append(np.concatenate([moved, CAPTION + 9.0 * k]))
    features, matches, pairs = stores(tmp_path, turned)
    assert StationaryFilter(features, matches).learn(pairs) == []


def test_photographs_of_other_sizes_are_left_alone(tmp_path: Path) -> None:
    sizes = [SIZE, (640, 960), (961, 640), (960, 641)]
    features, matches, pairs = stores(tmp_path, scans(4), sizes)
    assert StationaryFilter(features, matches).learn(pairs) == []
