"""Matches that confirm each other are counted, wrong ones and copies of one place are not."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_affrect.geometry.consistency import num_consistent_matches

SIZE = np.array([1200.0, 700.0])
MAP = np.array([[2.6, 0.9, 40.0], [-0.4, 1.2, 310.0]])  # neither its transpose nor its inverse


def random_frames(count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    frames = np.zeros((count, 2, 3))
    angles, radii = random.uniform(0, 2 * np.pi, count), random.uniform(3, 30, count)
    frames[:, 0, 0] = frames[:, 1, 1] = radii * np.cos(angles)
    frames[:, 1, 0], frames[:, 0, 1] = radii * np.sin(angles), -radii * np.sin(angles)
    frames[:, :, 2] = random.uniform(0, SIZE, (count, 2))
    return frames


def carried(frames: np.ndarray) -> np.ndarray:
    moved = MAP[:, :2] @ frames
    moved[:, :, 2] += MAP[:, 2]
    return moved


@pytest.mark.parametrize("num_wrong", [0, 150])
def test_right_matches_are_counted_among_wrong_ones(num_wrong: int) -> None:
    first = random_frames(40 + num_wrong, 1)
    first[:40, :, 2] /= [6.0, 4.0]  # a part of the image that is seen in both
    second = np.concatenate([carried(first[:40]), random_frames(num_wrong, 2)])
    count = num_consistent_matches(first, second)
    assert 34 <= count <= 42
    assert num_consistent_matches(second, first) == count


def test_wrong_matches_do_not_confirm_each_other() -> None:
    counts = [
        num_consistent_matches(random_frames(300, seed), random_frames(300, seed + 100))
        for seed in range(5)
    ]
    assert max(counts) <= 1


def test_frames_that_contradict_the_positions_confirm_nothing() -> None:
    first = random_frames(40, 3)
    second = carried(first)
    second[:, :, :2] = second[:, :, :2] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    assert num_consistent_matches(first, second) == 0


def test_copies_of_one_place_are_no_neighbours() -> None:
    first = random_frames(30, 4)
    first[:, :, 2] = 500.0 + first[:, :, 2] / 1000.0
    assert num_consistent_matches(first, carried(first)) == 0
