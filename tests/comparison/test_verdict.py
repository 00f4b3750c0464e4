"""The verdict, on results made for each of its sentences."""

from __future__ import annotations

from dataclasses import replace

import pytest

from colmap_affrect.comparison.pose_scores import PoseScores
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult
from colmap_affrect.comparison.verdict import cautions, changes, headline, verdict

NAMES = tuple("abcdef")
IDENTITY = {"rectifier": {"name": "identity"}, "escalation": []}
DENSE = {"rectifier": {"name": "dense-shapes"}, "escalation": []}
ON_DEMAND = {"rectifier": {"name": "identity"}, "escalation": [{"name": "asift"}]}


def seed_result(names, seed=0, correct=None):
    scores = None if correct is None else PoseScores(tuple(correct), {}, 15, {}, None)
    return SeedResult(
        seed=seed,
        model_names=(tuple(names),) if names else (),
        model_path="",
        num_points3D=900,
        mean_track_length=3.0,
        mean_reprojection_error_px=0.5,
        pair_inliers={("a", "b"): 50},
        scores=scores,
        wall_s={"verify": 1.0, "map": 3.0 + 2 * seed},
    )


def method(name, *names_of_seeds, options=None, seconds=6.0, **settings):
    seeds = tuple(seed_result(names, seed, **settings) for seed, names in enumerate(names_of_seeds))
    return MethodResult(name, seeds=seeds, wall_s={"extract": seconds}, options=options or {})


def default(*names_of_seeds, **settings):
    return method("default", *names_of_seeds, options=DENSE, **settings)


def comparison(*methods):
    return Comparison(NAMES, "photos", methods, (0, 1), 15, {}, {})


SIFT = method("sift", "abc", "abc")
AFFINE = method("sift-affine-dsp", "ab")
PLAIN = method("plain", "abcd", options=IDENTITY, seconds=7.0)


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        ([], "No method finished."),
        ([SIFT], "sift registers 3 of 6 photographs; no other method finished."),
        ([SIFT, default("abcde")], "default registers 5 of 6 photographs, sift 3."),
        (
            [SIFT, default("abc")],
            "No benefit on this set: no method registers more photographs than sift, which "
            "registers 3 of 6.",
        ),
        (
            [method("sift", "abc", correct="abc"), default("abcdef", correct="ab")],
            "No benefit on this set: no method correctly registers more photographs than sift, "
            "which correctly registers 3 of 6.",
        ),
        (
            [SIFT, default("abcd"), PLAIN],
            "default registers 4 of 6 photographs, sift 3. plain does as well without "
            "rectification.",
        ),
        (
            [SIFT, PLAIN],
            "plain registers 4 of 6 photographs, sift 3. Rectification is not needed for that.",
        ),
        (
            [PLAIN],
            "plain registers 4 of 6 photographs, no method more. COLMAP's SIFT was not run, so "
            "nothing can be said about a gain.",
        ),
        (
            [method("sift", ""), default("ab", "", "ab")],
            "Nothing was reconstructed: no method registers more than 2 of the 6 photographs.",
        ),
    ],
)
def test_headline_says_whether_anything_was_gained(methods, expected):
    assert headline(comparison(*methods)) == expected


@pytest.mark.parametrize(
    ("names", "expected", "missing"),
    [
        ("abcde", "gains d and e", "f"),
        ("abc", "the same photographs", "d, e and f"),
        ("ab", "loses c", "d, e and f"),
        ("abd", "gains d, loses c", "e and f"),
    ],
)
def test_change_names_the_photographs_and_the_cost(names, expected, missing):
    """Seconds: 6 + 1 + the mean of 3 and 5 for SIFT, 22 + 5 for the other."""
    texts = verdict(comparison(SIFT, default(names, names, seconds=22.0)))
    change = f"default against sift: {expected}, in 2.5 times the time (27.0 s against 11.0 s)."
    assert texts[1:] == (change, f"Registered by no method in most seeds: {missing}.")


def test_rectified_methods_are_set_against_unrectified_features_too():
    methods = [SIFT, default("abcd"), PLAIN, method("more", "abc", options=ON_DEMAND)]
    assert [text.split(":")[0] for text in changes(comparison(*methods))] == [
        "default against sift", "plain against sift", "more against sift",
        "default against plain", "more against plain",
    ]  # fmt: skip
    assert changes(comparison(default("abc"), AFFINE, SIFT))[0].startswith("default against sift:")
    (text,) = changes(comparison(default("abc"), AFFINE))
    assert text.startswith("default against sift-affine-dsp:")


def test_steadier_over_the_seeds_is_a_gain():
    unsteady, steady = method("sift", "abc", "abc", "a"), default("abc", "abc", "abc")
    first, text, *_ = verdict(comparison(unsteady, steady))
    assert first == "default registers 3 of 6 photographs, sift 2.3 on average (1 to 3)."
    assert "the same photographs, 0.7 more on average over the seeds" in text


def test_photographs_at_wrong_places_are_told():
    methods = [method("sift", "abc", correct="abc"), default("abcdef", correct="ab")]
    texts = verdict(comparison(*methods))
    assert "default against sift: loses c" in texts[1]
    assert "default registers 6 photographs, of which only 2 agree with the ground truth." in texts


FEW = {"doubtful": {"d": "held by only 9 points"}}
DOUBTFUL = [replace(seed_result("abcd", seed), **FEW) for seed in (0, 1)]
LOOSE = {"doubtful": dict.fromkeys("cd", "any focal length fits")}
NONE = "Registered by no method in most seeds: e and f."


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        ([SIFT, default("abcdef")], []),
        (
            [SIFT, default("abcdef", "ab")],
            ["Seeds disagree: photographs registered depend on chance, default 2 to 6.",
             "Registered by no method in most seeds: d, e and f."],
        ),
        (
            [SIFT, replace(default("abcd"), seeds=(*DOUBTFUL, seed_result("abcd", 2)))],
            [NONE, "Doubtful in default: d (held by only 9 points)."],
        ),
        ([SIFT, replace(PLAIN, seeds=(DOUBTFUL[0], seed_result("abcd", 2)))], [NONE]),
        (
            [replace(method(name), seeds=(replace(seed_result("abcd", 0), **LOOSE),))
             for name in ("sift", "default")],
            [NONE, "Doubtful in sift and default: c and d (any focal length fits)."],
        ),
        (
            [default("abcdef"), MethodResult("sift", failed="no weights")],
            ["sift failed: no weights"],
        ),
        ([MethodResult("sift", failed="no weights")], ["sift failed: no weights"]),
    ],
)  # fmt: skip
def test_what_is_missing_or_doubtful_in_most_seeds_is_told(methods, expected):
    assert list(cautions(comparison(*methods))) == expected


def test_contradictions_are_told_once_and_with_the_odd_one_first():
    """Default contradicts both others, who agree."""
    methods = (
        replace(SIFT, disagreements={"default": ("a",)}),
        replace(method("affine", "abc"), disagreements={"default": ("a", "b")}),
        replace(default("abcdef"), disagreements={"sift": ("a",), "affine": ("a", "b")}),
    )
    (text,) = cautions(comparison(*methods))
    assert text.startswith(
        "Doubtful: default disagrees with sift and affine about the pose of a and b;"
    )


def test_ground_truth_says_who_is_right_where_methods_contradict():
    scores = PoseScores(tuple("abcdef"), {("a", "b"): (1.0, 2.0)}, 1, {}, None)
    seeds = (replace(seed_result("abcdef"), scores=scores),)
    methods = (
        replace(method("sift"), seeds=seeds, disagreements={"default": ("a", "d")}),
        replace(default(), seeds=seeds, disagreements={"sift": ("a", "d")}),
    )
    (text,) = cautions(comparison(*methods))
    assert "about the pose of d;" in text
