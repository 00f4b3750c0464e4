"""Which pairs are matched again: those that are likely to save most photographs per second."""

from __future__ import annotations

import math
from typing import Any

import pytest

from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.escalation import expected_gain
from colmap_affrect.escalation.expected_gain import (
    PairState,
    Step,
    StepPlanner,
    insecure_images,
    statistics_of,
    terms,
)
from colmap_affrect.recipes import Level, load_recipe, recipe_names

LEVELS = load_recipe("default").levels
COVERS = LEVELS[1]
LEARNED = LEVELS[2]


@pytest.mark.parametrize(("counts", "weak", "expected"), [
    ({"ab": 200, "ac": 150, "bc": 30}, "", ""),
    ({"ab": 200, "ac": 30, "bc": 0}, "", "c"),
    ({"ab": 200, "ac": 100, "bc": 0}, "", ""),
    ({"ab": 99}, "", "ab"),
    ({"ab": 200, "ac": 150, "bc": 100}, "c", "c"),
    ({}, "", ""),
])  # fmt: skip
def test_images_without_a_strong_pair_or_without_tracks_are_insecure(
    counts: dict[str, int], weak: str, expected: str
) -> None:
    pairs = {(a, b): count for (a, b), count in counts.items()}
    assert insecure_images(pairs, 100, weak) == set(expected)


def test_unverified_images_are_insecure_at_any_limit() -> None:
    assert insecure_images({("a", "b"): 0}, 0) == {"a", "b"}


def test_parts_come_by_size_with_lone_images() -> None:
    parts = connected_parts([("d", "e"), ("a", "c"), ("b", "c")], "abcdefg")
    assert parts == [set("abc"), set("de"), set("f"), set("g")]


@pytest.mark.parametrize("level", LEVELS[1:], ids=lambda level: level.name)
def test_what_hints_at_a_surface_makes_a_level_likelier_and_levels_differ(
    level: Level,
) -> None:
    statistics = statistics_of(level)
    few, many = (
        statistics.chance(terms(PairState(0, count), 0, 0)) for count in (0, 10)
    )
    assert 0.0 < few < 0.7 * many < many < 1.0
    weak, strong = (
        statistics.chance(terms(PairState(count), 0, 0)) for count in (15, 90)
    )
    assert few < weak < strong
    assert sum(statistics_of(other) == statistics for other in LEVELS[1:]) == 1


def test_levels_of_any_recipe_are_of_a_kind() -> None:
    for name in recipe_names():
        for rectifier in ("identity", "asift", "dense-shapes"):
            for level in load_recipe(name, [f"rectifier={rectifier}"]).levels:
                assert statistics_of(level).image_s > 0.0


def planner(
    inliers: dict[str, int],
    weights: dict[str, float],
    consistent: dict[str, int] | None = None,
    **given: Any,
) -> StepPlanner:
    """What a level may bring; ``tried`` by pair, others are optional."""
    tried = given.get("tried", {})
    states = {
        (pair[0], pair[1]): PairState(
            count, (consistent or {}).get(pair, 0), tried=tried.get(pair, 1)
        )
        for pair, count in inliers.items()
    }
    sizes = dict.fromkeys("abcdef", 1.0)
    weak = set(given.get("weakly_connected", ""))
    lacking = set(given.get("lacking", ""))
    registered = given.get("registered", "abc")
    return StepPlanner(states, weak, weights, sizes, [2, 4], lacking, registered, 100)


def best(found: StepPlanner, level: Level = COVERS, budget_s: float = math.inf) -> Step:
    return found.best_step(1, level, 0b10, budget_s)


def chosen(
    found: StepPlanner, level: Level = COVERS, budget_s: float = math.inf
) -> list[str]:
    return ["".join(pair) for pair in best(found, level, budget_s).pairs]


INLIERS = {
    "ab": 200,
    "ac": 150,
    "bc": 120,
    "ad": 0,
    "bd": 0,
    "cd": 0,
    "ae": 90,
    "be": 0,
}


def test_pairs_of_images_in_need_come_by_what_hints_at_a_surface() -> None:
    hints = {"ad": 1, "bd": 8, "cd": 2}
    assert chosen(planner(INLIERS, {"d": 1.0}, hints))[0] == "bd"
    assert chosen(planner(INLIERS, {"e": 1.0}, hints)) == [
        "ae"
    ]  # be is much less likely
    assert chosen(planner(INLIERS, {})) == []
    assert chosen(planner(INLIERS, {"a": 0.2})) == ["ae"]  # the others of a are strong


def test_no_step_takes_more_than_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expected_gain, "MAPPING_S", 0.0)
    hints = {"ad": 7, "bd": 8, "cd": 6}
    pairs = planner(INLIERS, {"d": 1.0}, hints)
    pair_s = statistics_of(COVERS).pair_s
    assert chosen(pairs, budget_s=1.01 * pair_s) == ["bd"]
    assert chosen(pairs, budget_s=0.99 * pair_s) == []
    assert chosen(pairs, LEARNED, budget_s=1.01 * pair_s) == []  # takes longer
    lacking = planner(INLIERS, {"d": 1.0}, hints, lacking="bd")  # features cost, too
    with_features_s = pair_s + 2 * statistics_of(COVERS).image_s
    assert "bd" not in chosen(lacking, budget_s=0.99 * with_features_s)
    assert chosen(lacking, budget_s=1.01 * with_features_s) == ["bd"]
    everything = best(pairs)
    assert everything.num_pairs == 3
    assert everything.all_seconds == pytest.approx(3 * pair_s)
    assert everything.photographs <= everything.all_photographs < 1.0


def test_while_there_is_no_model_strong_pairs_and_small_parts_count_too() -> None:
    pairs = {"ab": 200, "bc": 90, "de": 90}
    weights = dict.fromkeys("abcde", 1.0)
    none = best(planner(pairs, weights, registered="")).num_pairs
    some = best(planner(pairs, weights, registered="abc")).num_pairs
    assert (none, some) == (3, 1)


def test_mapping_after_a_step_takes_a_second_for_each_image() -> None:
    step = best(planner(INLIERS, {"d": 1.0}, {"bd": 8}))
    pairs_s = len(step.pairs) * statistics_of(COVERS).pair_s
    assert step.seconds == pytest.approx(6 * 1.0 + pairs_s)


def test_what_joins_a_part_counts_for_all_of_its_images() -> None:
    apart = {"ab": 200, "cd": 90, "ac": 0}
    small = best(planner(apart, {"c": 1.0}, {"ac": 3}))
    large = best(planner(apart, {"c": 1.0, "d": 1.0}, {"ac": 3}))
    assert (
        small.pairs == large.pairs == [("a", "c")]
    )  # and not the weak pair inside of it
    assert large.rate > 1.5 * small.rate


def test_images_are_not_saved_twice() -> None:
    many = {f"{name}f": 0 for name in "abcde"} | {
        "ab": 200,
        "bc": 200,
        "cd": 200,
        "de": 200,
    }
    likely = dict.fromkeys(many, 1000)
    assert len(chosen(planner(many, {"f": 1.0}, likely))) < 5


def test_levels_that_were_tried_are_done_and_strong_pairs_but_for_weakly_connected_images() -> (
    None
):
    pairs = {"ab": 200, "bc": 90}
    weights = {"a": 1.0, "b": 1.0}
    assert chosen(planner(pairs, weights)) == ["bc"]
    assert "ab" in chosen(planner(pairs, weights, weakly_connected="a"))
    assert chosen(
        planner(pairs, weights, weakly_connected="a", tried={"ab": 0b11})
    ) == ["bc"]


def test_a_level_that_verified_nothing_is_less_likely_to() -> None:
    fresh = statistics_of(COVERS).chance(terms(PairState(0, 3), 0, 0))
    assert statistics_of(COVERS).chance(terms(PairState(0, 3), 0, 5)) < 0.5 * fresh
    assert statistics_of(COVERS).chance(terms(PairState(0, 3), 5, 0)) > fresh


def test_the_more_mapping_costs_the_more_pairs_a_step_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs = planner(INLIERS, {"d": 1.0}, {"ad": 1, "bd": 8, "cd": 2}, lacking="c")
    monkeypatch.setattr(expected_gain, "MAPPING_S", 0.0)
    assert chosen(pairs) == ["bd"]
    rate = best(pairs).rate
    monkeypatch.setattr(expected_gain, "MAPPING_S", 10.0)
    assert chosen(pairs) == ["bd", "cd", "ad"]
    assert best(pairs).rate < 0.5 * rate


def test_an_image_that_verified_pairs_did_not_save_is_less_likely_saved_by_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(expected_gain, "MAPPING_S", 0.0)

    def rate(inliers: dict[str, int], registered: str = "abc") -> float:
        all_inliers = {"ab": 200, "bc": 200, **inliers}
        pairs = planner(all_inliers, {"d": 1.0}, {"ad": 5}, registered=registered)
        return best(pairs).rate

    lost, tied, tied_twice = (
        {"ad": 0} | more for more in ({}, {"bd": 200}, {"bd": 200, "cd": 200})
    )
    assert rate(tied) == pytest.approx(rate(lost) / 2)
    assert rate(tied_twice) == pytest.approx(rate(lost) / 3)
    assert rate(tied_twice, "ab") == pytest.approx(
        rate(lost) / 2
    )  # c is not in the model


def test_a_pair_is_strong_from_a_hundred_inliers_on() -> None:
    pairs = {"ab": 200, "ac": 100, "bc": 99}
    assert chosen(planner(pairs, {"c": 1.0}, registered="ab")) == ["bc"]


def test_measured_levels_are_as_likely_as_the_best_measured_matches_say() -> None:
    """Learned matches took the place of measured ones, of which five were consistent."""
    state = PairState(90, 40, level=2, tried=0b101, measured_worth=(0, 5))
    of_pair = {("a", "b"): state}
    sizes = {"a": 1.0, "b": 1.0}
    found = StepPlanner(of_pair, set(), {"b": 1.0}, sizes, [2, 4], (), "a", 100)
    (by_measured,) = found.candidates(1, COVERS, 0b1010)
    expected = statistics_of(COVERS).chance(terms(PairState(0, 5, tried=0b101), 0, 0))
    assert by_measured.chance == pytest.approx(expected)
    (by_learned,) = found.candidates(4, LEVELS[4], 0b10000)
    expected = statistics_of(LEVELS[4]).chance(terms(state, 0, 0))
    assert by_learned.chance == pytest.approx(expected)


def test_mapping_after_a_step_does_not_count_against_the_budget() -> None:
    pairs = planner(INLIERS, {"d": 1.0}, {"ad": 7, "bd": 8, "cd": 6})
    step = best(pairs, budget_s=1.01 * statistics_of(COVERS).pair_s)
    assert step.num_pairs == 1


def test_pairs_come_by_the_photographs_that_they_save_and_not_by_their_chances() -> (
    None
):
    pairs = planner({"ab": 200, "ad": 0, "ae": 0}, {"d": 0.1, "e": 1.0}, {"ad": 9})
    candidates = pairs.candidates(1, COVERS, 0b10)
    assert ["".join(one.pair) for one in candidates] == ["ae", "ad"]
    assert candidates[0].chance < candidates[1].chance


def test_verified_pairs_with_images_of_the_model_are_counted_by_image() -> None:
    found = planner(INLIERS, {"d": 1.0})._num_pairs_to_model
    assert found == {"a": 2, "b": 2, "c": 2, "e": 1}
