"""What images weigh that are matched again: by what more matches may bring to each."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from colmap_affrect.escalation.set_state import SetState
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import SURE, ModelSummary
from colmap_affrect.recipes import EscalateOptions

NAMES = ["doubtful.jpg", "likely.jpg", "missing.jpg", "out.jpg", "sure.jpg"]


def state_of(names: list[str], left_out: tuple[str, ...]) -> SetState:
    """Return the state of a set that is mapped, of which nothing else is known."""
    context: Any = SimpleNamespace(
        listed_pairs=list,
        extraction=SimpleNamespace(levels=()),
        features=SimpleNamespace(names=lambda: names),
        by_hand=SimpleNamespace(left_out=left_out),
        workspace=SimpleNamespace(model_inputs=lambda: "these"),
        current_model_inputs=lambda: "these",
    )
    return SetState(context, EscalateOptions())


def test_an_image_that_is_likely_right_weighs_a_quarter_of_what_it_may_gain() -> None:
    registered = ("doubtful.jpg", "likely.jpg", "sure.jpg")
    model = ModelSummary(
        registered_names=registered,
        num_points3D=90,
        mean_track_length=3.0,
        mean_reprojection_error_px=0.5,
        probabilities={"doubtful.jpg": 0.1, "likely.jpg": 0.7, "sure.jpg": SURE},
        gains={"doubtful.jpg": 0.8, "likely.jpg": 0.2, "sure.jpg": 0.01},
        doubtful={"doubtful.jpg": (Doubt("few_matches"),)},
    )
    weights = state_of(NAMES, left_out=("out.jpg",)).weights([model])
    assert weights == pytest.approx(
        {"doubtful.jpg": 0.8, "likely.jpg": 0.05, "missing.jpg": 1.0}
    )
