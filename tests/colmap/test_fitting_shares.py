"""Which pairs and images are said to have moved keypoints, by hand-made geometries."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from unlike_cameras import LONG, POSE, WIDE

from colmap_affrect.colmap import moved_keypoints
from colmap_affrect.colmap.moved_keypoints import (
    _errors_of_rays,
    _fitting_share,
    _Image,
    images_with_moved_keypoints,
)
from colmap_affrect.colmap.tables import MAX_NUM_IMAGES
from colmap_affrect.geometry.two_views import essential_matrix


def test_matches_of_unlike_cameras_fit_their_essential_matrix() -> None:
    points = np.random.default_rng(4).uniform((-0.9, -0.8, 6), (0.6, 0.9, 9), (40, 3))
    there = np.array([POSE * point for point in points])
    pixels = WIDE.img_from_cam(points), LONG.img_from_cam(there)
    essential = essential_matrix(
        np.asarray(POSE.rotation.matrix()), np.asarray(POSE.translation)
    )
    images = [_Image(pixels[0], WIDE, 900), _Image(pixels[1], LONG, 1000)]
    (errors,) = _errors_of_rays(essential, images, pixels)
    assert errors.max() < 1e-6
    wrong = pixels[0], np.roll(pixels[1], 1, axis=0)
    (errors,) = _errors_of_rays(essential, images, wrong)
    assert np.median(errors) > 10.0


@pytest.mark.parametrize(
    ("longer_side", "error_px", "fits"),
    [(800, 8.0, True), (800, 15.0, False), (4000, 30.0, True), (4000, 50.0, False)],
)
def test_matches_fit_up_to_twelve_px_or_a_hundredth_of_the_image(
    longer_side: int, error_px: float, *, fits: bool
) -> None:
    """All are off by one error from a homography that leaves points where they are."""
    points = np.random.default_rng(1).uniform(0, 700, (20, 2))
    # Sampson's error is of both images
    moved = points + np.array([np.sqrt(2.0) * error_px, 0.0])
    known = {1: _Image(points, None, 300), 2: _Image(moved, None, longer_side)}
    images: Any = SimpleNamespace(of=known.get)
    rows = np.stack([np.arange(20)] * 2, axis=1)
    share = _fitting_share(images, (1, 2), rows, (None, None, np.eye(3).tobytes()))
    assert share == (1.0 if fits else 0.0)
    assert _fitting_share(images, (1, 2), rows, (None, None, None)) is None


def moved(
    pairs: Iterable[tuple[int, int]], wrong: int, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """Return which images are said to have moved, where all pairs of one do not fit."""
    rows = []
    for first, second in pairs:
        blob = np.zeros((15, 2), "<u4").tobytes()
        rows.append((first * MAX_NUM_IMAGES + second, 15, 2, blob, b"", b"", b""))

    def share(ids: tuple[int, int], **_: object) -> float:
        return 0.0 if wrong in ids else 1.0

    monkeypatch.setattr(moved_keypoints, "rows_of", lambda *_: rows)
    monkeypatch.setattr(moved_keypoints, "_fitting_share", share)
    connection: Any = None
    tables: Any = SimpleNamespace(names={number: str(number) for number in range(99)})
    return images_with_moved_keypoints(connection, tables)


def test_pairs_of_images_that_are_known_well_are_looked_at_for_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two images are tied with all others, of which the last one has moved."""
    pairs = []
    for other in range(3, 31):
        pairs += [(1, other), (2, other)]
    assert moved(pairs, 30, monkeypatch) == ["30"]


def test_of_one_pair_alone_nobody_knows_which_image_has_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert moved([(1, 2)], 2, monkeypatch) == []
    assert moved([(1, 2), (2, 3), (1, 3)], 2, monkeypatch) == ["2"]
