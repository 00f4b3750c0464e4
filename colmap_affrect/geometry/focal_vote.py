"""A vote of matched pairs over the focal lengths of the cameras that took their images.

Every pair votes for the focal lengths of its two images; a pair that is wrong counts for little
more than one that is right (:data:`MAX_VOTE`). Images of one camera vote together. Cameras that are
connected by pairs inform each other: belief propagation on the graph of the cameras.

Focal lengths are in units of the longer side.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.geometry.focal_evidence import (
    MAX_MISFIT_OF_CANDIDATES,
    MatchedPair,
    log_evidence,
)

FOCALS = np.geomspace(0.3, 10.0, 41)  # candidates, 9 per cent apart: 120 to 6 degrees
STEP = 2  # where two cameras are asked for at once every second candidate will do

MIN_PROMISE = -30.0
"""Tables of two cameras are made at every second of these candidates first; the others are looked
at beside those that fall short of the best one by less."""

MAX_LOSS = 2.0  # of log-evidence, at most, between two candidates of such a table
PRIOR_FOCAL, PRIOR_SIGMA = 1.1, 0.6  # most lenses: .6 to 2 longer sides (logarithmic)
MAX_VOTE = 3.0  # largest difference of log-evidence that one pair makes
NUM_ITERATIONS, DAMPING = 30, 0.3  # of belief propagation
NUM_RESAMPLES = 50  # votes among pairs drawn with replacement: do the pairs agree?
LOW, HIGH = 0.05, 0.95  # quantiles of an interval


@dataclass(frozen=True)
class Ballot:
    """The votes of one pair."""

    cameras: tuple[int, int]  # of both images, twice the same where they share it
    # (F,) for one camera, also where the other one is known, else (C, C) for every second candidate
    evidence: Array


@dataclass(frozen=True)
class FocalEstimate:
    """What a vote says of one camera, longer sides."""

    focal: float  # most likely one
    low: float  # lower end of the interval that holds it with 90 per cent
    high: float  # upper end

    @property
    def spread(self) -> float:
        """Ratio of both ends."""
        return self.high / self.low


@dataclass(frozen=True)
class Outcome:
    """Estimates by camera, and the logarithm of the evidence for these cameras as a whole."""

    estimates: Mapping[int, FocalEstimate]
    log_evidence: float


def ballot(
    pair: MatchedPair, cameras: tuple[int, int], known: Mapping[int, float]
) -> Ballot | None:
    """Ask a pair about the cameras of its images; None where both focal lengths are known."""
    open_ones = sorted({camera for camera in cameras if camera not in known})
    if not open_ones:
        return None
    if len(open_ones) == 2:
        return Ballot(cameras, _table(pair))
    first, second = (np.full_like(FOCALS, known[c]) if c in known else FOCALS for c in cameras)
    return Ballot((open_ones[0], open_ones[0]), log_evidence(pair, first, second))


@lru_cache(maxsize=256)  # who shares a camera is asked first
def _table(pair: MatchedPair) -> Array:
    """Return the evidence for two cameras; others that do not fit get the best of theirs."""
    focals = FOCALS[::STEP]
    grid = np.stack(np.meshgrid(focals, focals, indexing="ij"), axis=2)
    table = np.full(grid.shape[:2], np.nan)
    table[::2, ::2] = log_evidence(
        pair, *grid[::2, ::2].reshape(-1, 2).T, max_misfit=MAX_MISFIT_OF_CANDIDATES
    ).reshape(grid[::2, ::2].shape[:2])
    if table[::2, ::2].any():
        promising = cv2.dilate((table > MIN_PROMISE).astype(np.uint8), np.ones((3, 3))) > 0
        table[promising] = log_evidence(pair, *grid[promising].T)
        if table[promising].any():
            return _softened(np.where(promising, table, MIN_PROMISE))
    return np.zeros_like(table)  # the pair fits no camera


def _softened(table: Array) -> Array:
    """Widen a table so that no peak is lost between candidates.

    Evidence is a parabola: halfway to the next candidate it falls by a quarter of the second
    difference.
    """
    row, column = np.unravel_index(table.argmax(), table.shape)
    lines = (np.pad(table[row], 1, "edge"), np.pad(table[:, column], 1, "edge"))
    bends = [
        line[at + 1] - 0.5 * (line[at] + line[at + 2])
        for line, at in zip(lines, (column, row), strict=True)
    ]
    return np.asarray(table * min(1.0, 4.0 * MAX_LOSS / max(*bends, 1e-9)))


def evidence_for_one(ballots: Sequence[Ballot]) -> float:
    """Return the log-evidence, as of :func:`count`, if all cameras of the ballots are one."""
    focals = _candidates(ballots)
    same = [
        Ballot((0, 0), item.evidence if item.evidence.ndim == 1 else np.diagonal(item.evidence))
        for item in ballots
    ]
    return _propagate(same, [0], focals)[1]


def _candidates(ballots: Sequence[Ballot]) -> Array:
    return FOCALS if all(item.evidence.ndim == 1 for item in ballots) else FOCALS[::STEP]


def count(ballots: Sequence[Ballot], cameras: Sequence[int], *, resample: bool = True) -> Outcome:
    """Count the votes on all these cameras; ``resample`` widens intervals where pairs disagree.

    One whose best candidate is the first or the last has the prior's focal length.
    """
    focals = _candidates(ballots)
    marginals, total = _propagate(ballots, cameras, focals)
    draws = [marginals]
    rng = np.random.default_rng(0)
    for _ in range(NUM_RESAMPLES if resample and ballots else 0):
        chosen = rng.integers(len(ballots), size=len(ballots))
        draws.append(_propagate([ballots[i] for i in chosen], cameras, focals)[0])
    peaks = np.stack([_peaks(draw, focals) for draw in draws])
    sums = np.pad(np.cumsum(marginals, axis=1), ((0, 0), (1, 0)))
    half_step = (focals[1] / focals[0]) ** 0.5
    bounds = np.append(focals / half_step, focals[-1] * half_step)
    estimates = {}
    for row, camera in enumerate(cameras):
        if marginals[row].argmax() in (0, len(focals) - 1):  # there is no peak
            estimates[camera] = FocalEstimate(PRIOR_FOCAL, focals[0], focals[-1])
            continue
        inside = [np.interp(level, sums[row], bounds) for level in (LOW, HIGH)]
        among = np.quantile(peaks[:, row], [LOW, HIGH])
        low, high = min(inside[0], among[0]), max(inside[1], among[1])
        estimates[camera] = FocalEstimate(float(peaks[0, row]), float(low), float(high))
    return Outcome(estimates, total)


def _peaks(marginals: Array, focals: Array) -> Array:
    """Return the (C,) most likely focal lengths, between the candidates."""
    best = np.clip(marginals.argmax(axis=1), 1, len(focals) - 2)
    rows = np.arange(len(marginals))
    left, middle, right = (np.log(marginals[rows, best + i] + 1e-300) for i in (-1, 0, 1))
    curvature = np.minimum(left - 2 * middle + right, -1e-9)
    shift = np.clip(0.5 * (left - right) / curvature, -1.0, 1.0)
    return np.asarray(focals[best] * (focals[1] / focals[0]) ** shift)


def _propagate(
    ballots: Sequence[Ballot], cameras: Sequence[int], focals: Array
) -> tuple[Array, float]:
    """Return the (C, F) marginals, and the logarithm of the evidence (Bethe's approximation)."""
    row_of = {camera: row for row, camera in enumerate(cameras)}
    prior = np.exp(-0.5 * (np.log(focals / PRIOR_FOCAL) / PRIOR_SIGMA) ** 2)
    own = np.tile(np.log(prior / prior.sum()), (len(cameras), 1))
    tables: dict[tuple[int, int], Array] = defaultdict(lambda: np.zeros((len(focals),) * 2))
    for item in ballots:
        first, second = (row_of[camera] for camera in item.cameras)
        evidence = item.evidence
        if evidence.ndim == 1 and len(evidence) != len(focals):
            evidence = evidence[::STEP]
        votes = np.logaddexp(evidence, -MAX_VOTE) - np.logaddexp(0.0, -MAX_VOTE)
        if evidence.ndim == 1:
            own[first] += votes
        elif first < second:
            tables[first, second] += votes
        else:
            tables[second, first] += votes.T
    edges = np.array(sorted(tables), int).reshape(-1, 2)
    # every edge twice, once for each direction a message takes
    sources, targets = edges.T.ravel(), edges[:, ::-1].T.ravel()
    forward = [np.exp(tables[first, second]) for first, second in edges.tolist()]
    links = np.array(forward + [table.T for table in forward]).reshape(-1, *[len(focals)] * 2)
    messages = np.zeros((len(links), len(focals)))
    opposite = np.roll(np.arange(len(links)), len(edges))
    for _ in range(NUM_ITERATIONS if len(edges) else 0):
        outgoing = _beliefs(own, targets, messages)[sources] - messages[opposite]
        outgoing = np.exp(outgoing - outgoing.max(axis=1, keepdims=True))
        new = np.log(np.einsum("ef,efg->eg", outgoing, links))
        new -= new.max(axis=1, keepdims=True)
        messages = DAMPING * messages + (1.0 - DAMPING) * new
    beliefs = _beliefs(own, targets, messages)
    sums = np.logaddexp.reduce(beliefs, axis=1)
    total = float(sums.sum())
    cavities = beliefs[sources] - messages[opposite]
    for edge, (first, second) in enumerate(edges.tolist()):
        joint = cavities[edge][:, None] + tables[first, second] + cavities[edge + len(edges)]
        total += float(np.logaddexp.reduce(joint, axis=None) - sums[first] - sums[second])
    shares = np.exp(beliefs - beliefs.max(axis=1, keepdims=True))
    return shares / shares.sum(axis=1, keepdims=True), total


def _beliefs(own: Array, targets: Indices, messages: Array) -> Array:
    found = own.copy()
    np.add.at(found, targets, messages)
    return found
