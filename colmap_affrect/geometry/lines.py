"""Focal length, axis and upright direction of one photograph from its straight lines.

Buildings, rooms and streets hold lines in three orthogonal directions. The vanishing points of
these tell the focal length, where the optical axis meets the image, and how the camera is turned
(Caprile and Torre, IJCV 1990). For each focal length and shift of a grid the rotation is sought
that explains most segments: each points at one of three vanishing points or is there by chance
(the mixture of Coughlan and Yuille, Manhattan world, ICCV 1999), and the weights of these kinds
are estimated together with the rotation. What is left is a likelihood of focal length and shift,
which priors can be multiplied with.

Lengths are in longer sides of the image, positions count from its middle, x right, y down; the
camera looks along z. A shift is that of the principal point, down.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from colmap_affrect.geometry.arrays import Array, Floats, Indices

FOCALS: Array = np.exp(np.linspace(math.log(0.4), math.log(6.0), 28))
"""Grid of focal lengths, longer sides: lenses of 14 to 216 mm for film of 36 mm."""
SHIFTS: Array = np.linspace(-0.3, 0.3, 13)
"""Grid of shifts, longer sides: view cameras go to a quarter of their plate."""

MIN_NUM_SEGMENTS = (
    12  # fewer say nothing: three directions have eight unknowns with the focal length
)
MAX_NUM_SEGMENTS = 160  # the longest are looked at
NUM_SEGMENTS_OF_TRIALS = 90  # the longest, by which first frames are tried
NUM_TRIALS = 160  # frames of three directions that are tried for each focal length
NUM_KEPT = 3  # of these, which are refined for each focal length
NUM_STEPS = 5  # of refinement without a shift
NUM_STEPS_SHIFTED = 3  # of refinement for each shift, from there
ANGLE_SIGMA = 0.008  # rad, of a segment's direction: lenses distort, and walls are not quite plumb
END_SIGMA = 0.0008  # longer sides, of the ends of a segment: about one px
SAME_LINE_DISTANCE = 0.012  # longer sides; closer parallel segments are of one cornice or frame
SAME_LINE_ANGLE = 0.05  # rad
CHANCE_DENSITY = 2.0 / math.pi  # of the angle of a segment that is there by chance, per rad
CHANCE_COUNT = 4.0  # segments by chance that are reckoned with beforehand
DIRECTION_COUNT = 1.0  # segments of each direction that are reckoned with beforehand
TEMPER = 2.0  # lines that count as one piece of evidence: what is built errs together
MODEL_SIGMA = 0.05
"""Deviation of log focal length that is left where lines are many. This and ``TEMPER`` are fitted
by ``tests/benchmarks/lines.py``, with each scene left out in turn."""
USUAL_FOCAL = 1.2  # longer sides: what COLMAP guesses
USUAL_FOCAL_SIGMA = 0.5  # of the logarithm of the focal lengths that photographs have
KNOWN_SIGMA = 0.15  # of log focal length, below which lines know it
MIDDLE_SIGMA = 0.02  # longer sides, of the axis of a photograph that is as the camera took it


@dataclass(frozen=True)
class Segments:
    """Straight segments of a photograph.

    Attributes:
        starts: (N, 2) in longer sides from the middle of the image.
        ends: (N, 2) likewise.
    """

    starts: Floats
    ends: Floats

    @classmethod
    def of_image(cls, ends_px: Floats, image_size: tuple[int, int]) -> "Segments":
        """Return the longest segments of an image.

        Args:
            ends_px: (N, 4) x and y of start and end, pixel-centre px.
            image_size: (width, height) in px.

        Returns:
            At most ``MAX_NUM_SEGMENTS``, the longest first.
        """
        middle = (np.asarray(image_size, np.float64) - 1.0) / 2.0
        scaled = (ends_px.reshape(-1, 2, 2) - middle) / max(image_size)
        lengths = np.linalg.norm(scaled[:, 1] - scaled[:, 0], axis=1)
        longest = np.argsort(-lengths, kind="stable")[:MAX_NUM_SEGMENTS]
        return cls(scaled[longest, 0], scaled[longest, 1])

    def longest(self, number: int) -> "Segments":
        """Return the longest segments."""
        return Segments(self.starts[:number], self.ends[:number])

    def __len__(self) -> int:
        return len(self.starts)

    @cached_property
    def middles(self) -> Floats:
        """(N, 2) middles."""
        return (self.starts + self.ends) / 2.0

    @cached_property
    def lengths(self) -> Floats:
        """(N,) lengths."""
        return np.asarray(np.linalg.norm(self.ends - self.starts, axis=1))

    @cached_property
    def directions(self) -> Floats:
        """(N, 2) unit vectors along the segments."""
        return np.asarray((self.ends - self.starts) / self.lengths[:, None])

    @cached_property
    def sigmas(self) -> Floats:
        """(N,) deviations of the directions, rad."""
        return np.hypot(ANGLE_SIGMA, END_SIGMA / self.lengths)

    @cached_property
    def weights(self) -> Floats:
        """(N,) parts of a line that the segments are, so that each line counts once."""
        cosines = np.abs(self.directions @ self.directions.T)
        normals = np.stack([-self.directions[:, 1], self.directions[:, 0]], axis=1)
        offsets = self.middles[None, :, :] - self.middles[:, None, :]
        distances = np.abs(np.einsum("ijk,ik->ij", offsets, normals))
        is_same = (cosines > math.cos(SAME_LINE_ANGLE)) & (distances < SAME_LINE_DISTANCE)
        is_same |= is_same.T
        return np.asarray(self.lengths / (is_same @ self.lengths))


@dataclass(frozen=True)
class LineLikelihood:
    """What the lines of a photograph say of its camera.

    Attributes:
        log_likelihoods: (F, S) for ``FOCALS`` and ``SHIFTS``, tempered; 0 is what chance explains.
        rotations: (F, S, 3, 3), rows are the three directions in the camera's frame.
        kinds: (N,) number of the direction of each segment for the best camera, -1 for chance.
    """

    log_likelihoods: Floats
    rotations: Floats
    kinds: Indices


@dataclass(frozen=True)
class LineCamera:
    """The camera of a photograph by its straight lines.

    Attributes:
        focal: focal length in longer sides, the geometric mean.
        focal_sigma: deviation of its logarithm.
        shift: of the principal point, down from the middle, in longer sides.
        shift_sigma: its deviation.
        rotation: (3, 3), rows are the three directions in the camera's frame, for the likeliest.
        up: (3,) the direction of these that is nearest to the upright of the image, upwards.
    """

    focal: float
    focal_sigma: float
    shift: float
    shift_sigma: float
    rotation: Floats
    up: Floats

    @property
    def is_known(self) -> bool:
        """Whether the lines tell the focal length."""
        return self.focal_sigma < KNOWN_SIGMA


def line_camera(likelihood: LineLikelihood, shift_sigma: float = MIDDLE_SIGMA) -> LineCamera:
    """Return what lines say of a camera, together with what is usual.

    Args:
        likelihood: of the lines.
        shift_sigma: how far the optical axis may be from the middle beforehand, in longer sides.

    Returns:
        The camera, with deviations.
    """
    log_focals = np.log(FOCALS)
    focal_prior = -0.5 * ((log_focals - math.log(USUAL_FOCAL)) / USUAL_FOCAL_SIGMA) ** 2
    shift_prior = -0.5 * (SHIFTS / shift_sigma) ** 2
    logs = likelihood.log_likelihoods + focal_prior[:, None] + shift_prior[None, :]
    chances = np.exp(logs - logs.max())
    chances /= chances.sum()
    of_focals = chances.sum(axis=1)
    of_shifts = chances.sum(axis=0)
    log_focal = float(of_focals @ log_focals)
    focal_variance = float(of_focals @ (log_focals - log_focal) ** 2)
    shift = float(of_shifts @ SHIFTS)
    shift_variance = float(of_shifts @ (SHIFTS - shift) ** 2)
    row, column = np.unravel_index(chances.argmax(), chances.shape)
    rotation = likelihood.rotations[row, column]
    upright = rotation[np.abs(rotation[:, 1]).argmax()]
    return LineCamera(
        math.exp(log_focal),
        math.hypot(math.sqrt(focal_variance), MODEL_SIGMA),
        shift,
        math.sqrt(shift_variance),
        rotation,
        upright if upright[1] < 0.0 else -upright,
    )


def line_likelihood(segments: Segments, random_seed: int = 0) -> LineLikelihood | None:
    """Return how likely focal lengths and shifts are by the straight lines of a photograph.

    Args:
        segments: of the photograph.
        random_seed: of the frames that are tried.

    Returns:
        The likelihood; None where there are too few segments to say anything.
    """
    if len(segments) < MIN_NUM_SEGMENTS:
        return None
    centred = _rotations_of_centred_cameras(segments, random_seed)
    grid = (len(FOCALS), len(SHIFTS))
    focals = np.repeat(FOCALS, len(SHIFTS))
    shifts = np.tile(SHIFTS, len(FOCALS))
    starts = np.repeat(centred, len(SHIFTS), axis=0)
    rotations, scores = _refined(segments, starts, focals, shifts, NUM_STEPS_SHIFTED)
    log_likelihoods = scores.reshape(grid) / TEMPER
    best = int(scores.argmax())
    kinds = _kinds(segments, rotations[best], focals[best], shifts[best])
    return LineLikelihood(log_likelihoods, rotations.reshape(*grid, 3, 3), kinds)


def _rotations_of_centred_cameras(segments: Segments, random_seed: int) -> Floats:
    """Return the (F, 3, 3) rotations that explain most for each focal length, without a shift."""
    starts = _first_rotations(segments, random_seed)
    focals = np.repeat(FOCALS, NUM_KEPT)
    refined, scores = _refined(
        segments, starts.reshape(-1, 3, 3), focals, np.zeros(len(focals)), NUM_STEPS
    )
    best = scores.reshape(-1, NUM_KEPT).argmax(axis=1)
    return np.asarray(refined.reshape(-1, NUM_KEPT, 3, 3)[np.arange(len(best)), best])


def _first_rotations(segments: Segments, random_seed: int) -> Floats:
    """Return for each focal length the (F, K, 3, 3) best of many frames, by the longest segments.

    Two segments meet in the first vanishing point; the second direction is orthogonal to it and
    lies in the plane of a third segment.
    """
    segments = segments.longest(NUM_SEGMENTS_OF_TRIALS)
    random = np.random.default_rng(random_seed)
    importance = segments.weights * segments.lengths
    chances = importance / importance.sum()
    chosen = random.choice(len(segments), (NUM_TRIALS, 3), p=chances)
    ones = np.ones((len(segments), 1))
    lines = np.cross(np.hstack([segments.starts, ones]), np.hstack([segments.ends, ones]))
    kept = np.empty((len(FOCALS), NUM_KEPT, 3, 3))
    for number, focal in enumerate(FOCALS):
        normals = _unit(lines * [focal, focal, 1.0])  # of the planes through the camera's centre
        first = np.cross(normals[chosen[:, 0]], normals[chosen[:, 1]])
        second = np.cross(first, normals[chosen[:, 2]])
        is_good = np.linalg.norm(second, axis=1) > 1e-3
        is_good &= np.linalg.norm(first, axis=1) > 1e-3
        first = _unit(np.where(is_good[:, None], first, [1.0, 0.0, 0.0]))
        second = _unit(np.where(is_good[:, None], second, [0.0, 1.0, 0.0]))
        rotations = np.stack([first, second, np.cross(first, second)], axis=1)
        focals = np.full(NUM_TRIALS, focal)
        scores = _Fit(segments, rotations, focals, np.zeros(NUM_TRIALS)).scores()
        kept[number] = rotations[np.argsort(-scores, kind="stable")[:NUM_KEPT]]
    return kept


class _Fit:
    """How well segments fit vanishing points of several cameras at once.

    Args:
        segments: N of them.
        rotations: (K, 3, 3), rows are directions in the camera's frame.
        focals: (K,) focal lengths.
        shifts: (K,) shifts of the principal point.
    """

    def __init__(
        self, segments: Segments, rotations: Floats, focals: Floats, shifts: Floats
    ) -> None:
        self.segments = segments
        self.rotations = rotations
        self.focals = focals
        self.shifts = shifts
        points = self._vanishing_points(rotations)
        self.towards = self._towards(points)  # (K, N, 3, 2) from middles to vanishing points
        self.distances = np.linalg.norm(self.towards, axis=-1) + 1e-12
        self.sines = self._crossed(self.towards) / self.distances
        sigmas = segments.sigmas[None, :, None]
        exponents = -0.5 * (self.sines / sigmas) ** 2
        densities = np.exp(exponents) * (math.sqrt(2.0 / math.pi) / sigmas)
        self.densities = np.concatenate(
            [densities, np.full((*densities.shape[:2], 1), CHANCE_DENSITY)], axis=2
        )  # (K, N, 4) of the three directions and of chance
        self.mixing = self._mixing()

    def _vanishing_points(self, directions: Floats) -> Floats:
        """Return the (K, 3, 3) homogeneous points in which directions vanish."""
        x, y, z = np.moveaxis(directions, -1, 0)
        focals = self.focals[:, None]
        shifts = self.shifts[:, None]
        return np.stack([focals * x, focals * y + shifts * z, z], axis=-1)

    def _towards(self, points: Floats) -> Floats:
        flat = points[:, None, :, :2]
        depths = points[:, None, :, 2:]
        return np.asarray(flat - depths * self.segments.middles[None, :, None, :])

    def _crossed(self, vectors: Floats) -> Floats:
        along = self.segments.directions[None, :, None, :]
        return np.asarray(vectors[..., 0] * along[..., 1] - vectors[..., 1] * along[..., 0])

    def _mixing(self) -> Floats:
        """Return the (K, 4) shares of the kinds of segments, by a few steps of EM."""
        beforehand = np.array([DIRECTION_COUNT] * 3 + [CHANCE_COUNT])
        shares = np.tile(beforehand / beforehand.sum(), (len(self.focals), 1))
        for _ in range(3):
            counts = np.einsum("knj,n->kj", self._parts(shares), self.segments.weights)
            counts += beforehand
            shares = counts / counts.sum(axis=1, keepdims=True)
        return shares

    def _parts(self, shares: Floats) -> Floats:
        """Return the (K, N, 4) probabilities of the kinds of each segment."""
        weighted = self.densities * shares[:, None, :]
        return np.asarray(weighted / weighted.sum(axis=2, keepdims=True))

    def scores(self) -> Floats:
        """Return (K,) log-likelihood ratios against chance alone."""
        likelihoods = (self.densities * self.mixing[:, None, :]).sum(axis=2)
        return np.asarray(np.log(likelihoods / CHANCE_DENSITY) @ self.segments.weights)

    def improved(self) -> Floats:
        """Return the (K, 3, 3) rotations after a Gauss-Newton step."""
        sigmas = self.segments.sigmas[None, :, None]
        weights = self._parts(self.mixing)[:, :, :3] * self.segments.weights[None, :, None]
        weights = weights / sigmas**2
        slopes = np.empty((*self.sines.shape, 3))
        for axis in range(3):
            turn = np.zeros(3)
            turn[axis] = 1.0
            moved = self._towards(self._vanishing_points(np.cross(turn, self.rotations)))
            along = (self.towards * moved).sum(axis=-1) / self.distances
            slopes[..., axis] = (self._crossed(moved) - self.sines * along) / self.distances
        normal = np.einsum("knj,knja,knjb->kab", weights, slopes, slopes)
        gradient = np.einsum("knj,knja,knj->ka", weights, slopes, self.sines)
        damping = 1e-6 * np.trace(normal, axis1=1, axis2=2) + 1e-6
        normal += damping[:, None, None] * np.eye(3)
        steps = -np.linalg.solve(normal, gradient[..., None])[..., 0]
        size = np.linalg.norm(steps, axis=1, keepdims=True)
        steps *= np.minimum(1.0, 0.1 / np.maximum(size, 1e-12))
        return _turned(self.rotations, steps)

    def kinds(self) -> Indices:
        """Return the (K, N) likeliest kinds, 3 for chance."""
        return np.asarray(self._parts(self.mixing).argmax(axis=2))


def _refined(
    segments: Segments, rotations: Floats, focals: Floats, shifts: Floats, num_steps: int
) -> tuple[Floats, Floats]:
    """Return the (K, 3, 3) rotations that explain more, and (K,) how much."""
    best = rotations
    fit = _Fit(segments, rotations, focals, shifts)
    scores = fit.scores()
    for _ in range(num_steps):
        fit = _Fit(segments, fit.improved(), focals, shifts)
        found = fit.scores()
        is_better = found > scores
        best = np.where(is_better[:, None, None], fit.rotations, best)
        scores = np.where(is_better, found, scores)
    return best, scores


def _kinds(segments: Segments, rotation: Floats, focal: float, shift: float) -> Indices:
    fit = _Fit(segments, rotation[None], np.array([focal]), np.array([shift]))
    kinds = fit.kinds()[0]
    return np.where(kinds == 3, -1, kinds)


def _turned(rotations: Floats, steps: Floats) -> Floats:
    """Turn (K, 3, 3) rows by (K, 3) rotation vectors (Rodrigues)."""
    angles = np.linalg.norm(steps, axis=1)[:, None, None]
    axes = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    crossed = np.cross(axes[:, None, :], rotations)
    along = (rotations @ axes[:, :, None]) * axes[:, None, :]
    return np.asarray(
        rotations * np.cos(angles) + crossed * np.sin(angles) + along * (1.0 - np.cos(angles))
    )


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
