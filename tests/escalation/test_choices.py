"""Which models and matches are chosen, decided by what is on record alone; nothing is mapped."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_affrect.escalation import alternatives, escalate, map_and_rematch
from colmap_affrect.escalation.alternatives import (
    SCORE,
    Choice,
    _choice_of_learned_matches,
    give_up_learned_models,
    has_models_to_go_on_from,
    keep_best,
    map_learned_matches,
    needs_learned_models,
    num_right_poses_of_best,
    restore_best,
)
from colmap_affrect.escalation.escalate import Escalation, Trial
from colmap_affrect.escalation.expected_gain import PairState
from colmap_affrect.escalation.map_and_rematch import _try_learned_matches
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.match_state import Begun, LearnedModels, MatchState
from colmap_affrect.project.match_store import Learned, PairMatches
from colmap_affrect.project.sealed_json import write_sealed
from colmap_affrect.recipes import EscalateOptions

NAMES = ["a", "b", "c"]


def context_in(folder: Path, **state: Any) -> Any:
    """Return a context with an empty model and matches, and the digest of its pairs."""
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "matches.h5").write_bytes(b"these")
    workspace = SimpleNamespace(
        best=folder / "best",
        learned=folder / "learned",
        sparse=folder / "sparse",
        matches=folder / "matches.h5",
        model_inputs=lambda: "these",
    )
    return SimpleNamespace(
        workspace=workspace,
        current_model_inputs=lambda: "these",
        features=SimpleNamespace(names=lambda: NAMES),
        by_hand=SimpleNamespace(allows=lambda *pair: pair != ("a", "c")),
        set_digest=lambda: "set",
        matches=SimpleNamespace(state=MatchState(listed="pairs", **state)),
    )


def let_models_have(poses: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let so many poses of the models that are there be right."""
    monkeypatch.setattr(alternatives, "num_right_poses_now", lambda _: poses)


@pytest.mark.parametrize(
    ("now", "is_needed"), [(2.9, True), (3.0, False), (3.1, False)]
)
def test_learned_models_are_needed_where_more_of_their_poses_are_right(
    now: float, *, is_needed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_in(tmp_path)
    learned = LearnedModels("set", score=3.0, score_without=1.0)
    context.matches.state = MatchState(listed="pairs", learned_models=learned)
    let_models_have(now, monkeypatch)
    assert needs_learned_models(context) == is_needed
    context.workspace.learned.mkdir()
    assert not needs_learned_models(context)


@pytest.mark.parametrize(
    ("probabilities", "is_of_most"),
    [([0.7], True), ([0.65], False), ([0.6, 0.6], False), ([], False)],
)
def test_one_model_of_learned_matches_has_most_poses_right_or_none_has(
    probabilities: list[float],
    *,
    is_of_most: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = context_in(tmp_path)
    context.by_hand.left_out = ()
    recorded = list[LearnedModels]()

    def update_state(learned_models: LearnedModels) -> None:
        recorded.append(learned_models)

    context.matches.update_state = update_state
    models = []
    for probability in probabilities:
        model = SimpleNamespace(probabilities=dict.fromkeys(NAMES, probability))
        models.append(model)
    monkeypatch.setattr(alternatives, "read_summaries", lambda _: models)
    monkeypatch.setattr(
        alternatives, "_choice_of_learned_matches", lambda _: Choice((), {})
    )
    let_models_have(1.2, monkeypatch)
    escalation: Any = SimpleNamespace(context=context)
    mapper: Any = None
    map_learned_matches(escalation, mapper)
    (found,) = recorded
    assert found.is_of_most == is_of_most
    expected = sum(3 * probability - 1.0 for probability in probabilities)
    assert found.score == pytest.approx(expected)
    assert found.score_without == 1.2


@pytest.mark.parametrize(
    ("learned_models", "is_enough"),
    [
        (LearnedModels("set", 3.0, 2.0, is_of_most=True), True),
        (LearnedModels("set", 2.0, 2.0, is_of_most=True), False),  # not better
        (LearnedModels("set", 3.0, 2.0), False),  # others may be better than both
        (LearnedModels("set", 3.0, 0.9), True),  # nothing else to go on from
        (LearnedModels("set", 3.0, 1.0), False),
    ],
)
def test_learned_models_with_most_poses_right_are_enough_where_they_are_better(
    learned_models: LearnedModels, *, is_enough: bool
) -> None:
    assert learned_models.is_enough == is_enough


def test_the_best_models_are_kept_with_their_matches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_in(tmp_path)
    best = context.workspace.best
    kept = []
    for poses, matches in (
        (2.0, b"first"),
        (1.0, b"worse"),
        (2.0, b"as good"),
        (3.0, b"better"),
    ):
        context.workspace.matches.write_bytes(matches)
        let_models_have(poses, monkeypatch)
        keep_best(context)
        kept.append((best / "matches.h5").read_bytes())
    assert kept == [b"first", b"first", b"as good", b"better"]
    assert (best / "0").is_dir()
    assert num_right_poses_of_best(context) == 3.0


def test_best_models_of_other_pairs_are_worth_nothing(tmp_path: Path) -> None:
    context = context_in(tmp_path)
    context.workspace.best.mkdir()
    score = context.workspace.best / SCORE
    write_sealed(score, json.dumps({"of_set": "set", "num_right_poses": 2.5}))
    assert num_right_poses_of_best(context) == 2.5
    write_sealed(score, json.dumps({"of_set": "others", "num_right_poses": 2.5}))
    assert num_right_poses_of_best(context) == 0.0


def test_models_that_are_as_good_as_the_best_ones_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation: Any = SimpleNamespace(context=context_in(tmp_path))
    monkeypatch.setattr(alternatives, "num_right_poses_of_best", lambda _: 2.0)
    let_models_have(2.0, monkeypatch)
    assert not restore_best(escalation)


def matches_of(first: str, second: str, level: int) -> PairMatches:
    indices = np.array([[0, 1]])
    return PairMatches((first, second), indices, np.ones(1, np.float32), 9, level)


def test_learned_matches_are_chosen_of_pairs_that_use_others_with_the_worth_of_measured_ones() -> (
    None
):
    """Levels 0 and 1 are measured, the others are learned."""
    states = {
        ("a", "b"): PairState(20, 4, level=1),
        ("a", "c"): PairState(30, 5, level=2),  # uses its learned matches already
        ("b", "c"): PairState(40, 6, level=3),
    }
    learned = {}
    for first, second in states:
        learned[first, second] = Learned(matches_of(first, second, 2), (50, 0))
    escalation: Any = SimpleNamespace(
        image_set=SimpleNamespace(
            states=lambda: states, is_measured=[True, True, False, False]
        ),
        matches=SimpleNamespace(learned=lambda _: learned),
    )
    choice = _choice_of_learned_matches(escalation)
    assert [one.names for one in choice.matches] == [("a", "b"), ("b", "c")]
    assert choice.measured_worths == {("a", "b"): (20, 4)}


def escalation_of(context: Any) -> Escalation:
    """Return an escalation of three pairs."""
    context.listed_pairs = lambda: [("a", "b"), ("a", "c"), ("b", "c")]
    levels = [
        SimpleNamespace(features=SimpleNamespace(has_shapes=one))
        for one in (True, False)
    ]
    context.extraction = SimpleNamespace(levels=levels)
    return Escalation(context, EscalateOptions())


def trial(worth: tuple[int, int], before: PairState, level: int = 1) -> Trial:
    return Trial(matches_of("a", "b", level), worth, before)


def test_matches_that_are_as_good_as_those_before_do_not_take_their_place() -> None:
    before = PairState(num_inliers=20, num_consistent=5)
    assert not trial((20, 5), before).is_better
    assert trial((20, 6), before).is_better
    assert trial((21, 0), before).is_better


def test_what_is_left_of_a_step_is_untried_and_not_rejected_by_hand(
    tmp_path: Path,
) -> None:
    """Pairs that are in no store were tried at no level, or are gone."""
    escalation = escalation_of(context_in(tmp_path))
    pairs = (("a", "b"), ("a", "c"), ("b", "c"), ("c", "d"))
    tried = {("a", "b"): 0b01, ("a", "c"): 0b01, ("b", "c"): 0b11}
    matches: Any = escalation.matches
    matches.levels = lambda *_: tried
    assert escalation._left_of(Begun(1, pairs)) == [("a", "b")]


@pytest.mark.parametrize(
    ("level_before", "level", "worth", "expected"),
    [
        (0, 1, (30, 0), {("a", "b"): (20, 5)}),  # learned matches are better
        (0, 1, (10, 0), {}),  # they are not
        (0, 0, (30, 0), {}),
        (1, 0, (30, 0), {("a", "b"): (30, 0)}),  # measured ones are better than before
        (1, 0, (10, 0), {("a", "b"): (15, 2)}),  # they are not
        (1, 1, (30, 0), {}),
    ],
)
def test_the_worth_of_the_best_measured_matches_is_kept_in_mind(
    level_before: int,
    level: int,
    worth: tuple[int, int],
    expected: dict[tuple[str, str], tuple[int, int]],
    tmp_path: Path,
) -> None:
    """Frames of the first level are measured, those of the second one learned."""
    escalation = escalation_of(context_in(tmp_path))
    before = PairState(20, 5, level=level_before, measured_worth=(15, 2))
    found = escalation._measured_worths([trial(worth, before, level)])
    assert found == expected


@pytest.mark.parametrize(("num_inliers", "worth"), [(7, (7, 0)), (0, (0, 6))])
def test_a_pair_is_worth_its_inliers_or_else_its_consistent_matches(
    num_inliers: int,
    worth: tuple[int, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = context_in(tmp_path)
    context.features.read_frames = lambda name: name
    monkeypatch.setattr(escalate, "num_consistent", lambda *_: 6)
    verifier: Any = SimpleNamespace(inliers=lambda *_: [(0, 1)] * num_inliers)
    escalation = escalation_of(context)
    assert escalation._worth(matches_of("a", "b", 1), verifier) == worth


def test_learned_matches_are_used_of_the_level_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context_in(tmp_path))
    learned = {
        ("a", "b"): Learned(matches_of("a", "b", 2), (50, 0)),
        ("b", "c"): Learned(matches_of("b", "c", 4), (60, 0)),
    }
    stores: Any = escalation.matches
    stores.learned = lambda _: learned
    before = PairState(20, 5)
    monkeypatch.setattr(
        escalation.image_set, "states", lambda: dict.fromkeys(learned, before)
    )
    kept = list[tuple[Any, int]]()
    monkeypatch.setattr(
        escalation, "_keep", lambda trials, level: kept.append((trials, level))
    )
    assert escalation._use_learned_matches([*learned], 2) == {("a", "b")}
    expected = Trial(learned["a", "b"].matches, (50, 0), before)
    assert kept == [([expected], 2)]
    assert escalation._use_learned_matches([*learned], 3) == set()


def matched_by_learned_matching(
    context: Any,
    monkeypatch: pytest.MonkeyPatch,
    *,
    learned_levels: Mapping[Pair, int],
    num_inliers: Mapping[Pair, int],
    only_verified: bool = False,
) -> list[tuple[Pair, int]]:
    """Return the pairs that are matched, with the level."""
    context.deadline_s = float("inf")
    escalation = escalation_of(context)
    monkeypatch.setattr(escalation.image_set, "num_inliers", lambda: num_inliers)
    stores: Any = escalation.matches
    stores.learned_levels = lambda pairs: {pair: learned_levels[pair] for pair in pairs}
    matched = list[tuple[Pair, int]]()

    def match_with(batch: Sequence[Pair], level: int, _: object) -> None:
        matched.extend((pair, level) for pair in batch)

    monkeypatch.setattr(escalation, "_match_with", match_with)
    monkeypatch.setattr(escalation, "write", lambda: None)
    num_matched = escalation.match_learned(only_verified=only_verified)
    assert num_matched == len(matched)
    return matched


def test_pairs_that_have_learned_matches_are_not_matched_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = (("a", "b"), ("b", "c"))
    matched = matched_by_learned_matching(
        context_in(tmp_path, learned_matching=Begun(2, pairs)),
        monkeypatch,
        learned_levels={("a", "b"): 2, ("b", "c"): -1},
        num_inliers={},
    )
    assert matched == [(("b", "c"), 2)]


@pytest.mark.parametrize(
    ("worths", "used_levels", "is_in_vain"),
    [
        ({("a", "b"): 31, ("b", "c"): 41}, [0, 0], False),
        ({("a", "b"): 31, ("b", "c"): 40}, [0, 1], True),  # better for half of them
        ({("a", "b"): 31}, [0, 0], False),  # not yet known
        ({("a", "b"): 31}, [0, 2], False),  # better for the one that does not use them
        ({("a", "b"): 30}, [0, 2], True),
    ],
)
def test_learned_matches_tie_most_verified_pairs_better_or_are_expected_to_be_in_vain(
    worths: dict[tuple[str, str], int],
    used_levels: list[int],
    *,
    is_in_vain: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The pair of b and d is not verified, and that of a and c was rejected."""
    num_inliers = {("a", "b"): 30, ("b", "c"): 40, ("b", "d"): 0}
    pairs = (*num_inliers, ("a", "c"))
    context = context_in(tmp_path, learned_matching=Begun(2, pairs))
    escalation = escalation_of(context)
    monkeypatch.setattr(escalation.image_set, "num_inliers", lambda: num_inliers)
    learned = {}
    for pair, count in worths.items():
        learned[pair] = Learned(matches_of(*pair, 2), (count, 0))
    asked = list[Any]()
    stores: Any = escalation.matches
    stores.learned = lambda of_pairs: asked.append(of_pairs) or learned
    stores.levels = lambda of_pairs: dict(zip(of_pairs, used_levels, strict=True))
    assert escalation.ties_verified_pairs_no_better == is_in_vain
    assert asked == [
        [("a", "b"), ("b", "c")][: used_levels.count(0) + used_levels.count(1)]
    ]


def test_learned_matches_of_no_verified_pair_may_be_better(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_in(tmp_path, learned_matching=Begun(2, (("a", "b"),)))
    escalation = escalation_of(context)
    monkeypatch.setattr(escalation.image_set, "num_inliers", lambda: {("a", "b"): 0})
    stores: Any = escalation.matches
    stores.learned = lambda _: {}
    stores.levels = lambda _: {}
    assert not escalation.ties_verified_pairs_no_better


@pytest.mark.parametrize(
    ("effort", "has_models", "ties_no_better", "done"),
    [
        ("normal", True, True, ["verified", "given up"]),
        ("normal", True, False, ["verified", "all", "mapped"]),
        ("normal", False, True, ["all", "mapped"]),  # there is nothing to lose
        ("low", True, True, ["all", "mapped"]),  # no later step would match the others
    ],
)
def test_learned_matches_that_tie_verified_pairs_no_better_are_given_up(
    effort: str,
    has_models: bool,
    ties_no_better: bool,
    done: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All other pairs were matched, and mapped, in vain before."""
    found = list[str]()

    def match_learned(*, only_verified: bool = False) -> int:
        found.append("verified" if only_verified else "all")
        return 2

    escalation: Any = SimpleNamespace(
        context=SimpleNamespace(effort=effort),
        plan_learned_matching=lambda: True,
        match_learned=match_learned,
        ties_verified_pairs_no_better=ties_no_better,
        has_all_learned_matches=True,
        add_to_report=lambda _, num_pairs: found.append(num_pairs),
    )
    patches = {
        "needs_learned_models": lambda _: True,
        "has_models_to_go_on_from": lambda _: has_models,
        "give_up_learned_models": lambda _: found.append("given up"),
        "map_learned_matches": lambda *_: found.append("mapped"),
    }
    for name, function in patches.items():
        monkeypatch.setattr(map_and_rematch, name, function)
    mapper: Any = None
    _try_learned_matches(escalation, mapper)
    num_pairs = 2 * len({"verified", "all"}.intersection(done))
    assert found == [*done, num_pairs]


def test_steps_cost_nothing_while_models_are_worse_than_the_best_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first steps made them worse; after those that follow the best ones come back."""
    found = list[bool]()

    def take_steps(_: Any, *, may_cost: bool) -> None:
        found.append(may_cost)

    inputs = iter(("first", "second", "second", "second", "second", "second"))
    is_worse = iter((False, True, False))
    escalation: Any = SimpleNamespace(
        has_stepped=True, take_steps=take_steps, final_report=lambda: None
    )
    patches = {
        "begin": lambda *_: escalation,
        "adopt_chosen_models": lambda _: None,
        "_map_first": lambda *_: [],
        "_try_learned_matches": lambda *_: None,
        "choose_learned": lambda *_, **__: False,
        "has_become_worse": lambda _: next(is_worse),
        "_map_on": lambda *_: [],
        "restore_best": lambda _: len(found) == 2,
        "remove_alternatives": lambda _: None,
    }
    for name, function in patches.items():
        monkeypatch.setattr(map_and_rematch, name, function)
    workspace = SimpleNamespace(model_inputs=lambda: next(inputs))
    context: Any = SimpleNamespace(workspace=workspace)
    recipe: Any = SimpleNamespace(escalate=None)
    mapper: Any = None
    map_and_rematch.map_and_rematch(context, mapper, recipe)
    assert found == [True, False, True]


def test_rounds_are_counted_from_the_first_model_of_a_list_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of photographs that were added since, each takes more."""
    context = context_in(tmp_path)
    changes = dict[str, Any]()
    state = MatchState(listed="more pairs", modelled="pairs", rounds=(1, 2))
    context.matches = SimpleNamespace(state=state, update_state=changes.update)
    monkeypatch.setattr(map_and_rematch, "guide", lambda *_: None)
    monkeypatch.setattr(map_and_rematch, "map_images", lambda *_: [None])
    recipe: Any = SimpleNamespace(guided=None)
    mapper: Any = None
    map_and_rematch._map_first(context, mapper, recipe)
    assert changes == {"modelled": "more pairs", "rounds": ()}


def test_learned_models_that_were_given_up_are_needed_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_in(tmp_path)

    def update_state(**changes: Any) -> None:
        context.matches.state = MatchState(listed="pairs", **changes)

    context.matches.update_state = update_state
    let_models_have(1.5, monkeypatch)
    assert needs_learned_models(context)
    give_up_learned_models(context)
    assert not needs_learned_models(context)
    let_models_have(0.9, monkeypatch)
    assert not has_models_to_go_on_from(context)


def test_verified_pairs_may_be_matched_by_learned_matching_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = (("a", "b"), ("b", "c"))
    matched = matched_by_learned_matching(
        context_in(tmp_path, learned_matching=Begun(2, pairs)),
        monkeypatch,
        learned_levels=dict.fromkeys(pairs, -1),
        num_inliers={("a", "b"): 0, ("b", "c"): 30},
        only_verified=True,
    )
    assert matched == [(("b", "c"), 2)]


def test_pairs_that_were_rejected_since_are_not_matched_by_learned_matching(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else is known of them any more."""
    pairs = (("a", "c"), ("b", "c"))
    context = context_in(tmp_path, learned_matching=Begun(2, pairs))
    context.deadline_s = float("inf")
    escalation = escalation_of(context)
    levels = {("a", "c"): -1, ("b", "c"): -1}
    stores: Any = escalation.matches
    stores.learned_levels = lambda asked: {pair: levels[pair] for pair in asked}
    matched = list[Any]()
    monkeypatch.setattr(
        escalation, "_match_with", lambda batch, *_: matched.extend(batch)
    )
    monkeypatch.setattr(escalation, "write", lambda: None)
    assert escalation.match_learned() == 1
    assert matched == [("b", "c")]
    assert not escalation.has_all_learned_matches
    levels["b", "c"] = 2
    assert escalation.has_all_learned_matches


def test_images_get_the_features_that_they_lack_of_a_level_and_of_its_base(
    tmp_path: Path,
) -> None:
    """The third level is matched together with the second one."""
    context = context_in(tmp_path)
    escalation = escalation_of(context)
    context.extraction.levels = [SimpleNamespace(base=base) for base in (0, 1, 1)]
    there = {"a": {0, 1}, "b": {0}, "c": {0, 1, 2}}
    context.features.level_ranges = there.get
    found = escalation._missing_features([("b", "a"), ("a", "c")], 2)
    assert found == [("a", 2), ("b", 1), ("b", 2)]


@pytest.mark.parametrize(
    ("levels", "has_all"), [([2, 2], True), ([2, -1], False), ([-1, -1], False)]
)
def test_learned_matching_is_complete_when_no_pair_lacks_learned_matches(
    levels: list[int], *, has_all: bool, tmp_path: Path
) -> None:
    pairs = (("a", "b"), ("b", "c"))
    context = context_in(tmp_path, learned_matching=Begun(2, pairs))
    escalation = escalation_of(context)
    matches: Any = escalation.matches
    matches.learned_levels = lambda _: dict(zip(pairs, levels, strict=True))
    assert escalation.has_all_learned_matches == has_all
