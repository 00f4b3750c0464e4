"""The score of a model: what agreeing and contradicting pairs and tracks add to it."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tasks import synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.model_score import (
    MIN_SCORE_GAIN,
    ModelScorer,
    _seen_by_three,
    num_occupied_cells,
    pair_log_ratio,
)
from colmap_affrect.mappers.pair_graph import PairGraph


def test_an_image_has_sixty_four_cells() -> None:
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", 500.0, 640, 480
    )
    points = np.random.default_rng(0).uniform(0, (640, 480), (5000, 2))
    assert num_occupied_cells(camera, points) == 64
    assert num_occupied_cells(camera, points[(points < (80, 60)).all(axis=1)]) == 1
    assert num_occupied_cells(camera, np.zeros((0, 2))) == 0


def test_one_pair_in_twenty_may_be_wrong_itself() -> None:
    assert pair_log_ratio(0, 60) == pytest.approx(math.log(0.05), abs=0.01)
    assert pair_log_ratio(0, 10) > math.log(0.05)


@pytest.mark.parametrize("num", [10, 40])
def test_a_pair_speaks_for_poses_when_four_fifths_of_it_agree_and_not_when_two_thirds_do(
    num: int,
) -> None:
    assert pair_log_ratio(0.8 * num, num) > 0.0 > pair_log_ratio(0.65 * num, num)
    assert pair_log_ratio(num, num) > 3.0


@pytest.mark.parametrize(("num_points", "is_confirmed"), [(4, False), (60, True)])
def test_tracks_confirm_an_image_when_chance_is_twenty_times_less_likely(
    tmp_path: Path, num_points: int, *, is_confirmed: bool
) -> None:
    path = tmp_path / "database.db"
    model = synthesize(path, num_rigs=3, num_points3D=num_points)
    scorer = ModelScorer(PairGraph.read(path, 1), {})
    log_ratios = scorer.track_log_ratios(model).values()
    assert (math.exp(min(log_ratios)) > 20.0) == is_confirmed
    assert scorer.is_confirmed(model) == is_confirmed


def test_images_from_one_viewpoint_do_not_confirm_each_other(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    model = synthesize(path, num_rigs=3, num_points3D=60)
    scorer = ModelScorer(PairGraph.read(path), {})
    first, second, _ = sorted(model.reg_image_ids())
    together = {first: first, second: first}
    assert min(scorer.track_log_ratios(model).values()) > MIN_SCORE_GAIN
    assert set(scorer.track_log_ratios(model, together).values()) == {0.0}
    assert scorer.track_log_ratios(model, {}) == scorer.track_log_ratios(model)


def test_a_pair_counts_by_the_cells_of_the_image_in_which_they_are_fewer() -> None:
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", 500.0, 640, 480
    )
    spread = np.random.default_rng(0).uniform(0, (640, 480), (50, 2))
    pair: Any = SimpleNamespace(ids=(1, 2))
    for points in ((spread, spread / 8.0), (spread / 8.0, spread)):
        both = SimpleNamespace(
            cameras={1: camera, 2: camera}, points=lambda _, points=points: points
        )
        graph: Any = both
        assert ModelScorer(graph, {}).num_cells(pair) == 1


def test_long_tracks_are_points_that_images_from_three_viewpoints_see() -> None:
    seen = {1: np.array([5, 6, -1, 7]), 2: np.array([6, 5, 7]), 3: np.array([-1, 5, 7])}
    assert _seen_by_three(seen, {}).tolist() == [5, 7]
    assert _seen_by_three(seen, {1: 1, 3: 1}).tolist() == []
    twice_in_one = {1: np.array([5, 5]), 2: np.array([5])}
    assert _seen_by_three(twice_in_one, {}).tolist() == []


def test_improbable_cameras_lower_the_score(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    model = synthesize(path, num_rigs=3, num_points3D=60)
    graph = PairGraph.read(path)
    scores = []
    for cost in (0.0, 5.0):
        prior: Any = SimpleNamespace(cost_of=lambda _, cost=cost: cost)
        priors = dict.fromkeys(model.cameras, prior)
        scores.append(ModelScorer(graph, priors).score(model))
    assert scores[1] == pytest.approx(scores[0] - 15.0)  # of three cameras
