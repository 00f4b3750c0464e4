"""With which focal lengths a search begins, how far they may move, and when they agree."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from colmap_affrect.mappers.camera_priors import CameraPrior
from colmap_affrect.mappers.search import Search

OWN = 1  # id of the camera of one image
SHARED = 2  # of several images
WIDE_AND_LONG = CameraPrior(1000.0, 0.4, given_starts_px=(1000.0, 700.0, 1600.0))
TWO_STARTS = CameraPrior(1200.0, 0.05, given_starts_px=(1200.0, 900.0))


def search_with(shared: CameraPrior) -> Any:
    """Return what a search knows of two cameras; it adjusts with the priors that it returns."""
    unknown = {OWN: WIDE_AND_LONG, SHARED: shared}
    return SimpleNamespace(
        unknown_priors=unknown,
        adjuster=SimpleNamespace(priors=unknown),
        _shared={SHARED},
        _adjusting_with=lambda priors: priors,
        _unknown_focals=lambda focals_px: focals_px,
    )


def test_shared_focal_lengths_stay_within_a_tenth_while_models_grow() -> None:
    for prior, sigma in ((WIDE_AND_LONG, 0.1), (TWO_STARTS, 0.05)):
        priors: Any = Search._with_start(search_with(prior), 0)
        assert priors[OWN].sigma == 0.4
        assert priors[SHARED].sigma == sigma


def test_each_focal_length_begins_at_its_own_start_or_the_last_one() -> None:
    for number, expected in enumerate(
        [(1000.0, 1200.0), (700.0, 900.0), (1600.0, 900.0)]
    ):
        priors: Any = Search._with_start(search_with(TWO_STARTS), number)
        assert (priors[OWN].focal_px, priors[SHARED].focal_px) == expected


def test_focal_lengths_of_a_model_are_kept_within_a_tenth() -> None:
    focals_px: Any = {OWN: 1100.0, SHARED: 1300.0}
    priors: Any = Search._with_focals_of(search_with(TWO_STARTS), focals_px)
    assert {key: prior.focal_px for key, prior in priors.items()} == focals_px
    assert {prior.sigma for prior in priors.values()} == {0.1}


@pytest.mark.parametrize(
    ("focal_px", "agrees"),
    [(1000.0, True), (1020.0, True), (980.0, True), (1050.0, False), (950.0, False)],
)
def test_bridges_are_right_where_focal_lengths_moved_by_three_hundredths(
    focal_px: float, *, agrees: bool
) -> None:
    focals_px: Any = {OWN: focal_px, SHARED: 1200.0}
    assert Search._focals_agree(search_with(TWO_STARTS), focals_px) == agrees
