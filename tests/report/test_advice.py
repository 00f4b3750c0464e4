"""That matches show no depth is said only where nothing beyond noise speaks for depth."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_affrect.geometry.affine import project
from colmap_affrect.mappers.wrong_models import ThrownAway, write_thrown_away
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.report import advice
from colmap_affrect.report.advice import (
    ENOUGH,
    _any_shows_depth,
    _why_no_model,
    shows_depth,
)

SIZE_PX = 1000.0
TURN = np.array([[0.98, 0.03, 12.0], [-0.02, 1.01, 5.0], [2e-5, -3e-5, 1.0]])
"""Px of one photograph to those of another one whose camera turned, off its middle."""


def turned(num: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matches of a camera that turned, with half a pixel of noise."""
    random = np.random.default_rng(1)
    points = random.uniform(0.0, SIZE_PX, (num, 2))
    return points, project(TURN, points) + random.normal(0.0, 0.5, (num, 2))


@pytest.mark.parametrize(
    ("num", "num_near", "is_shown"),
    [(1000, 0, False), (1000, 20, False), (1000, 40, True), (200, 20, True)],
)
def test_depth_is_shown_by_as_many_matches_as_make_a_pair_and_more_than_chance(
    num: int, num_near: int, is_shown: bool
) -> None:
    """Things before a wall are few, and show its depth all the same."""
    first, second = turned(num)
    shifts_px = np.linspace(10.0, 60.0, num_near)
    second[:num_near, 0] += shifts_px
    assert shows_depth(first, second, 3.0) == is_shown


def test_few_wrong_matches_of_a_short_list_show_no_depth() -> None:
    first, second = turned(120)
    second[:10, 0] += 30.0
    assert not shows_depth(first, second, 3.0)


@pytest.mark.parametrize(
    ("doubts", "why"),
    [
        ((Doubt("few_matches"), Doubt("focal_unknown")), "too few agree on one model"),
        ((Doubt("matches_disagree"),), "contradict each other"),
        ((), "contradict each other"),
    ],
)
def test_where_no_model_is_kept_what_its_photographs_lacked_is_advised(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    doubts: tuple[Doubt, ...],
    why: str,
) -> None:
    monkeypatch.setattr(advice, "_any_shows_depth", lambda _: True)
    if doubts:
        write_thrown_away(ThrownAway({"a": doubts}), tmp_path)
    context: Any = SimpleNamespace(workspace=SimpleNamespace(sparse=tmp_path))
    case = advice._Case(context, [], 3, [], ENOUGH, (), "high", ())
    assert _why_no_model(case).endswith(why)


def test_one_of_the_strongest_pairs_that_shows_depth_is_enough(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = np.zeros((ENOUGH, 2), int)
    flat = {("a", "b"): np.zeros((300, 2), int), ("a", "c"): rows}
    graph = SimpleNamespace(inliers=lambda _: flat)
    context: Any = SimpleNamespace(graph=graph)
    shown = {("a", "b"): False, ("a", "c"): True}
    monkeypatch.setattr(advice, "_pair_shows_depth", lambda _, names, __: shown[names])
    assert _any_shows_depth(context)
    shown["a", "c"] = False
    assert not _any_shows_depth(context)
