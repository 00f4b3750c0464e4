"""Images that seem to share a camera may be prints with axes of their own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers import hypotheses
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.hypotheses import PER_IMAGE_CAMERAS, HypothesisTest
from colmap_affrect.mappers.own_cameras import OwnCameras
from colmap_affrect.mappers.principal_points import FreedomGains

APART = pycolmap.Reconstruction()
"""The model with a camera for each image."""
TRIAL = pycolmap.Reconstruction()
"""The same with some of the tracks."""


def tried(
    monkeypatch: pytest.MonkeyPatch,
    gain: float,
    *,
    is_better: bool,
    is_known: bool = False,
) -> tuple[HypothesisTest, Any]:
    """Return a test of hypotheses after own axes were tried, and its search with own cameras.

    Args:
        monkeypatch: Of the test.
        gain: Nats by which free axes fit better.
        is_better: Whether the model with free axes scores higher.
        is_known: Whether the model has been tried with a camera for each image before.
    """
    made = {"all": APART, "some": TRIAL}
    own: Any = SimpleNamespace(
        graph=SimpleNamespace(has_rigs=False, thinned=lambda: "some"),
        grower=lambda graph: SimpleNamespace(
            remake=lambda _: APART, restart_from=lambda _: made[graph]
        ),
        comparing=lambda: own,
    )
    gains = FreedomGains(
        by_shifts=0.0,
        by_crops=gain,
        num_freed=6,
        num_observations=1000,
    )
    monkeypatch.setattr(hypotheses, "with_free_principal_points", lambda *_: "free")

    def gains_of(model: pycolmap.Reconstruction, *_: Any) -> FreedomGains:
        assert model is TRIAL
        return gains

    monkeypatch.setattr(hypotheses, "gains_of_freedom", gains_of)
    monkeypatch.setattr(HypothesisTest, "_take_shifted_axes", lambda *_: is_better)
    test: Any = HypothesisTest.__new__(HypothesisTest)
    test.task = SimpleNamespace(cameras={})
    test.search = "shared"
    test.per_image = own
    shared = pycolmap.Reconstruction()
    test.best = [MappedModel(shared, axis_turns_deg={"a.jpg": 3.0})]
    known = OwnCameras(None, None, TRIAL)
    test.tried = (shared, known) if is_known else None
    test._try_own_shifted_axes()
    return test, own


@pytest.mark.parametrize("is_known", [False, True])
def test_prints_that_seem_to_share_a_camera_get_axes_of_their_own(
    monkeypatch: pytest.MonkeyPatch, *, is_known: bool
) -> None:
    test, own = tried(monkeypatch, 500.0, is_better=True, is_known=is_known)
    assert test.search is own
    assert test.per_image is None
    assert PER_IMAGE_CAMERAS in test.best[0].hypotheses
    assert test.best[0].reconstruction is APART
    assert not test.best[0].axis_turns_deg  # free axes have none


@pytest.mark.parametrize(
    ("gain", "is_better"),
    [
        (10.0, True),
        (500.0, False),
    ],
)
def test_a_shared_camera_stays_where_own_axes_bring_little(
    monkeypatch: pytest.MonkeyPatch, gain: float, *, is_better: bool
) -> None:
    test, own = tried(monkeypatch, gain, is_better=is_better)
    assert test.search == "shared"
    assert test.per_image is own
    assert test.best[0].axis_turns_deg == {"a.jpg": 3.0}
