"""Evidence of matched pairs about focal lengths, and their vote."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from matched_scenes import (
    Array,
    View,
    all_pairs,
    in_a_box,
    looking,
    matched_pair,
    on_a_plane,
    views_around,
)

from colmap_affrect.colmap.camera_vote import MAX_SPREAD, MIN_LOG_EVIDENCE
from colmap_affrect.geometry.focal_evidence import MatchedPair, log_evidence
from colmap_affrect.geometry.focal_vote import (
    FOCALS,
    PRIOR_FOCAL,
    Ballot,
    FocalEstimate,
    Outcome,
    ballot,
    count,
    evidence_for_one,
)

Pairs = Sequence[tuple[tuple[int, int], MatchedPair]]


def scene(
    focals: Iterable[float],
    seed: int,
    views: Callable[..., list[View]] = views_around,
    points: Callable[..., Array] = in_a_box,
) -> Pairs:
    rng = np.random.default_rng(seed)
    return all_pairs(views(focals, rng), points(2000, rng), rng)


def ballots(pairs: Pairs, *, shared: bool, known: dict[int, float] | None = None) -> list[Ballot]:
    found = [ballot(pair, (0, 0) if shared else ids, known or {}) for ids, pair in pairs]
    return [item for item in found if item]


def holds(estimate: FocalEstimate, focal: float) -> bool:
    return estimate.low <= focal <= estimate.high


def coverage(num_trials: int, num_views: int) -> tuple[int, float]:
    """Return how many intervals hold the truth, and the widest."""
    hits, widest = 0, 1.0
    for seed in range(num_trials):
        focal = float(np.exp(np.random.default_rng(seed).uniform(np.log(0.7), np.log(2.5))))
        found = count(ballots(scene([focal] * num_views, 1000 + seed), shared=True), [0])
        hits += holds(found.estimates[0], focal)
        widest = max(widest, found.estimates[0].spread)
    return hits, widest


def test_intervals_hold_the_truth() -> None:
    hits, widest = coverage(2, 3)
    assert hits == 2
    assert widest < MAX_SPREAD


@pytest.mark.long
def test_nine_of_ten_intervals_hold_the_truth() -> None:
    hits, widest = coverage(40, 4)
    assert hits >= 36
    assert widest < MAX_SPREAD


def shared_against_single(focals: Sequence[float], seed: int) -> tuple[float, Outcome]:
    """Return by how much one camera is more likely than many, and the vote on many."""
    found = ballots(scene(focals, seed), shared=False)
    outcome = count(found, range(len(focals)), resample=False)
    return evidence_for_one(found) - outcome.log_evidence, outcome


def test_cameras_of_one_focal_length_count_as_one() -> None:
    assert shared_against_single((1.3, 1.3, 1.3), 6)[0] > MIN_LOG_EVIDENCE


def test_cameras_of_different_focal_lengths_do_not() -> None:
    focals = (1.0, 1.5, 1.2)
    difference, outcome = shared_against_single(focals, 5)
    assert difference < MIN_LOG_EVIDENCE
    assert all(holds(outcome.estimates[i], focal) for i, focal in enumerate(focals))


@pytest.mark.parametrize("side", [0, 1])
def test_a_known_camera_tells_the_other(side: int) -> None:
    pairs = scene((0.9, 1.7), 8)
    focals = (0.9, 1.7)
    (found,) = ballots(pairs, shared=False, known={side: focals[side]})
    other = 1 - side
    assert found.cameras == (other, other)
    assert holds(count([found], [other]).estimates[other], focals[other])
    assert ballots(pairs, shared=False, known=dict(enumerate(focals))) == []


def test_planes_tell_nothing() -> None:
    """Verification finds them planar already, most of the time."""
    spreads = []
    for seed in range(2):
        pairs = scene([1.36] * 3, seed, points=on_a_plane)
        spreads.append(count(ballots(pairs, shared=True), [0]).estimates[0].spread)
    assert min(spreads) > MAX_SPREAD


def test_wrong_pairs_do_not_move_the_result() -> None:
    pairs = scene([1.4] * 3, 9)
    honest = ballots(pairs, shared=True)
    rng = np.random.default_rng(3)
    wrong = []
    for (ids, pair), focals in zip(pairs, ((0.4, 0.4), (3.5, 3.5), (0.5, 4.0)), strict=True):
        other = matched_pair(*views_around(focals, rng), in_a_box(2000, rng), rng)
        wrong.append((ids, other if focals[0] == focals[1] else replace(
            pair, points1=other.points1[:90], points2=pair.points2[:90])))  # fmt: skip
    with_wrong = honest + ballots(wrong, shared=True)
    for found in (honest, with_wrong):
        assert count(found, [0]).estimates[0].focal == pytest.approx(1.4, rel=0.05)


def test_without_a_peak_the_focal_length_is_unknown() -> None:
    rising = Ballot((0, 0), np.linspace(-40.0, 0.0, len(FOCALS)))
    for evidence in (rising.evidence, rising.evidence[::-1]):
        found = count([Ballot((0, 0), evidence)] * 6, [0]).estimates[0]
        assert found == FocalEstimate(PRIOR_FOCAL, FOCALS[0], FOCALS[-1])
    assert count([], [4]).estimates[4].spread > 3.0


FOCALS1, FOCALS2 = 0.9, 1.6
FACTORS = np.array([0.6, 0.75, 1.0, 1.33, 1.7])


@pytest.fixture(scope="module")
def pair() -> MatchedPair:
    """Two cameras with different lenses, their axes far from crossing."""
    rng = np.random.default_rng(4)
    near = looking(FOCALS1, np.array([-1.0, 0.5, -2.6]), np.array([0.3, 0.2, 0.0]), 0.2)
    far = looking(FOCALS2, np.array([2.4, -0.9, -4.4]), np.array([-0.2, -0.3, 0.1]), -0.1)
    return matched_pair(near, far, in_a_box(2000, rng), rng)


def swapped(pair: MatchedPair) -> MatchedPair:
    return replace(pair, points1=pair.points2, points2=pair.points1, fundamental=pair.fundamental.T)


def grid(power: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    factors = FACTORS**power
    first, second = np.meshgrid(FOCALS1 * factors, FOCALS2 * factors, indexing="ij")
    return first.ravel(), second.ravel()


def test_evidence_is_largest_at_the_focal_lengths_of_both_images(pair: MatchedPair) -> None:
    found = log_evidence(pair, *grid())
    assert grid()[0][found.argmax()] == pytest.approx(FOCALS1)
    assert grid()[1][found.argmax()] == pytest.approx(FOCALS2)
    assert found.max() == 0.0
    assert found.min() < -30.0


def test_swapping_the_images_swaps_the_focal_lengths(pair: MatchedPair) -> None:
    first, second = grid(0.3)
    found = log_evidence(pair, first, second)
    other = log_evidence(swapped(pair), second, first)
    likely = found > -20.0
    assert likely.sum() >= 3
    assert np.allclose(found[likely], other[likely], atol=0.05)
    both = np.array([FOCALS1, FOCALS2])
    assert log_evidence(pair, both, both[::-1]).argmax() == 0
    assert log_evidence(swapped(pair), both, both[::-1]).argmax() == 1
