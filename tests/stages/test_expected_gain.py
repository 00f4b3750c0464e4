"""Which pairs are matched again: those that are likely to save most photographs per second."""

from __future__ import annotations

from typing import Any

import pytest

from colmap_affrect.colmap.verification import connected_parts
from colmap_affrect.recipes import EscalateOptions, Level, load_recipe, recipe_names
from colmap_affrect.stages import expected_gain
from colmap_affrect.stages.expected_gain import (
    ExpectedGain,
    PairState,
    gain_of,
    insecure_images,
    terms,
)

LEVELS = load_recipe("default").levels
COVERS, LEARNED = LEVELS[1], LEVELS[2]
PATIENT = EscalateOptions(max_seconds_per_megapixel=1e6)


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
def test_what_hints_at_a_surface_makes_a_level_likelier_and_levels_differ(level: Level) -> None:
    gain = gain_of(level)
    few, many = (gain.chance(terms(PairState(0, count), 0, 0)) for count in (0, 10))
    assert 0.0 < few < 0.7 * many < many < 1.0
    weak, strong = (gain.chance(terms(PairState(count), 0, 0)) for count in (15, 90))
    assert few < weak < strong
    assert sum(gain_of(other) == gain for other in LEVELS[1:]) == 1


def test_levels_of_any_recipe_are_of_a_kind() -> None:
    for name in recipe_names():
        for rectifier in ("identity", "asift", "dense-shapes"):
            for level in load_recipe(name, [f"rectifier={rectifier}"]).levels:
                assert gain_of(level).image_s > 0.0


def gains(
    inliers: dict[str, int],
    needs: dict[str, float],
    consistent: dict[str, int] | None = None,
    **given: Any,
) -> ExpectedGain:
    """What a level may bring; ``tried`` by pair, ``loose`` and ``lacking`` are optional."""
    tried = given.get("tried", {})
    states = {
        (pair[0], pair[1]): PairState(
            count, (consistent or {}).get(pair, 0), tried=tried.get(pair, 1)
        )
        for pair, count in inliers.items()
    }
    sizes = dict.fromkeys("abcdef", 1.0)
    loose, lacking = set(given.get("loose", "")), set(given.get("lacking", ""))
    registered = given.get("registered", "")
    return ExpectedGain(states, loose, needs, sizes, [2, 4], lacking, registered)


def chosen(
    found: ExpectedGain, options: EscalateOptions = PATIENT, level: Level = COVERS
) -> list[str]:
    _, pairs, _ = found.best_pairs(1, level, 0b10, options)
    return ["".join(pair) for pair in pairs]


INLIERS = {"ab": 200, "ac": 150, "bc": 120, "ad": 0, "bd": 0, "cd": 0, "ae": 90, "be": 0}


def test_pairs_of_images_in_need_come_by_what_hints_at_a_surface() -> None:
    hints = {"ad": 1, "bd": 8, "cd": 2}
    assert chosen(gains(INLIERS, {"d": 1.0}, hints))[0] == "bd"
    assert chosen(gains(INLIERS, {"e": 1.0}, hints)) == ["ae"]  # be is much less likely
    assert chosen(gains(INLIERS, {})) == []
    assert chosen(gains(INLIERS, {"a": 0.2})) == ["ae"]  # the others of a are strong


def test_nothing_is_worth_more_than_it_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expected_gain, "MAPPING_S", 0.0)
    pairs, hints = gains(INLIERS, {"d": 1.0}, {"bd": 8}), {"bd": 8}
    rate, (best,), seconds = pairs.best_pairs(1, COVERS, 0b10, PATIENT)
    assert seconds >= gain_of(COVERS).pair_s
    assert best == ("b", "d")
    just, below = (EscalateOptions(max_seconds_per_megapixel=f / rate) for f in (1.01, 0.99))
    assert chosen(pairs, just) == ["bd"]
    assert chosen(pairs, below) == []
    sure = gains(INLIERS, {"d": 0.5}, hints)  # half of the need, half of the worth
    assert chosen(sure, just) == []
    lacking = gains(INLIERS, {"d": 1.0}, hints, lacking="bd")  # features cost, too
    assert chosen(lacking, just) == []
    assert chosen(pairs, just, LEARNED) == []  # takes longer


def test_what_joins_a_part_counts_for_all_of_its_images() -> None:
    apart = {"ab": 200, "cd": 90, "ac": 0}
    small = gains(apart, {"c": 1.0}, {"ac": 3}).best_pairs(1, COVERS, 0b10, PATIENT)
    large = gains(apart, {"c": 1.0, "d": 1.0}, {"ac": 3}).best_pairs(1, COVERS, 0b10, PATIENT)
    assert small[1] == large[1] == [("a", "c")]  # and not the weak pair inside of it
    assert large[0] > 1.5 * small[0]


def test_images_are_not_saved_twice() -> None:
    many = {f"{name}f": 0 for name in "abcde"} | {"ab": 200, "bc": 200, "cd": 200, "de": 200}
    likely = dict.fromkeys(many, 1000)
    assert len(chosen(gains(many, {"f": 1.0}, likely))) < 5


def test_levels_that_were_tried_are_done_and_strong_pairs_but_for_loose_images() -> None:
    pairs = {"ab": 200, "bc": 90}
    needs = {"a": 1.0, "b": 1.0}
    assert chosen(gains(pairs, needs)) == ["bc"]
    assert "ab" in chosen(gains(pairs, needs, loose="a"))
    assert chosen(gains(pairs, needs, loose="a", tried={"ab": 0b11})) == ["bc"]


def test_a_level_that_verified_nothing_is_less_likely_to() -> None:
    fresh = gain_of(COVERS).chance(terms(PairState(0, 3), 0, 0))
    assert gain_of(COVERS).chance(terms(PairState(0, 3), 0, 5)) < 0.5 * fresh
    assert gain_of(COVERS).chance(terms(PairState(0, 3), 5, 0)) > fresh


def test_the_more_mapping_costs_the_more_pairs_a_step_has(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = gains(INLIERS, {"d": 1.0}, {"ad": 1, "bd": 8, "cd": 2}, lacking="c")
    assert chosen(pairs) == ["bd"]
    rate = pairs.best_pairs(1, COVERS, 0b10, PATIENT)[0]
    monkeypatch.setattr(expected_gain, "MAPPING_S", 10.0)
    assert chosen(pairs) == ["bd", "cd", "ad"]
    assert pairs.best_pairs(1, COVERS, 0b10, PATIENT)[0] < 0.5 * rate


def test_an_image_that_verified_pairs_did_not_save_is_less_likely_saved_by_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(expected_gain, "MAPPING_S", 0.0)

    def rate(inliers: dict[str, int], registered: str = "abc") -> float:
        all_inliers = {"ab": 200, "bc": 200, **inliers}
        pairs = gains(all_inliers, {"d": 1.0}, {"ad": 5}, registered=registered)
        return pairs.best_pairs(1, COVERS, 0b10, PATIENT)[0]

    lost, tied, tied_twice = (
        {"ad": 0} | more for more in ({}, {"bd": 200}, {"bd": 200, "cd": 200})
    )
    assert rate(tied) == pytest.approx(rate(lost) / 2)
    assert rate(tied_twice) == pytest.approx(rate(lost) / 3)
    assert rate(tied_twice, "ab") == pytest.approx(rate(lost) / 2)  # c is not in the model
