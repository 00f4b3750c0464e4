"""Which pairs may escalate: what joins parts first, then what ties images that hang loosely."""

from __future__ import annotations

import dataclasses

import pytest

from colmap_affrect.colmap.verification import connected_parts
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.stages.escalation_graph import EscalationGraph, insecure_images

PROMISING = EscalateOptions().min_num_consistent
BEST_ONE = EscalateOptions(num_best_pairs=1)


@pytest.mark.parametrize(
    ("counts", "weak", "expected"),
    [
        ({"ab": 200, "ac": 150, "bc": 30}, "", ""),
        ({"ab": 200, "ac": 30, "bc": 0}, "", "c"),
        ({"ab": 200, "ac": 100, "bc": 0}, "", ""),
        ({"ab": 99}, "", "ab"),
        ({"ab": 200, "ac": 150, "bc": 100}, "c", "c"),
        ({}, "", ""),
    ],
)
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


def graph(
    inliers: dict[str, int], consistent: dict[str, int], insecure: str = ""
) -> EscalationGraph:
    failed = {tuple(pair): consistent.get(pair, 0) for pair, n in inliers.items() if not n}
    return EscalationGraph({tuple(pair): n for pair, n in inliers.items()}, failed, set(insecure))


INLIERS = {"ab": 200, "ac": 150, "bc": 120, "ad": 0, "bd": 0, "cd": 0, "ce": 0, "de": 0, "be": 30}


def test_promising_pairs_and_the_best_of_images_outside_join() -> None:
    # d alone is outside: a, b, c and e are connected.
    pairs = graph(INLIERS, {"ad": 0, "bd": 1, "cd": PROMISING + 1, "de": PROMISING, "ce": 9})
    assert pairs.joining(BEST_ONE) == [("c", "d"), ("d", "e")]
    hopeless = graph(INLIERS, {"bd": PROMISING - 1, "ce": 9})
    assert hopeless.joining(BEST_ONE) == [("b", "d")]
    assert hopeless.joining(EscalateOptions(num_best_pairs=0)) == []
    assert graph({**INLIERS, "ad": 50}, {"cd": 9}).joining(BEST_ONE) == []


def test_pairs_that_a_level_brought_nothing_stop_but_for_the_best_of_each_part() -> None:
    inliers = {"ab": 200, "bc": 200, "de": 50, "ad": 0, "ae": 0, "be": 0, "cf": 0, "bf": 0}
    stalled = {("a", "d"), ("b", "e"), ("b", "f")}
    consistent = {"ad": PROMISING + 3, "ae": PROMISING, "be": PROMISING - 1, "bf": 0, "cf": 0}
    pairs = dataclasses.replace(graph(inliers, consistent, "e"), stalled=stalled)
    assert pairs.joining(BEST_ONE) == [("a", "d"), ("a", "e"), ("c", "f")]
    pairs = dataclasses.replace(pairs, stalled=stalled | {("c", "f")})
    assert pairs.joining(BEST_ONE) == [("a", "d"), ("a", "e"), ("c", "f")]
    assert pairs.hanging(BEST_ONE) == [("d", "e"), ("a", "e")]


def test_verified_and_promising_pairs_of_loose_images_escalate() -> None:
    consistent = {"ce": PROMISING, "de": PROMISING - 1, "ad": 9}
    assert graph(INLIERS, consistent, "e").hanging(EscalateOptions()) == [("c", "e"), ("b", "e")]
    assert graph(INLIERS, consistent).hanging(EscalateOptions()) == []


def test_pairs_of_loose_images_escalate_blindly_to_features_of_another_kind() -> None:
    """The best of each image that is not secure, by matches that agree, then by all."""
    tried: set[tuple[str, str]] = set()
    raw = {("a", "d"): 5, ("b", "d"): 7, ("c", "d"): 9, ("d", "e"): 3, ("c", "e"): 80}
    pairs = dataclasses.replace(graph(INLIERS, {"ad": 1}, "d"), num_raw=raw)
    two = EscalateOptions(num_blind_pairs=2)
    assert pairs.blind(two, tried) == [("a", "d"), ("c", "d")]
    of_d = [tuple(pair) for pair in ("ad", "bd", "cd", "de")]
    assert pairs.blind(EscalateOptions(), tried) == of_d
    assert pairs.blind(EscalateOptions(num_blind_pairs=0), tried) == []
    assert pairs.blind(two, {*tried, ("a", "d")}) == [("c", "d")]
    assert pairs.blind(two, {*tried, ("a", "d"), ("d", "e")}) == []
    assert graph(INLIERS, {}).blind(EscalateOptions(), tried) == []


def test_links_follow_images_that_gained_and_need_more() -> None:
    levels = {("b", "e"): 2, ("a", "c"): 2, ("c", "d"): 2}
    loose = graph(INLIERS, {}, "e")
    assert loose.links(levels, 2) == [("a", "b"), ("b", "c"), ("b", "e")]
    assert loose.links(levels, 1) == []
    assert graph(INLIERS, {}, "d").links(levels, 2) == []  # its pair is not verified
