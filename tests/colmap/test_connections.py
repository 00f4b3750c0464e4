"""Which images pairs connect."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from colmap_affrect.colmap.connections import (
    connected_parts,
    lone_ties,
    weakly_connected_images,
)


def test_that_all_images_are_connected_is_found_without_networkx(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "networkx", None)
    assert connected_parts(list[tuple[int, int]]()) == []
    assert connected_parts([(2, 1), (2, 3), (4, 2)]) == [{1, 2, 3, 4}]
    assert connected_parts([(2, 1)], [1, 2]) == [{1, 2}]
    assert connected_parts([(1, 2), (3, 4), (2, 3)]) == [{1, 2, 3, 4}]
    with pytest.raises(ImportError):
        connected_parts([(2, 1)], [1, 2, 3])


def test_parts_are_found_where_no_image_is_tied_to_all_others() -> None:
    chain = [(1, 2), (2, 3), (3, 4)]
    assert connected_parts(chain) == [{1, 2, 3, 4}]
    assert connected_parts([*chain, (5, 6)], [7]) == [{1, 2, 3, 4}, {5, 6}, {7}]


def test_images_that_third_and_fourth_ones_tie_have_no_lone_tie_without_networkx(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    square = [(1, 2), (2, 3), (3, 4), (4, 1)]
    triangle = [(5, 6), (6, 7), (7, 5)]
    assert lone_ties([*square, *triangle, (4, 5)]) == [(4, 5)]
    pentagon = [(1, 2), (2, 3), (3, 4), (4, 5), (5, 1)]
    assert lone_ties(pentagon) == []
    monkeypatch.setitem(sys.modules, "networkx", None)
    assert lone_ties([*square, *triangle]) == []
    assert lone_ties([*square, (4, 9)]) == []  # of a part of one image
    with pytest.raises(ImportError):
        lone_ties(pentagon)


def numbered(*rows: tuple[int, int]) -> np.ndarray:
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


@pytest.mark.parametrize(("matches", "tracks"), [
    # Features 5 and 6 of b lead from a to c; feature 7 of b does not.
    ({("a", "b"): numbered((1, 5), (2, 6), (3, 7)), ("b", "c"): numbered((5, 8), (6, 9))},
     {"a": 2, "b": 2, "c": 2}),
    # The same numbers in another image are other features.
    ({("a", "b"): numbered((1, 5), (2, 6)), ("b", "c"): numbered((1, 5), (2, 6))},
     {"a": 0, "b": 0, "c": 0}),
    # d is matched with a feature of c that leads on, by one of its two matches.
    ({("c", "a"): numbered((4, 1), (5, 2)), ("c", "d"): numbered((6, 2), (4, 3))},
     {"a": 1, "c": 1, "d": 1}),
    # Feature 6 of b and 2 of c match each other alone.
    ({("a", "b"): numbered((1, 5)), ("b", "c"): numbered((5, 1), (6, 2))},
     {"a": 1, "b": 1, "c": 1}),
    ({("a", "b"): numbered((1, 1), (2, 2), (3, 3))}, {"a": 0, "b": 0}),
    ({("b", "a"): numbered()}, {"a": 0, "b": 0}),
    ({}, {}),
])  # fmt: skip
def test_images_with_few_features_in_tracks_of_three_are_weakly_connected(
    matches, tracks
) -> None:
    for limit in range(4):
        expected = {name for name, count in tracks.items() if count < limit}
        assert weakly_connected_images(matches, limit) == expected
