"""Fixed-radius neighbours against all distances."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from strategies import Array

from colmap_affrect.geometry.neighbors import neighbors_within

# Eighths are exact in binary, so points at exactly the radius are no matter of rounding.
coordinates = st.integers(-400, 400).map(lambda eighths: eighths / 8)
point_sets = st.lists(st.tuples(coordinates, coordinates), max_size=60).map(
    lambda points: np.array(points, dtype=float).reshape(-1, 2)
)
radii = st.sampled_from([0.125, 0.625, 1.25, 5.0, 12.5, 200.0])


def all_neighbors(points: Array, radius: float) -> list[list[int]]:
    """Neighbours by comparing every pair."""
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    return [np.flatnonzero(row <= radius**2).tolist() for row in squares]


@given(point_sets, radii)
def test_neighbors_within_equals_all_distances(points: Array, radius: float) -> None:
    lists = neighbors_within(points, radius)
    assert lists.starts.shape == (len(points) + 1,)
    actual = [
        sorted(lists.indices[begin:end].tolist())
        for begin, end in zip(lists.starts[:-1], lists.starts[1:], strict=True)
    ]
    assert actual == all_neighbors(points, radius)


@given(point_sets.filter(len), st.data())
def test_of_lists_the_neighbors_of_the_points_asked_for_in_order(
    points: Array, data: st.DataObject
) -> None:
    asked = np.array(data.draw(st.lists(st.integers(0, len(points) - 1), max_size=10)), dtype=int)
    rows, neighbors = neighbors_within(points, 5.0).of(asked)
    expected = all_neighbors(points, 5.0)
    assert (np.diff(rows) >= 0).all()
    for position, point in enumerate(asked):
        assert sorted(neighbors[rows == position].tolist()) == expected[point]
