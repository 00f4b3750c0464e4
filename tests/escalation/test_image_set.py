"""What images weigh that are matched again: by what more matches may bring to each."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_affrect.escalation import image_set
from colmap_affrect.escalation.escalate import Trial
from colmap_affrect.escalation.expected_gain import (
    Candidate,
    LevelStatistics,
    PairState,
    StepPlanner,
    _Selection,
)
from colmap_affrect.escalation.image_set import ImageSet, _megapixels
from colmap_affrect.mappers.wrong_models import (
    StoodOn,
    ThrownAway,
    write_thrown_away,
)
from colmap_affrect.project.match_state import MatchState
from colmap_affrect.project.match_store import PairMatches
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import SURE, ModelSummary
from colmap_affrect.recipes import EscalateOptions, load_recipe

NAMES = ["doubtful.jpg", "likely.jpg", "missing.jpg", "out.jpg", "sure.jpg"]


def state_of(names: list[str], left_out: tuple[str, ...]) -> ImageSet:
    """Return the state of a set that is mapped, of which nothing else is known."""
    context: Any = SimpleNamespace(
        listed_pairs=list,
        extraction=SimpleNamespace(levels=()),
        features=SimpleNamespace(names=lambda: names),
        by_hand=SimpleNamespace(left_out=left_out),
        workspace=SimpleNamespace(model_inputs=lambda: "these"),
        current_model_inputs=lambda: "these",
    )
    return ImageSet(context, EscalateOptions())


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


def test_what_the_largest_model_is_sure_of_weighs_nothing_and_others_count_as_likely() -> (
    None
):
    largest = ModelSummary(
        registered_names=("sure.jpg",),
        num_points3D=90,
        mean_track_length=3.0,
        mean_reprojection_error_px=0.5,
        probabilities={"sure.jpg": SURE},
    )
    other = ModelSummary(
        registered_names=("likely.jpg",),
        num_points3D=90,
        mean_track_length=3.0,
        mean_reprojection_error_px=0.5,
        probabilities={"likely.jpg": SURE},
    )
    names = ["likely.jpg", "missing.jpg", "sure.jpg"]
    weights = state_of(names, left_out=()).weights([largest, other])
    assert weights == {"likely.jpg": 0.25, "missing.jpg": 1.0}


def test_matches_are_looked_at_again_where_they_are_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state = state_of(NAMES, ())
    matches = np.zeros((4, 2), np.uint32)
    database = SimpleNamespace(read_matches=lambda *_: matches)
    context: Any = state.context
    context.graph = SimpleNamespace(
        ids={"a": 1, "b": 2}, open_to_read=lambda: nullcontext(database)
    )
    looked_at = list[int]()

    def num_consistent(_: object, __: object, indices: np.ndarray) -> int:
        looked_at.append(len(indices))
        return 10 * len(indices)

    monkeypatch.setattr(image_set, "num_consistent", num_consistent)
    assert state._num_consistent([("a", "b")]) == {("a", "b"): 40}
    assert state._num_consistent([("a", "b")]) == {("a", "b"): 40}
    matches = np.zeros((7, 2), np.uint32)
    assert state._num_consistent([("a", "b")]) == {("a", "b"): 70}
    assert looked_at == [4, 7]


def test_images_lack_levels_and_those_of_another_recipe_do_not_count() -> None:
    state = state_of(NAMES, ())
    context: Any = state.context
    context.extraction = SimpleNamespace(levels=[None, None, None])
    of_images = {"a": {0: (0, 9), 1: (9, 20)}, "b": {0: (0, 9), 3: (9, 20)}}
    context.features.level_ranges = of_images.get
    assert state._lacking_by_level(["a", "b"]) == [set(), {"b"}, {"a", "b"}]


def test_the_level_of_every_image_is_none_that_is_tried_again() -> None:
    state = state_of(["a", "b"], ())
    context: Any = state.context
    context.resources = SimpleNamespace(usable_levels=lambda _: [0, 1, 3])
    context.features.image_sizes = dict
    context.workspace.sparse = Path("none")
    context.usable = lambda _: []
    context.num_verified_inliers = dict
    context.matches = SimpleNamespace(
        state=MatchState(rounds=(3, 1)),
        levels=lambda *_: {},
        measured_worths=lambda _: {},
        learned_levels=lambda _: {},
    )
    found = state.situation({}, one_model())
    assert list(found.usable) == [1, 3]
    assert found.registered == ("a",)
    assert found.rounds == (3, 1)


def one_model() -> list[ModelSummary]:
    """Return one model of one image."""
    return [
        ModelSummary(
            registered_names=("a",),
            num_points3D=90,
            mean_track_length=3.0,
            mean_reprojection_error_px=0.5,
        )
    ]


def test_two_images_are_never_weakly_connected() -> None:
    for names, weak in ((["a", "b"], set[str]()), (["a", "b", "c"], {"a", "b"})):
        state = state_of(names, ())
        context: Any = state.context
        context.guiding = SimpleNamespace(min_num_tracks=30)
        context.verified_inliers = lambda: {("a", "b"): np.zeros((9, 2), np.int64)}
        assert state._weakly_connected() == weak


def test_inliers_of_a_pair_are_found_whichever_image_is_the_first() -> None:
    state = state_of(NAMES, ())
    listed = [("a", "b"), ("a", "c"), ("b", "c")]
    context: Any = state.context
    context.num_verified_inliers = lambda: {("a", "b"): 20, ("c", "a"): 30}
    context.usable = lambda _: listed
    assert state.num_inliers() == {("a", "b"): 20, ("a", "c"): 30, ("b", "c"): 0}


def test_a_pair_is_questioned_while_it_has_the_inliers_that_a_wrong_model_stood_on(
    tmp_path: Path,
) -> None:
    state = state_of(NAMES, ())
    pairs = [("a", "b"), ("b", "c")]
    counts = {("b", "a"): 400, ("b", "c"): 90}
    context: Any = state.context
    context.workspace.sparse = tmp_path
    context.num_verified_inliers = lambda: counts
    context.usable = lambda _: pairs
    context.matches = SimpleNamespace(
        levels=lambda pairs, _="level": dict.fromkeys(pairs, 0),
        measured_worths=lambda pairs: dict.fromkeys(pairs, (0, 0)),
        learned_levels=lambda pairs: dict.fromkeys(pairs, -1),
    )
    stood_on = (StoodOn("b", "a", 400), StoodOn("b", "c", 120))
    known = ThrownAway({"a": (Doubt("little_agreement", {"percent": 9}),)}, stood_on)
    write_thrown_away(known, tmp_path)
    questioned = {pair: one.is_questioned for pair, one in state.states().items()}
    assert questioned == {("a", "b"): True, ("b", "c"): False}
    counts["b", "a"] = 60  # of other matches
    assert not state.states()["a", "b"].is_questioned


@pytest.mark.parametrize(
    ("is_questioned", "worth", "is_better"),
    [(True, (20, 0), True), (True, (0, 50), False), (False, (20, 0), False)],
)
def test_other_matches_take_the_place_of_those_that_a_wrong_model_stood_on(
    worth: tuple[int, int], *, is_questioned: bool, is_better: bool
) -> None:
    before = PairState(num_inliers=400, is_questioned=is_questioned)
    found = PairMatches(
        ("a", "b"), np.zeros((0, 2), np.int64), np.zeros(0, np.float32), 9
    )
    assert Trial(found, worth, before).is_better == is_better


@pytest.mark.parametrize(("is_questioned", "num"), [(True, 1), (False, 0)])
def test_a_strong_pair_is_matched_again_where_a_wrong_model_stood_on_it(
    num: int, *, is_questioned: bool
) -> None:
    """Its photographs are apart from the model that is kept, and have many inliers."""
    states = {
        ("a", "b"): PairState(num_inliers=500),
        ("b", "c"): PairState(num_inliers=500),
        ("d", "e"): PairState(num_inliers=400, is_questioned=is_questioned),
    }
    planner = StepPlanner(
        states=states,
        weakly_connected=set(),
        weights={"d": 1.0, "e": 1.0},
        megapixels=dict.fromkeys("abcde", 1.0),
        unmeasured=(),
        lacking=(),
        registered=("a", "b", "c"),
        strong_num_inliers=100,
    )
    level = load_recipe("default").levels[1]
    assert len(planner.candidates(1, level, needless_after=0b10)) == num


def test_images_that_measured_frames_connect_to_likely_ones_are_anchored() -> None:
    state = state_of(NAMES, ())
    state.is_measured = [True, False]
    model = ModelSummary(
        registered_names=("likely", "measured", "learned", "unverified"),
        num_points3D=90,
        mean_track_length=3.0,
        mean_reprojection_error_px=0.5,
        doubtful={
            name: (Doubt("few_matches"),)
            for name in ("measured", "learned", "unverified")
        },
    )
    states = {
        ("likely", "measured"): PairState(num_inliers=30),
        ("learned", "likely"): PairState(num_inliers=30, level=1),
        ("likely", "unverified"): PairState(num_inliers=0),
        ("likely", "in no model"): PairState(num_inliers=30),
    }
    assert state._anchored(model, states) == {"likely", "measured"}


@pytest.mark.parametrize(
    ("size", "megapixels"),
    [((4000, 3000), 0.75), ((3000, 4000), 0.75), ((800, 600), 0.48)],
)
def test_photographs_count_as_large_as_they_are_shrunk_to(
    size: tuple[int, int], megapixels: float
) -> None:
    assert _megapixels(size, 1000) == pytest.approx(megapixels)


def test_features_that_several_pairs_need_are_paid_once() -> None:
    megapixels = {"a": 1.0, "b": 2.0, "c": 3.0}
    planner: Any = SimpleNamespace(megapixels=megapixels, lacking={"a", "b", "c"})
    statistics = LevelStatistics(coefficients={}, image_s=10.0, pair_s=1.0)
    selection = _Selection(planner, statistics, seconds=0.0)
    first = Candidate(("a", "b"), 0.5, ())
    second = Candidate(("b", "c"), 0.5, ())
    assert selection.seconds_of(first) == 10.0 * (1.0 + 2.0) + 2.0
    selection.add(first)
    assert selection.seconds_of(second) == 10.0 * 3.0 + 3.0


def test_a_level_wins_pairs_that_it_verifies_and_loses_those_it_was_tried_for() -> None:
    states = {
        ("a", "b"): PairState(num_inliers=20, level=1, tried=0b11),
        ("a", "c"): PairState(num_inliers=0, level=1, tried=0b11),
        ("b", "c"): PairState(num_inliers=20, level=0, tried=0b11),
        ("b", "d"): PairState(num_inliers=20, level=0, tried=0b01),
    }
    planner = StepPlanner(states, set(), {}, {}, (), (), (), 100)
    assert planner._wins_and_losses(1) == (1, 2)
