"""Which images pairs connect."""

from __future__ import annotations

import sys

import pytest

from colmap_affrect.colmap.connections import connected_parts, lone_ties


def test_image_that_is_tied_to_all_others_connects_them_without_networkx(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "networkx", None)
    assert connected_parts(list[tuple[int, int]]()) == []
    assert connected_parts([(2, 1), (2, 3), (4, 2)]) == [{1, 2, 3, 4}]
    assert connected_parts([(2, 1)], [1, 2]) == [{1, 2}]
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
