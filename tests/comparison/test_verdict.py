"""The verdict: each rule on results made for it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from colmap_affrect.comparison import verdict as rules
from colmap_affrect.comparison.pose_scores import PoseScores
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult
from colmap_affrect.comparison.verdict import Change, verdict

NAMES = tuple("abcdef")
IDENTITY = {"rectifier": {"name": "identity"}, "escalation": []}
DENSE = {"rectifier": {"name": "dense-shapes"}, "escalation": []}


def seed_result(names, seed=0, correct=None, points=500, track=3.0):
    scores = None if correct is None else PoseScores(tuple(correct), {}, 15, {}, None)
    return SeedResult(
        seed=seed,
        model_names=(tuple(names),) if names else (),
        model_path="",
        num_points3D=900,
        mean_track_length=track,
        mean_observations=float(points),
        mean_reprojection_error_px=0.5,
        pair_inliers={("a", "b"): 50},
        scores=scores,
        wall_s={"verify": 1.0, "map": 3.0 + 2 * seed},
        num_observations=dict.fromkeys(names, points),
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
    assert rules.headline(comparison(*methods)) == [expected]


@pytest.mark.parametrize(
    ("names", "expected", "missing"),
    [
        ("abcde", "gains d and e", "f"),
        ("abd", "gains d, loses c", "e and f"),
    ],
)
def test_change_names_the_photographs_and_the_cost(names, expected, missing):
    """Seconds: 6 + 1 + the mean of 3 and 5 for SIFT, 22 + 5 for the other."""
    texts = verdict(comparison(SIFT, default(names, names, seconds=22.0)))
    change = f"default against sift: {expected}, in 2.5 times the time (27 s against 11 s)."
    assert texts[1:] == (change, f"Registered by no method in most seeds: {missing}.")


def test_steadier_over_the_seeds_is_a_gain():
    unsteady, steady = method("sift", "abc", "abc", "a"), default("abc", "abc", "abc")
    change = Change.between(steady, unsteady)
    assert (change.gained, change.lost) == ((), ())
    assert change.mean == pytest.approx(2 / 3)
    assert change.is_gain
    assert not Change.between(unsteady, steady).is_gain
    headline, text, *_ = verdict(comparison(unsteady, steady))
    assert headline == "default registers 3 of 6 photographs, sift 2.3 on average (1 to 3)."
    assert "the same photographs, 0.7 more on average over the seeds" in text


def test_seeds_that_disagree_are_named():
    text = rules.seeds_disagree(comparison(SIFT, default("abcd", "ab")))
    assert text == ["Seeds disagree: photographs registered depend on chance, default 2 to 4."]
    assert rules.seeds_disagree(comparison(SIFT)) == []


def test_doubts_of_most_seeds_are_told():
    few = {"doubtful": {"d": "held by only 9 points"}, "doubts": ("no parallax",)}
    seeds = [replace(seed_result("abcd", seed), **few) for seed in (0, 1)]
    doubtful = replace(default("abcd"), seeds=(*seeds, seed_result("abcd", 2)))
    texts = rules.doubts(comparison(SIFT, doubtful))
    assert texts == [
        "Doubtful in default: d (held by only 9 points).",
        "Doubtful in default: the whole model (no parallax).",
    ]
    assert doubtful.span("num_doubtful").max == 4
    seldom = replace(default("abcd"), seeds=(seeds[0], seed_result("abcd", 2)))
    assert rules.doubts(comparison(SIFT, seldom)) == []


def test_contradictions_are_told_once_and_with_the_odd_one_first():
    """Default contradicts both others, who agree."""
    methods = (
        replace(SIFT, disagreements={"default": ("a",)}),
        replace(method("affine", "abc"), disagreements={"default": ("a", "b")}),
        replace(default("abc"), disagreements={"sift": ("a",), "affine": ("a", "b")}),
    )
    (text,) = rules.contradictions(comparison(*methods))
    assert text.startswith(
        "Doubtful: default disagrees with sift and affine about the pose of a and b;"
    )


def test_ground_truth_says_who_is_right_where_methods_contradict():
    scores = PoseScores(("a", "b"), {("a", "b"): (1.0, 2.0)}, 1, {}, None)
    seeds = (replace(seed_result("abcd"), scores=scores),)
    methods = (
        replace(method("sift"), seeds=seeds, disagreements={"default": ("a", "d")}),
        replace(default("abcd"), disagreements={"sift": ("a", "d")}),
    )
    (text,) = rules.contradictions(comparison(*methods))
    assert "about the pose of d;" in text


def test_failures_come_last_and_affine_sift_is_the_second_reference():
    failed = MethodResult("default", failed="no weights")
    assert verdict(comparison(failed)) == ("No method finished.", "default failed: no weights")
    assert rules.reference_of(comparison(default("abc"), AFFINE)) is AFFINE
    assert rules.reference_of(comparison(AFFINE, SIFT)) is SIFT
