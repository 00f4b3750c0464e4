"""What is upright is what most photographs say, unless that contradicts how cameras are held."""

from __future__ import annotations

import numpy as np
from line_scenes import turn
from numpy.testing import assert_allclose
from strategies import Array

from colmap_affrect.geometry.upright import agreed_up, upright_rotation

UP = turn(0, 20.0) @ np.array([0.0, -1.0, 0.0])


def leaning(*degrees: float) -> Array:
    """Directions that lean from ``UP``, each to another side."""
    found = []
    for number, angle in enumerate(degrees):
        found.append(
            turn(0, 20.0) @ turn(1, 77.0 * number) @ turn(0, angle) @ [0.0, -1.0, 0.0]
        )
    return np.array(found)


def test_most_photographs_decide_and_others_do_not_pull() -> None:
    found = agreed_up(leaning(0.5, 0.3, 0.4, 30.0, 80.0), leaning(10.0, 12.0))
    assert found is not None
    up, agrees = found
    assert agrees.tolist() == [True, True, True, False, False]
    assert np.rad2deg(np.arccos(up @ UP)) < 0.5
    assert_allclose(np.linalg.norm(up), 1.0)


def test_one_photograph_or_as_many_against_as_for_decide_nothing() -> None:
    held = leaning(0.0)
    assert agreed_up(leaning(0.0), held) is None
    assert agreed_up(np.zeros((0, 3)), held) is None
    assert agreed_up(leaning(0.0, 0.5, 30.0, 60.0), held) is None
    assert agreed_up(leaning(0.0, 9.0), held) is None  # more than 4 degrees apart
    assert agreed_up(leaning(0.0, 2.0), held) is not None


def test_cameras_that_are_held_otherwise_contradict() -> None:
    directions = leaning(0.1, 0.2, 0.3)
    assert agreed_up(directions, leaning(40.0, 40.0, 40.0)) is not None
    sideways = np.tile(turn(2, 60.0) @ UP, (5, 1))
    assert agreed_up(directions, sideways) is None
    assert agreed_up(directions, -directions) is None
    in_all_ways = np.concatenate([np.eye(3), -np.eye(3)])
    assert agreed_up(directions, in_all_ways) is not None
    nearly_in_all_ways = np.concatenate([in_all_ways, sideways[:1]])
    assert agreed_up(directions, nearly_in_all_ways) is not None


def test_z_points_up_and_y_ahead() -> None:
    ahead = turn(0, 20.0) @ np.array([3.0, -0.5, 4.0])
    rotation = upright_rotation(UP, ahead)
    assert_allclose(rotation @ UP, [0.0, 0.0, 1.0], atol=1e-12)
    assert_allclose(rotation @ ahead, [0.0, 5.0, 0.5], atol=1e-12)
    assert_allclose(np.linalg.det(rotation), 1.0)
    straight_down = upright_rotation(UP, -UP)
    assert_allclose(straight_down @ UP, [0.0, 0.0, 1.0], atol=1e-12)
    assert_allclose(np.linalg.det(straight_down), 1.0)
