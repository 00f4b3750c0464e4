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
from colmap_affrect.project.stores import FeatureStore, MatchStore, PairMatches
from colmap_affrect.stages.stationary import StationaryFilter

SIZE = (960, 640)
CAPTION = np.random.default_rng(1).uniform((100, 590), (500, 620), (40, 2))
SCENE = np.random.default_rng(2).uniform((0, 0), (700, 500), (200, 2))
SCENE_MOTION_PX = np.array([31.0, 17.0])


def stores(
    folder: Path, points: list[NDArray[np.float64]], sizes: list[tuple[int, int]] | None = None
) -> tuple[FeatureStore, MatchStore, list[tuple[str, str]]]:
    """Write images whose features of one number are matched with each other."""
    features, matches = FeatureStore(folder / "features.h5"), MatchStore(folder / "matches.h5")
    names = [f"{k}.jpg" for k in range(len(points))]
    for name, places, size in zip(names, points, sizes or [SIZE] * len(points), strict=True):
        ones, count = np.ones(len(places)), len(places)
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
        np.concatenate([SCENE + k * SCENE_MOTION_PX, CAPTION + jitter[k]]) for k in range(count)
    ]


def test_caption_is_left_out_and_what_moves_stays(tmp_path: Path) -> None:
    features, matches, pairs = stores(tmp_path, scans(4))
    line = StationaryFilter(features, matches).learn(pairs)
    assert line.startswith(f"{6 * len(CAPTION)} matches of 6 pairs never move")
    for found in matches.read(pairs):
        assert found.indices.tolist() == [[k, k] for k in range(len(SCENE))]
        assert found.scores[-1] == pytest.approx(0.1 + 0.8 * 199 / 239, abs=0.01)
        assert found.num_keypoints1 == len(SCENE) + len(CAPTION)
    assert StationaryFilter(features, matches).learn(pairs) == ""


def test_of_a_watermark_all_over_only_what_does_not_move_is_left_out(tmp_path: Path) -> None:
    marks = np.stack(np.meshgrid(np.arange(30, 960, 60), np.arange(30, 640, 60)), -1).reshape(-1, 2)
    scene = np.random.default_rng(4).uniform((0, 0), SIZE, (3, 4000, 2))
    points = [np.concatenate([marks + 0.1 * k, scene[k]]) for k in range(3)]
    features, matches, pairs = stores(tmp_path, points)
    assert StationaryFilter(features, matches).learn(pairs)
    for found in matches.read(pairs):
        is_mark = found.indices[:, 0] < len(marks)
        assert not is_mark.any()
        assert np.count_nonzero(~is_mark) > 0.95 * 4000


def test_pair_that_is_matched_later_is_filtered_by_what_is_known(tmp_path: Path) -> None:
    features, matches, pairs = stores(tmp_path, scans(4))
    given = next(matches.read(pairs))
    StationaryFilter(features, matches).learn(pairs)
    again = StationaryFilter(features, MatchStore(matches.path)).filtered(given)
    assert len(again.indices) == len(SCENE)


def test_match_of_equal_letters_at_two_places_of_a_caption_is_left_out(tmp_path: Path) -> None:
    """It moves, as a match of the scene does, but both of its ends are where nothing moves."""
    features, matches, pairs = stores(tmp_path, scans(4))
    given = next(matches.read(pairs))
    StationaryFilter(features, matches).learn(pairs)
    swapped = given.indices.copy()
    swapped[len(SCENE) :, 1] = swapped[: len(SCENE) - 1 : -1, 1]
    to_caption = replace(given, indices=np.roll(given.indices, len(CAPTION), axis=0))
    to_caption.indices[:, 0] = given.indices[:, 0]  # from the scene to the caption and back
    again = StationaryFilter(features, MatchStore(matches.path))
    assert len(again.filtered(replace(given, indices=swapped)).indices) == len(SCENE)
    kept = again.filtered(to_caption).indices
    assert len(kept) == len(SCENE) + len(CAPTION)


def test_call_that_was_killed_is_repeated_to_the_same_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    features, matches, pairs = stores(tmp_path, scans(4))
    write, written = MatchStore.write, list[str]()

    def killed(store: MatchStore, found: list[PairMatches]) -> None:
        if len(written) == 4:
            raise KeyboardInterrupt
        written.append(str(found[0].names))
        write(store, found)

    with monkeypatch.context() as patch:
        patch.setattr(MatchStore, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            StationaryFilter(features, matches).learn(pairs)
    line = StationaryFilter(features, matches).learn(pairs)
    assert line.startswith(f"{2 * len(CAPTION)} matches of 2 pairs never move")
    assert all(len(found.indices) == len(SCENE) for found in matches.read(pairs))


@pytest.mark.parametrize(
    "points",
    [scans(2), [np.concatenate([SCENE, CAPTION])] * 6],
    ids=["two images", "a camera that stands still"],
)
def test_too_little_evidence_takes_nothing_away(tmp_path: Path, points) -> None:
    features, matches, pairs = stores(tmp_path, points)
    assert StationaryFilter(features, matches).learn(pairs) == ""
    assert all(len(found.indices) == 240 for found in matches.read(pairs))


def test_place_where_other_pairs_move_is_kept(tmp_path: Path) -> None:
    """The centre of a turn stands still in some pairs, and features pass it in others."""
    turned = [np.concatenate([SCENE, CAPTION])]
    for k in range(1, 7):
        moved = SCENE + k * SCENE_MOTION_PX
        moved[:40] = SCENE[:40] if k < 4 else moved[:40]  # four images agree there, three do not
        turned.append(np.concatenate([moved, CAPTION + 9.0 * k]))
    features, matches, pairs = stores(tmp_path, turned)
    assert StationaryFilter(features, matches).learn(pairs) == ""


def test_photographs_of_other_sizes_are_left_alone(tmp_path: Path) -> None:
    sizes = [SIZE, (640, 960), (961, 640), (960, 641)]
    features, matches, pairs = stores(tmp_path, scans(4), sizes)
    assert StationaryFilter(features, matches).learn(pairs) == ""
