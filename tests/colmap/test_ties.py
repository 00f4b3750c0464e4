"""Pairs that alone tie two parts of a set."""

from __future__ import annotations

from itertools import combinations

import pytest

from colmap_affrect.colmap.connections import lone_ties

Pairs = list[tuple[int, int]]

LEFT = list(combinations((1, 2, 3), 2))
RIGHT = list(combinations((7, 8, 9), 2))


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        (LEFT, []),
        ([*LEFT, (3, 4)], []),  # of one image alone
        ([*LEFT, (9, 3), *RIGHT], [(3, 9)]),
        ([*LEFT, (3, 9), (2, 8), *RIGHT], []),
        ([(1, 2), (2, 3), (3, 4)], [(2, 3)]),
        ([], []),
    ],
)
def test_pair_that_alone_ties_two_parts_is_found(pairs: Pairs, expected: Pairs) -> None:
    assert lone_ties(pairs) == expected
