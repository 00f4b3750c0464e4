"""The verdict: each rule on results made for it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from colmap_affrect.comparison import verdict as rules
from colmap_affrect.comparison.results import Comparison, MethodResult, PoseScores, SeedResult
from colmap_affrect.comparison.verdict import Change, verdict

NAMES = tuple("abcdef")
IDENTITY = {"rectifier": {"name": "identity"}, "escalation": []}
DENSE = {"rectifier": {"name": "dense-shapes"}, "escalation": []}
ON_DEMAND = {"rectifier": {"name": "identity"}, "escalation": [{"name": "asift"}]}


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


def comparison(*methods):
    return Comparison(NAMES, "photos", methods, (0, 1), 15, {}, {})


SIFT = method("sift", "abc", "abc")


def test_gain_names_the_photographs_and_the_cost():
    """Seconds: 6 + 1 + the mean of 3 and 5 for SIFT, 22 + 5 for the other."""
    headline, change, *rest = verdict(
        comparison(SIFT, method("default", "abcde", "abcde", options=DENSE, seconds=22.0))
    )
    assert headline == "default registers 5 of 6 photographs, sift 3."
    assert change == (
        "default against sift: gains d and e, in 2.5 times the time (27 s against 11 s)."
    )
    assert rest == ["Registered by no method: f."]


@pytest.mark.parametrize("names", ["abc", "ab", "abd"])
def test_no_benefit_where_as_many_or_fewer_are_registered(names):
    headline, change, *_ = verdict(comparison(SIFT, method("default", names, names, options=DENSE)))
    assert headline == (
        "No benefit on this set: no method registers more photographs than sift, which registers "
        "3 of 6."
    )
    expected = {"abc": "the same photographs", "ab": "loses c", "abd": "gains d, loses c"}
    assert f"default against sift: {expected[names]}, in 1.0 times" in change


def test_steadier_over_the_seeds_is_a_gain():
    unsteady = method("sift", "abc", "abc", "a")
    steady = method("default", "abc", "abc", "abc", options=DENSE)
    change = Change.between(steady, unsteady)
    assert (change.gained, change.lost) == ((), ())
    assert change.mean == pytest.approx(2 / 3)
    assert change.is_gain
    assert not Change.between(unsteady, steady).is_gain
    headline, text, *_ = verdict(comparison(unsteady, steady))
    assert headline == ("default registers 3 of 6 photographs, sift 2.3 on average (1 to 3).")
    assert "the same photographs, 0.7 more on average over the seeds" in text


def test_gain_that_unrectified_features_have_too_is_not_due_to_rectification():
    rectified = method("default", "abcd", options=DENSE)
    plain = method("plain", "abcd", options=IDENTITY, seconds=7.0)
    (headline,) = rules.headline(comparison(SIFT, rectified, plain))
    assert headline.endswith("sift 3. plain does as well without rectification.")
    (headline,) = rules.headline(comparison(SIFT, replace(plain, wall_s={})))
    assert headline.endswith("Rectification is not needed for that.")
    texts = rules.changes(comparison(SIFT, rectified, plain))
    assert [text.split(":")[0] for text in texts] == [
        "default against sift", "plain against sift", "default against plain",
    ]  # fmt: skip


def test_what_counts_as_rectified():
    assert rules.is_unrectified(method("x", "a", options=IDENTITY))
    assert rules.is_rectified(method("x", "a", options=DENSE))
    assert rules.is_rectified(method("x", "a", options=ON_DEMAND))
    assert not rules.is_rectified(SIFT)
    assert not rules.is_unrectified(SIFT)


def test_with_ground_truth_only_correct_photographs_count():
    sift = method("sift", "abc", correct="abc")
    wrong = method("default", "abcdef", correct="ab", options=DENSE)
    texts = verdict(comparison(sift, wrong))
    assert texts[0] == (
        "No benefit on this set: no method correctly registers more photographs than sift, which "
        "correctly registers 3 of 6."
    )
    assert "default against sift: loses c" in texts[1]
    assert "default registers 6 photographs, of which only 2 agree with the ground truth." in texts


def test_seeds_that_disagree_are_named():
    text = rules.seeds_disagree(comparison(SIFT, method("default", "abcd", "ab")))
    assert text == ["Seeds disagree: photographs registered depend on chance, default 2 to 4."]
    assert rules.seeds_disagree(comparison(SIFT)) == []


def test_pair_is_no_reconstruction():
    (text,) = rules.headline(comparison(method("sift", ""), method("default", "ab", "", "ab")))
    assert text == (
        "Nothing was reconstructed: no method registers more than 2 of the 6 photographs."
    )


@pytest.mark.parametrize(("points", "doubtful"), [(39, True), (40, False)])
def test_gained_photograph_on_few_points_is_doubtful(points, doubtful):
    gaining = method("default", "abcd", options=DENSE, points=points)
    texts = rules.few_observations(comparison(SIFT, gaining))
    assert texts == ["Doubtful: in default few points hold d (39 points)."] * doubtful
    confirmed = method("default", "abcd", options=DENSE, points=points, correct="abcd")
    assert rules.few_observations(comparison(SIFT, confirmed)) == []
    same = method("default", "abc", options=DENSE, points=points)
    assert rules.few_observations(comparison(SIFT, same)) == []


@pytest.mark.parametrize(("track", "doubtful"), [(2.19, True), (2.2, False)])
def test_gain_of_short_tracks_is_doubtful(track, doubtful):
    gaining = method("default", "abcd", options=DENSE, track=track)
    texts = rules.short_tracks(comparison(SIFT, gaining))
    assert len(texts) == doubtful
    assert all(
        text.startswith("Doubtful: the mean track length of default is 2.19") for text in texts
    )
    assert rules.short_tracks(comparison(SIFT, method("x", "abc", track=track))) == []


def test_poses_that_change_with_the_seed_are_doubtful():
    (text,) = rules.unstable_poses(comparison(replace(SIFT, unstable_names=("a", "c"))))
    assert text.startswith("Doubtful: in sift the poses of a and c contradict")


def test_contradictions_are_told_once_and_with_the_odd_one_first():
    """Default contradicts both others, who agree."""
    methods = (
        replace(SIFT, disagreements={"default": ("a",)}),
        replace(method("affine", "abc"), disagreements={"default": ("a", "b")}),
        replace(method("default", "abc"), disagreements={"sift": ("a",), "affine": ("a", "b")}),
    )
    (text,) = rules.contradictions(comparison(*methods))
    assert text.startswith(
        "Doubtful: default disagrees with sift and affine about the pose of a and b;"
    )


def test_failures_and_missing_sift_are_said():
    failed = MethodResult("default", failed="no weights")
    assert verdict(comparison(failed)) == ("No method finished.", "default failed: no weights")
    texts = verdict(comparison(method("plain", "abc", options=IDENTITY), failed))
    assert texts[0].startswith("plain registers most photographs, 3 of 6. COLMAP's SIFT was not")
    assert texts[-1] == "default failed: no weights"
    assert verdict(comparison(SIFT))[0] == (
        "sift registers 3 of 6 photographs; no other method finished."
    )


def test_affine_sift_is_the_reference_where_there_is_no_other():
    affine = method("sift-affine-dsp", "ab")
    assert rules.reference_of(comparison(method("default", "abc"), affine)) is affine
    assert rules.reference_of(comparison(affine, SIFT)) is SIFT
