"""Two models are joined by tie points that agree on one similarity."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.tie_joining import TieJoiner

SIMILARITY = pycolmap.Sim3d(
    2.5, pycolmap.Rotation3d(np.array([0.4, -0.3, 1.0])), np.array([3.0, -1.0, 7.0])
)
NAMES = "abcdefgh"


@pytest.mark.parametrize(
    ("error_frac", "is_joined"), [(0.0, True), (0.05, True), (0.5, False)]
)
def test_tie_points_join_models_that_are_off_by_a_twentieth_of_their_spread(
    error_frac: float, *, is_joined: bool
) -> None:
    """Errors are in all directions, each of the same length."""
    random = np.random.default_rng(6)
    own = random.uniform(-1.0, 1.0, (len(NAMES), 3))
    there = np.array([SIMILARITY * place for place in own])
    spread = np.linalg.norm(np.std(there, axis=0))
    directions = random.normal(size=there.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    there += error_frac * spread * directions
    points: Any = SimpleNamespace(
        positions=lambda _: dict(zip(NAMES, own, strict=True))
    )
    grower: Any = SimpleNamespace(native=SimpleNamespace(random_seed=0))
    scorer: Any = None
    joiner = TieJoiner(points, grower, scorer)
    other = pycolmap.Reconstruction()
    point_id = other.add_point3D(own[0], pycolmap.Track())
    found = joiner._aligned(other, dict(zip(NAMES, there, strict=True)))
    assert (found is not None) == is_joined
    if found and error_frac == 0.0:
        assert found.points3D[point_id].xyz == pytest.approx(there[0])
        assert other.points3D[point_id].xyz == pytest.approx(own[0])
