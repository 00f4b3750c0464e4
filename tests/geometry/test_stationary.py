"""Print is stationary, and what a camera turns about is not."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.stationary import (
    means_of_regions,
    num_moving_together,
    stationary_log_ratios,
)

LIMIT_PX = 5.0
TOLERANCE_PX = 1.0


def points(count: int) -> Array:
    return np.random.default_rng(1).uniform((0, 0), (1000, 700), (count, 2))


def noise(count: int) -> Array:
    return np.random.default_rng(2).normal(0.0, 0.25, (count, 2))


def mean_ratio(places: Array, motions: Array) -> float:
    is_small = np.linalg.norm(motions, axis=1) <= LIMIT_PX
    ratios = stationary_log_ratios(
        places[is_small], motions[is_small], TOLERANCE_PX, LIMIT_PX
    )
    return float(ratios.mean())


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, -1.5), (-3.0, 1.0)])
@pytest.mark.parametrize("degrees", [0.0, 0.15])
def test_print_on_sheets_laid_anew_stands_still(
    shift: tuple[float, float], degrees: float
) -> None:
    places = points(80)
    from_centre = places - (500, 350)
    turn = np.deg2rad(degrees) * np.stack(
        [-from_centre[:, 1], from_centre[:, 0]], axis=1
    )
    assert mean_ratio(places, turn + shift + noise(80)) > 1.0


@pytest.mark.parametrize(
    "slopes",
    [
        [[0.1, 0.0], [0.0, 0.1]],  # towards the scene
        [[0.0, -0.1], [0.1, 0.0]],  # a camera that rolls
        [[0.05, 0.0], [0.0, 0.0]],  # a plane that turns about an upright axis
        [[-0.1, 0.02], [0.01, 0.03]],
    ],
)
def test_motions_that_pass_through_zero_do_not_stand_still(
    slopes: list[list[float]],
) -> None:
    places = points(3000)
    motions = (places - (500, 350)) @ np.array(slopes).T + noise(3000)
    assert mean_ratio(places, motions) < -0.5


def test_most_that_agree_count_and_not_the_others() -> None:
    places = points(60)
    motions = noise(60)
    motions[::5] += (3.5, 0.0)
    ratios = stationary_log_ratios(places, motions, TOLERANCE_PX, LIMIT_PX)
    assert ratios[::5].max() < 0.0
    assert np.median(ratios) > 1.0


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_or_no_motions_are_no_error(count: int) -> None:
    ratios = stationary_log_ratios(points(count), noise(count), TOLERANCE_PX, LIMIT_PX)
    assert ratios.shape == (count,)


def test_matches_of_an_object_move_together_and_wrong_ones_do_not() -> None:
    places = points(200) / 5.0
    turned = places * (0.9, 1.0) + (60.0, 5.0)
    anywhere = np.random.default_rng(3).uniform((0, 0), (1000, 700), (200, 2))
    assert num_moving_together(places, turned - places, 20.0) > 180
    assert num_moving_together(points(200), anywhere - points(200), 20.0) < 5
    assert num_moving_together(points(0), points(0), 20.0) == 0


def test_motions_of_one_object_differ_by_less_than_half_of_the_distance() -> None:
    places = points(200) / 5.0
    assert num_moving_together(places, 0.2 * places, 20.0) > 180
    assert num_moving_together(places, 0.9 * places, 20.0) == 0


def test_values_are_averaged_over_cells_that_are_connected() -> None:
    """Two cells in the second column and below are neighbours; the third one is apart."""
    cells = np.array([[1, 5], [2, 6], [7, 0]])
    values = np.array([1.0, 3.0, 10.0])
    assert means_of_regions(cells, values, 9, 1).tolist() == [2.0, 2.0, 10.0]


def test_of_many_matches_some_are_looked_at_and_speak_for_all() -> None:
    places = np.stack([2.0 * np.arange(900), np.zeros(900)], axis=1)
    together = np.zeros((900, 2))
    assert num_moving_together(places, together, 10.0) == 900
    apart = 100.0 * np.random.default_rng(4).uniform(size=(900, 2))
    assert num_moving_together(places, apart, 10.0) < 90
