"""What is matched again next: learned matching first, then by expected gain, within a budget."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest

from colmap_affrect.escalation import policy
from colmap_affrect.escalation.expected_gain import (
    PairState,
    Step,
    kind_of,
    statistics_of,
)
from colmap_affrect.escalation.policy import (
    EFFORTS,
    SMALL,
    Situation,
    is_hopeful,
    learned_step,
    matched_by_level,
    next_step,
    untried_by_level,
)
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.recipes import load_recipe

LEVELS = load_recipe("default").levels
KINDS = [kind_of(level) for level in LEVELS]
LEARNED = KINDS.index("learned")
NAMES = "abcde"


def situation(names: str | list[str] = NAMES, **given: Any) -> Situation:
    """A set of images of one megapixel; those in need are not registered."""
    pairs: list[Pair] = list(itertools.combinations(names, 2))
    weights = given.pop("weights", "de")
    done = given.pop("tried", {})
    sizes = dict.fromkeys(names, 1.0)
    values: dict[str, Any] = {
        "levels": LEVELS,
        "usable": [1, 2, 3, 4],
        "states": {
            pair: PairState(0, 3, tried=done.get("".join(pair), 1)) for pair in pairs
        },
        "weights": dict.fromkeys(weights, 1.0),
        "gains": dict.fromkeys(weights, 1.0),
        "weakly_connected": (),
        "anchored": (),
        "megapixels": [sizes] * len(LEVELS),
        "lacking": [set(names)] * len(LEVELS),
        "registered": [name for name in names if name not in weights],
    }
    return Situation(**values | given)


def test_learned_matching_of_a_small_set_is_of_all_pairs_of_images_in_need(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The others are matched, too, where that takes no longer than the first model."""
    assert len(learned_step(situation(), "normal").pairs) == 10
    monkeypatch.setattr(
        Situation, "first_model_s", 3 * statistics_of(LEVELS[LEARNED]).pair_s - 0.1
    )
    step = learned_step(situation(), "normal")
    assert step.level == LEARNED
    assert ["".join(pair) for pair in step.pairs] == [
        "ad",
        "ae",
        "bd",
        "be",
        "cd",
        "ce",
        "de",
    ]
    assert not learned_step(situation(weights=""), "normal").pairs
    assert not next_step(situation(weights=""), "high").step.pairs


def test_learned_matching_is_of_images_that_gain_what_their_pairs_take(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fifth of a photograph is worth two minutes; each image has four pairs."""
    monkeypatch.setattr(Situation, "first_model_s", 0.0)
    enough = 0.2 * 4 * statistics_of(LEVELS[LEARNED]).pair_s / 120.0
    unsure = situation(gains={"d": 0.9 * enough, "e": 1.1 * enough})
    found = {"".join(pair) for pair in learned_step(unsure, "normal").pairs}
    assert found == {"ae", "be", "ce", "de"}
    assert len(learned_step(unsure, "high").pairs) == 7
    sure = replace(unsure, gains=dict.fromkeys("de", 0.9 * enough))
    assert not learned_step(sure, "normal").pairs


def test_pairs_that_have_learned_matches_used_or_not_get_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Situation, "first_model_s", 0.0)
    before = situation()
    states = dict(before.states)
    states["a", "d"] = PairState(0, 3, level=LEARNED, tried=1 | 1 << LEARNED)
    states["a", "e"] = PairState(0, 3, learned_level=LEARNED)
    states["b", "d"] = PairState(
        0, 3, level=LEARNED, tried=0b111, measured_worth=(9, 0)
    )
    after = replace(before, states=states)
    found = {"".join(pair) for pair in learned_step(after, "normal").pairs}
    assert found == {"be", "cd", "ce", "de"}


def test_strong_pairs_of_images_in_need_are_matched_by_networks_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They may be wrong: of repeated structure, or of a flat part alone."""
    monkeypatch.setattr(Situation, "first_model_s", 0.0)
    strong = situation()
    states = {
        pair: replace(state, num_inliers=500) for pair, state in strong.states.items()
    }
    assert len(learned_step(replace(strong, states=states), "normal").pairs) == 7


def with_state(given: Situation, pair: Pair, state: PairState) -> Situation:
    """Return a situation in which another state is known of a pair."""
    return replace(given, states={**given.states, pair: state})


def test_mapping_after_each_step_counts_as_spent() -> None:
    before = situation()
    after = replace(before, rounds=[1, LEARNED, 1])
    assert after.seconds_spent() - before.seconds_spent() == pytest.approx(
        3 * len(NAMES)
    )


def test_mapping_after_steps_of_learned_matching_is_of_its_time_on_larger_sets() -> (
    None
):
    names = [f"{number:02}" for number in range(SMALL + 10)]
    before = situation(names, weights=names[:9])
    step = learned_step(replace(before, rounds=9 * [LEARNED]), "normal")
    assert 0 < step.num_pairs < learned_step(before, "normal").num_pairs
    left_s = before.first_model_s - 9 * before.mapping_s
    assert step.all_seconds - before.mapping_s <= left_s
    last = replace(before, rounds=11 * [LEARNED])  # 440 of 432 seconds
    assert not learned_step(last, "normal").pairs
    ten = replace(before, rounds=10 * [LEARNED])
    assert ten.seconds_spent() == pytest.approx(0.0)
    assert last.seconds_spent() == pytest.approx(8.0)
    others = replace(before, rounds=9 * [1])
    assert learned_step(others, "normal") == learned_step(before, "normal")
    assert others.seconds_spent() == pytest.approx(360.0)


def test_a_level_whose_matches_no_pair_uses_is_given_up_but_at_high_effort() -> None:
    """It was tried for the most promising pairs; models with its matches were worse."""
    tried = situation(usable=[1], tried={"ad": 0b11})
    assert tried.is_in_vain(1)
    assert not next_step(tried, "normal").step.pairs
    assert next_step(tried, "high").step.pairs
    used = with_state(tried, ("b", "d"), PairState(20, level=1, tried=0b11))
    assert not used.is_in_vain(1)
    assert next_step(used, "normal").step.pairs
    assert not situation(usable=[1]).is_in_vain(1)  # it was not tried


def test_no_level_is_given_up_while_nothing_is_registered_or_of_large_sets() -> None:
    assert not situation(weights=NAMES, tried={"ad": 0b11}).is_in_vain(1)
    many = [f"{number:02}" for number in range(policy.SMALL + 1)]
    assert not situation(many, weights=many[:2], tried={"0002": 0b11}).is_in_vain(1)


def test_models_that_have_become_worse_get_only_matches_that_are_there_already() -> (
    None
):
    before = situation(usable=[1, LEARNED])
    assert next_step(before, "normal").step.pairs
    assert not next_step(before, "normal", may_cost=False).step.pairs
    assert next_step(before, "high", may_cost=False).step.pairs
    states = {}
    for pair in before.states:
        states[pair] = PairState(0, 3, learned_level=LEARNED)
    there = replace(before, states=states)
    assert next_step(there, "normal", may_cost=False).step.level == LEARNED


def test_without_weights_other_levels_are_tried() -> None:
    assert learned_step(situation(usable=[1, 3]), "normal").pairs == ()
    assert next_step(situation(usable=[1, 3]), "normal").step.level in (1, 3)


def test_learned_matching_of_a_large_set_takes_as_long_as_the_first_model() -> None:
    names = [f"{number:03}" for number in range(SMALL + 1)]
    large = situation(names, weights=names)
    step = learned_step(large, "normal")
    assert 0 < len(step.pairs) < len(large.states)
    assert step.seconds <= large.first_model_s + len(names)
    assert (
        len(
            learned_step(
                situation(names[:SMALL], weights=names[:SMALL]), "normal"
            ).pairs
        )
        == 435
    )


def test_learned_matching_of_a_large_set_has_the_time_that_it_has_not_taken_yet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = [f"{number:03}" for number in range(SMALL + 1)]
    large = situation(names, weights=names)
    states = dict(large.states)
    states[names[0], names[1]] = PairState(0, 3, tried=1 | 1 << LEARNED)
    large = replace(large, states=states)
    asked = dict[str, float]()

    def best_step(_: Situation, number: int, budget_s: float) -> Step:
        asked[kind_of(LEVELS[number])] = budget_s
        return Step()

    monkeypatch.setattr(Situation, "best_step", best_step)
    learned_step(large, "normal")
    statistics = statistics_of(LEVELS[LEARNED])
    spent_s = 2 * statistics.image_s + statistics.pair_s
    assert asked == {"learned": pytest.approx(large.first_model_s - spent_s)}


def done_with_learned(**given: Any) -> Situation:
    """All pairs were matched by networks, beside what is there."""
    before = situation(**given)
    lacking = [set(NAMES)] * len(LEVELS)
    lacking[LEARNED] = set()
    states = {p: replace(s, learned_level=LEARNED) for p, s in before.states.items()}
    return replace(before, lacking=lacking, states=states)


def test_afterwards_the_budget_of_the_effort_counts() -> None:
    after = done_with_learned()
    assert not next_step(after, "low").step.pairs
    step = next_step(after, "normal").step
    assert step.pairs
    budget_s = EFFORTS["normal"].budget_s(after.first_model_s, has_model=True)
    assert step.seconds <= budget_s + len(NAMES)
    spent = {"".join(pair): 0b11111 for pair in after.states}
    assert not next_step(situation(tried=spent), "high").step.pairs


def test_learned_level_of_a_large_set_is_a_step_of_its_own() -> None:
    names = [f"{number:03}" for number in range(SMALL + 1)]
    assert next_step(situation(names, weights=names), "low").step.level == LEARNED


def test_learned_level_of_a_large_set_may_take_what_the_first_model_took() -> None:
    names = [f"{number:03}" for number in range(SMALL + 1)]
    large = situation(names, weights=names)
    spent = dict.fromkeys(large.states, PairState(0, 3, tried=0b1001))
    plan = next_step(replace(large, states=spent), "low")
    assert plan.step.level == LEARNED
    assert plan.left_s == pytest.approx(large.first_model_s)


def test_budget_is_a_least_time_or_that_of_the_first_model_and_more_without_one() -> (
    None
):
    normal = EFFORTS["normal"]
    assert normal.budget_s(1.0, has_model=True) == normal.least_s == 120.0
    assert normal.budget_s(1000.0, has_model=True) == 1000.0
    assert normal.budget_s(1.0, has_model=False) == normal.without_model_s == 900.0
    assert normal.budget_s(1000.0, has_model=False) == 1000.0
    times = [
        EFFORTS[name].budget_s(1000.0, has_model=True)
        for name in ("low", "normal", "high")
    ]
    assert times == [0.0, 1000.0, 5000.0]
    high = EFFORTS["high"]
    assert high.budget_s(1.0, has_model=True) == 600.0
    assert high.budget_s(1.0, has_model=False) == 3600.0


def test_levels_that_are_expected_to_save_a_fifth_of_a_photograph_are_tried() -> None:
    pairs = [("a", "b")]
    with_model = situation()
    assert not is_hopeful(Step(1, pairs, all_photographs=0.1), with_model)
    assert is_hopeful(Step(1, pairs, all_photographs=0.4), with_model)
    without_model = situation(registered=())
    assert is_hopeful(Step(1, pairs, all_photographs=0.1), without_model)
    assert not is_hopeful(Step(), without_model)


def test_what_is_spent_is_counted_but_for_learned_matching_of_small_sets() -> None:
    assert situation().seconds_spent() == 0.0
    assert done_with_learned().seconds_spent() == 0.0
    covers = situation(tried={"ab": 0b11})
    statistics = statistics_of(LEVELS[1])
    assert covers.seconds_spent() == pytest.approx(
        2 * statistics.image_s + statistics.pair_s
    )
    gone = replace(
        done_with_learned(), usable=[1, 3]
    )  # weights that are not there any more
    assert gone.seconds_spent() == 0.0
    names = [f"{number:03}" for number in range(SMALL + 1)]
    large = situation(names)
    states = {
        pair: replace(s, tried=1 | 1 << LEARNED) for pair, s in large.states.items()
    }
    large = replace(large, states=states)
    assert large.seconds_spent() == pytest.approx(
        large.seconds_spent_at(LEARNED) - large.first_model_s
    )


def test_little_hope_ends_it_but_while_nothing_is_registered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(policy, "MIN_PHOTOGRAPHS", 100.0)
    assert not next_step(done_with_learned(), "high").step.pairs
    assert not untried_by_level(done_with_learned())
    nothing = done_with_learned(weights=NAMES)
    assert not nothing.registered
    assert next_step(nothing, "normal").step.pairs


def test_images_that_measured_frames_hold_get_no_learned_warps() -> None:
    warps = KINDS.index("learned, warps")
    assert done_with_learned().best_step(warps, 1e9).pairs
    assert not done_with_learned(anchored="de").best_step(warps, 1e9).pairs


def test_what_was_tried_and_what_was_not_is_told_by_kind() -> None:
    after = done_with_learned()
    (one,) = matched_by_level(after)
    assert (one.kind, one.num_pairs) == ("learned", 10)
    assert one.core_s == pytest.approx(after.seconds_spent_at(LEARNED))
    kinds = {one.kind: one for one in untried_by_level(after)}
    assert "learned" not in kinds
    assert kinds["measured, all tilts"].num_pairs == 7
    assert kinds["measured, all tilts"].core_s > 0.0


def test_learned_matching_is_untried_where_some_pairs_lack_it() -> None:
    after = done_with_learned()
    states = dict(after.states)
    for pair, state in states.items():
        if "d" in pair:
            states[pair] = replace(state, learned_level=-1)
    kinds = {one.kind for one in untried_by_level(replace(after, states=states))}
    assert "learned" in kinds


@pytest.mark.parametrize(
    ("number", "needless_after"), [(1, [1, 3]), (2, [2, 4]), (3, [3]), (4, [4])]
)
def test_a_level_is_needless_after_itself_and_later_ones_with_frames_as_its_own(
    number: int, needless_after: list[int]
) -> None:
    """Frames of the first and the third level are measured, those of the others learned."""
    bits = sum(1 << later for later in needless_after)
    assert situation().needless_after(number) == bits


def test_the_level_that_saves_most_photographs_per_second_comes_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs = [("a", "d")]
    steps = {
        1: Step(1, pairs, 2.0, 50.0, all_photographs=2.0, all_seconds=60.0),
        2: Step(2),
        3: Step(3, pairs, 1.0, 10.0, all_photographs=1.0, all_seconds=25.0),
        4: Step(4, pairs, 9.0, 1.0, all_photographs=0.1, all_seconds=7.0),  # no hope
    }

    def best_step(_: Situation, number: int, budget_s: float) -> Step:
        assert budget_s == 120.0
        return steps[number]

    monkeypatch.setattr(Situation, "best_step", best_step)
    plan = next_step(situation(), "normal")
    assert plan.step is steps[3]
    assert plan.left_s == 85.0
    slow = replace(steps[1], all_seconds=1000.0)
    monkeypatch.setitem(steps, 1, slow)
    assert next_step(situation(), "normal").left_s == 120.0
