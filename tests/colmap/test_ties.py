"""Pairs that alone tie two parts of a set."""

from __future__ import annotations

from itertools import combinations

import networkx
import numpy as np
import pytest

from colmap_affrect.colmap.verification import connected_parts, lone_ties

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


def test_parts_are_what_pairs_connect_the_largest_first() -> None:
    random = np.random.default_rng(0)
    pairs = [(int(a), int(b)) for a, b in random.integers(0, 60, (35, 2))]
    graph = networkx.Graph(pairs)
    expected = sorted(
        networkx.connected_components(graph), key=lambda part: (-len(part), min(part))
    )
    assert connected_parts(pairs) == expected
    lone = [{number} for number in range(60) if number not in graph]
    assert connected_parts(pairs, range(60)) == sorted(
        [*expected, *lone], key=lambda part: (-len(part), min(part))
    )
