"""Which other focal lengths are tried, and which growth of the cost by them is one."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers import focal_observability
from colmap_affrect.mappers.focal_observability import _FocalTrials, _growths

FOCAL_PX = 1000.0
COST = 100.0  # of the model as it is


def trials_of(costs: dict[float, float], monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return trials of a model whose cost is known by the factor of its focal length.

    What was tried is appended to the attribute ``tried``.
    """
    model = pycolmap.Reconstruction()
    model.add_camera(
        pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL_PX, 800, 600)
    )
    trials = SimpleNamespace(
        model=model, priors={}, refining=None, constant=frozenset(), cost=COST, tried=[]
    )

    def adjust(trial: pycolmap.Reconstruction, *_: Any, **__: Any) -> float:
        factor = round(trial.cameras[1].mean_focal_length() / FOCAL_PX, 6)
        trials.tried.append(factor)
        return costs[factor]

    adjuster = SimpleNamespace(adjust=adjust)
    monkeypatch.setattr(focal_observability, "Adjuster", lambda **_: adjuster)
    return trials


@pytest.mark.parametrize(
    "costs", [{1.25: 150.0, 0.8: 120.0}, {1.25: 120.0, 0.8: 150.0}]
)
def test_a_quarter_more_and_as_much_less_are_tried_and_the_lower_cost_counts(
    costs: dict[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    trials = trials_of(costs, monkeypatch)
    assert _FocalTrials.growth(trials, [1]) == pytest.approx(0.2)
    assert trials.tried == [1.25, 0.8]


@pytest.mark.parametrize(("cost", "num_tried"), [(100.1, 1), (101.0, 2)])
def test_where_the_cost_hardly_grows_no_other_focal_length_is_tried(
    cost: float, num_tried: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials = trials_of({1.25: cost, 0.8: 150.0}, monkeypatch)
    assert _FocalTrials.growth(trials, [1]) == pytest.approx(cost / COST - 1.0)
    assert len(trials.tried) == num_tried


def test_growths_of_known_deviations_are_of_a_quarter_more_and_no_more_than_one() -> (
    None
):
    trials: Any = SimpleNamespace(cost=COST)
    expected = 0.5 * (math.log(1.25) / 0.1) ** 2 / COST / 2.5
    assert _FocalTrials._growth_of(trials, 0.1) == pytest.approx(expected)
    assert _FocalTrials._growth_of(trials, 0.001) == 1.0


@pytest.mark.parametrize(
    ("by_covariance", "is_tried"),
    [(0.001, False), (0.01, True), (0.5, True), (1.0, False)],
)
def test_one_camera_is_tried_that_the_covariance_neither_leaves_open_nor_knows(
    by_covariance: float, *, is_tried: bool
) -> None:
    trials: Any = SimpleNamespace(
        growths_by_covariance=lambda _: {1: by_covariance}, growth=lambda _: -1.0
    )
    assert _growths(trials, [1]) == {1: -1.0 if is_tried else by_covariance}
