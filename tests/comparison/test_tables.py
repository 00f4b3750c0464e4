"""The table of methods and the sentences about it, on results made for them."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from colmap_affrect.comparison.results import (
    Comparison,
    MethodResult,
    PoseScores,
    SeedResult,
)
from colmap_affrect.comparison.tables import (
    conclusion,
    headline,
    notes,
    summary,
    table,
    to_json,
)

NAMES = tuple("abcdef")
FIRST = "Photographs that are registered:"
Methods = list[MethodResult]


def method(
    name: str, *names_of_seeds: str, correct: str | None = None, **settings: Any
) -> MethodResult:
    """A method whose photographs are all sure, but for those that are doubtful."""
    seeds = []
    for seed, names in enumerate(names_of_seeds):
        doubtful = {n: why for n, why in settings.items() if n in names}
        scores = None
        if correct is not None:
            scores = PoseScores(tuple(correct), tuple(set(names) - set(correct)), 0.5)
        result = SeedResult(
            seed=seed,
            models=(tuple(names),) if names else (),
            model_path="",
            verified_pairs=50,
            points3D=900,
            mean_track_length=3.0,
            mean_reprojection_error_px=0.25,
            sure=tuple(name for name in names if name not in doubtful),
            doubtful=doubtful,
            wall_s={"verify": 1.0, "map": 3.0 + 2 * seed},
            scores=scores,
        )
        seeds.append(result)
    return MethodResult(name, seeds=tuple(seeds), wall_s={"extract": 6.0})


def comparison(*methods: MethodResult) -> Comparison:
    return Comparison(NAMES, "photos", methods, (0, 1), 15, {}, {})


SIFT = method("sift", "abc")
COLMAP = method("sift-colmap", "ab")
DEFAULT = method("default", NAMES)
FAILED = MethodResult("sift", failed="no weights")


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        ([], ["No method finished."]),
        (
            [SIFT, method("default", "abcd", "abcde"), COLMAP],
            [
                FIRST,
                "COLMAP as it is (sift-colmap): 2 of 6, 2 of them sure",
                "our mapper with SIFT (sift): 3 of 6, 3 of them sure",
                "our features (default): 4.5 (4-5) of 6, 4.5 (4-5) of them sure",
            ],
        ),
        (
            [
                method("sift", "abc", correct="abc"),
                method("default", "abcdef", correct="ab"),
            ],
            [
                FIRST,
                "our mapper with SIFT (sift): 3 of 6, 3 of them correct",
                "our features (default): 6 of 6, 2 of them correct",
            ],
        ),
        (
            [method("sift", ""), method("default", "ab", "")],
            [
                "Nothing was reconstructed: no method registers more than 2 of the 6 photographs."
            ],
        ),
    ],
)
def test_headline_counts_what_each_kind_of_method_registers(
    methods: Methods, expected: list[str]
):
    assert headline(comparison(*methods)) == expected


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        (
            [SIFT, method("default", "abd", "abde", "bd")],
            ["Only sift registers c.", "Only default registers d.",
             "Registered by no method: e, f."],
        ),
        ([DEFAULT, FAILED], ["sift failed: no weights"]),
        (
            [replace(DEFAULT, lacks="fetch it")],
            ["default ran without some of its weights; get them, and compare again with "
             "--overwrite: fetch it"],
        ),
        ([FAILED], ["sift failed: no weights"]),
        (
            [method("default", NAMES, c="any focal length fits", d="any focal length fits")],
            ["Doubtful in default: c, d: any focal length fits."],
        ),
        ([method("default", NAMES, correct="abcdef", c="any focal length fits")], []),
    ],
)  # fmt: skip
def test_what_is_missing_doubtful_or_failed_in_most_seeds_is_told(
    methods: Methods, expected: list[str]
):
    assert notes(comparison(*methods)) == expected


SLOW = replace(method("default", NAMES), wall_s={"extract": 17.0})


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        (
            [COLMAP, SLOW],
            "default surely places 4 more photographs than COLMAP, in 2.1 times the time.",
        ),
        (
            [SIFT, method("default", "abd")],
            "COLMAP's SIFT with our mapper does as well here: 3 placed surely by it and by "
            "default, which takes about the same time.",
        ),
        (
            [COLMAP, SIFT, method("default", "a")],
            "COLMAP does better here: it surely places 1 more photograph; default takes about "
            "the same time.",
        ),
        (
            [method("sift-colmap", "abc", correct="ab"), method("default", "abcd", correct="abd")],
            "default correctly places 1 more photograph than COLMAP, in about the same time.",
        ),
        ([SIFT], ""),
        ([DEFAULT], ""),
    ],
)  # fmt: skip
def test_a_comparison_ends_in_a_sentence_that_answers_it(
    methods: Methods, expected: str
):
    compared = comparison(*methods)
    assert conclusion(compared) == expected
    assert summary(compared).replace("\n", " ").endswith(expected)


def test_table_has_the_best_method_first_and_ranges_over_the_seeds():
    without = replace(method("none", ""), peak_memory_bytes=10**8)
    columns = table(comparison(without, SIFT, method("default", "abcd", "abcde")))
    assert columns == {
        "registered": ["4.5 (4-5)", "3", "0"],
        "sure": ["4.5 (4-5)", "3", "0"],
        "unsure": ["0", "0", "0"],
        "doubtful": ["0", "0", "0"],
        "pairs": ["50", "50", "50"],
        "points": ["900", "900", "-"],
        "track": ["3", "3", "-"],
        "px": ["0.25", "0.25", "-"],
        "seconds": ["11.0", "10.0", "10.0"],
        "MB": ["0", "0", "100"],
    }


@pytest.fixture
def compared() -> Comparison:
    return comparison(SIFT, method("default", "abcd", "abcde", correct="abc"), FAILED)


def test_json_has_the_verdict_and_its_ending(compared: Comparison) -> None:
    values = json.loads(to_json(compared))
    ending = conclusion(compared)
    assert ending
    assert values["conclusion"] == ending
    assert values["verdict"] == [*headline(compared), *notes(compared), ending]
    assert (values["images_total"], values["registered_by_none"]) == (6, ["e", "f"])


def test_json_has_each_method_as_a_whole_and_by_seed(compared: Comparison) -> None:
    default = json.loads(to_json(compared))["methods"]["default"]
    assert default["registered"] == {"mean": 4.5, "min": 4.0, "max": 5.0}
    assert default["registered_names"] == {"0": [*"abcd"], "1": [*"abcde"]}
    assert (default["wall_s"]["map"], default["total_s"]) == (4.0, 11.0)
    seed = default["seeds"][0]
    assert (seed["registered"], seed["correct"], seed["points3D"]) == (4, 3, 900)
    assert seed["scores"]["correct_names"] == [*"abc"]


def test_summary_has_a_row_for_each_method(compared: Comparison) -> None:
    found, _, text = summary(compared).partition("\n\n")
    rows = [line.split() for line in found.splitlines()]
    assert [row[0] for row in rows] == ["method", "default", "sift", "sift"]
    assert rows[-1] == ["sift", "failed"]
    assert max(map(len, text.splitlines())) <= 88
