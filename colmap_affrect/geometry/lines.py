"""Focal length, axis and upright direction of one photograph from its straight lines.

Buildings, rooms and streets hold lines in three orthogonal directions. The vanishing points of
these tell the focal length, where the optical axis meets the image, and how the camera is turned
(Caprile and Torre, IJCV 1990). For each focal length and shift of a grid the rotation is sought
that explains most segments (:mod:`colmap_affrect.geometry.vanishing`). What is left is a likelihood
of focal length and shift, which priors can be multiplied with.

Lenses bend lines, which then meet too far out: the focal length seems too long by a tenth for a
barrel distortion of a few per cent. So several distortions are tried, and each counts as far as
the lines are likely with it.

Lengths are in longer sides of the image, positions count from its middle, x right, y down; the
camera looks along z. A shift is that of the principal point, down.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from colmap_affrect.geometry.arrays import Array, Floats, Indices
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.geometry.vanishing import VanishingFit, refined

FOCALS: Array = np.exp(np.linspace(math.log(0.4), math.log(6.0), 28))
"""Grid of focal lengths, longer sides: lenses of 14 to 216 mm for film of 36 mm; theory."""
SHIFTS: Array = np.linspace(-0.3, 0.3, 25)
"""Grid of shifts, longer sides: view cameras go to a quarter of their plate; theory."""
DISTORTIONS: Array = np.linspace(-0.2, 0.2, 9)
"""Grid of radial distortions of :meth:`Segments.undistorted`: up to 5 per cent at the ends of the
longer side; theory."""

# Fewer say nothing: three directions and a focal length have 4 unknowns; theory
MIN_NUM_SEGMENTS = 12
NUM_SEGMENTS_OF_TRIALS = 90  # the longest, by which first frames are tried; resource
# Frames of three directions that are tried for each focal length; resource
NUM_TRIALS = 160
NUM_KEPT = 3  # of these, which are refined for each focal length; resource
# Of the angle between planes that meet in a direction of a first frame; numeric
MIN_SINE = 1e-3
NUM_STEPS = 5  # of refinement without a shift; resource
NUM_STEPS_FROM_THERE = 3  # of refinement for each distortion, from there; resource
# Of refinement for each shift, from the shift beside it; resource
NUM_STEPS_FROM_BESIDE = 2
# Lines that count as one piece of evidence: what is built errs together; fitted
TEMPER = 3.0
MODEL_SIGMA = 0.05
"""Deviation of log focal length that is left where lines are many. This and ``TEMPER`` are fitted
by ``tests/benchmarks/lines.py``, with each scene left out in turn."""
USUAL_FOCAL = 1.2  # longer sides: what COLMAP guesses
# Of the logarithm of the focal lengths that photographs have; theory
USUAL_FOCAL_SIGMA = 0.5
KNOWN_SIGMA = 0.15  # of log focal length, below which lines know it; theory
# Longer sides, of the axis of a photograph that is as the camera took it; judged
MIDDLE_SIGMA = 0.02
# Longer sides, of the axis of a print: view cameras shift, and prints are cut; judged
SHIFTED_SIGMA = 0.15
# Nats, from which on lines have their directions not by chance; theory
MIN_EVIDENCE = 3.0
# Nats, from which on lines say that the axis is not in the middle; theory
SHIFT_EVIDENCE = 3.0
DOWN = 0.0, 1.0  # of a picture that is stored as it stands, x right and y down; format


@dataclass(frozen=True)
class LineLikelihood:
    """What the lines of a photograph say of its camera.

    Attributes:
        log_likelihoods: (F, S) for ``FOCALS`` and ``SHIFTS``, tempered; 0 is what chance explains.
        rotations: (F, S, 3, 3), rows are the three directions in the camera's frame.
        distortion: the likeliest, which the rotations belong to.
    """

    log_likelihoods: Floats
    rotations: Floats
    distortion: float = 0.0


@dataclass(frozen=True)
class LineCamera:
    """The camera of a photograph by its straight lines.

    Attributes:
        focal: focal length in longer sides, the geometric mean.
        focal_sigma: deviation of its logarithm.
        shift: of the principal point, down from the middle, in longer sides.
        shift_sigma: its deviation.
        rotation: (3, 3), rows are the three directions in the camera's frame, for the likeliest.
        up: (3,) the direction of these that is nearest to the upright of the picture, upwards.
        up_sigma: its deviation in radians, over all focal lengths and shifts.
    """

    focal: float
    focal_sigma: float
    shift: float
    shift_sigma: float
    rotation: Floats
    up: Floats
    up_sigma: float

    @property
    def is_known(self) -> bool:
        """Whether the lines tell the focal length."""
        return self.focal_sigma < KNOWN_SIGMA


@dataclass(frozen=True)
class LineFindings:
    """What the straight lines of a photograph say in the end.

    Attributes:
        num_segments: straight segments that were looked at.
        camera: by the lines; None where they are too few.
        says_shifted: whether they say that the optical axis is not in the middle of the image.
    """

    num_segments: int
    camera: LineCamera | None
    says_shifted: bool


@dataclass(frozen=True)
class Explanation:
    """The likeliest camera on the grid, and which segments it explains.

    Attributes:
        focal: focal length in longer sides.
        shift: of the principal point, down from the middle, in longer sides.
        rotation: (3, 3), rows are the three directions in the camera's frame.
        kinds: (N,) number of the direction of each segment, ``CHANCE`` for none.
        evidence: nats by which the lines are likelier with these directions than by chance.
        down: downwards in the picture, right and down in the image as stored.
    """

    focal: float
    shift: float
    rotation: Floats
    kinds: Indices
    evidence: float
    down: tuple[float, float] = DOWN

    @property
    def up(self) -> Floats:
        """(3,) the direction that is nearest to the upright of the picture, upwards."""
        return upright_of(self.rotation, self.down)

    @property
    def horizon(self) -> Floats:
        """(3,) homogeneous line of the image, in longer sides from its middle."""
        x, y, z = self.up / self.focal
        return np.array([x, y, self.focal * z - self.shift * y])


@dataclass(frozen=True)
class Lines:
    """The straight lines of a photograph, and what they say.

    Attributes:
        segments: of the photograph.
        likelihood: of its camera; None where there are too few segments to say anything.
        down: downwards in the picture, right and down in the image as stored: photographs that
            a camera took on its side are often stored so.
    """

    segments: Segments
    likelihood: LineLikelihood | None
    down: tuple[float, float] = DOWN

    @cached_property
    def says_shifted(self) -> bool:
        """Whether the lines say that the optical axis is not in the middle of the image."""
        return (
            self.likelihood is not None
            and shift_evidence(self.likelihood) > SHIFT_EVIDENCE
        )

    @property
    def usual_shift_sigma(self) -> float:
        """How far the axis may be from the middle where nobody knows, in longer sides."""
        return SHIFTED_SIGMA if self.says_shifted else MIDDLE_SIGMA

    def camera(self, shift_sigma: float | None = None) -> LineCamera | None:
        """Return the camera by the lines; None where they are too few.

        Args:
            shift_sigma: how far the axis may be from the middle, in longer sides; None: in the
                middle, unless the lines say otherwise.
        """
        if self.likelihood is None:
            return None
        sigma = self.usual_shift_sigma if shift_sigma is None else shift_sigma
        return line_camera(self.likelihood, sigma, self.down)

    def findings(self) -> LineFindings:
        """Return what the lines say in the end."""
        return LineFindings(len(self.segments), self.camera(), self.says_shifted)

    def explanation(self) -> Explanation | None:
        """Return which segments belong to which direction; None where they are too few."""
        if self.likelihood is None:
            return None
        row, column = _likeliest(posterior(self.likelihood, self.usual_shift_sigma))
        focal = float(FOCALS[row])
        shift = float(SHIFTS[column])
        rotation = self.likelihood.rotations[row, column]
        segments = self.segments.undistorted(self.likelihood.distortion)
        fit = VanishingFit(
            segments=segments,
            rotations=rotation[None],
            focals=np.array([focal]),
            shifts=np.array([shift]),
        )
        evidence = float(self.likelihood.log_likelihoods[row, column])
        return Explanation(
            focal=focal,
            shift=shift,
            rotation=rotation,
            kinds=fit.kinds()[0],
            evidence=evidence,
            down=self.down,
        )


def measure_lines(segments: Segments, down: tuple[float, float] = DOWN) -> Lines:
    """Return segments with what they say of the camera.

    Args:
        segments: of the photograph.
        down: downwards in the picture, right and down in the image as stored.
    """
    return Lines(segments, line_likelihood(segments), down)


def line_camera(
    likelihood: LineLikelihood,
    shift_sigma: float = MIDDLE_SIGMA,
    down: tuple[float, float] = DOWN,
) -> LineCamera:
    """Return what lines say of a camera, together with what is usual.

    Args:
        likelihood: of the lines.
        shift_sigma: how far the optical axis may be from the middle beforehand, in longer sides.
        down: downwards in the picture, right and down in the image as stored.

    Returns:
        The camera, with deviations.
    """
    chances = posterior(likelihood, shift_sigma)
    log_focals = np.log(FOCALS)
    of_focals = chances.sum(axis=1)
    of_shifts = chances.sum(axis=0)
    log_focal = float(of_focals @ log_focals)
    focal_variance = float(of_focals @ (log_focals - log_focal) ** 2)
    shift = float(of_shifts @ SHIFTS)
    shift_variance = float(of_shifts @ (SHIFTS - shift) ** 2)
    rotation = likelihood.rotations[_likeliest(chances)]
    up = upright_of(rotation, down)
    return LineCamera(
        focal=math.exp(log_focal),
        focal_sigma=math.hypot(math.sqrt(focal_variance), MODEL_SIGMA),
        shift=shift,
        shift_sigma=math.sqrt(shift_variance),
        rotation=rotation,
        up=up,
        up_sigma=_up_sigma(likelihood, chances, up, down),
    )


def _up_sigma(
    likelihood: LineLikelihood,
    chances: Floats,
    up: Floats,
    down: tuple[float, float],
) -> float:
    """Return how far the uprights of all focal lengths and shifts are from one, in radians.

    Lines of buildings have much the same upright whatever the focal length, leaves and faces
    another one for each.

    Args:
        likelihood: of the lines.
        chances: (F, S) probabilities of focal lengths and shifts.
        up: (3,) the likeliest upright.
        down: downwards in the picture, right and down in the image as stored.
    """
    downwards = likelihood.rotations[..., :2] @ np.array(down)
    nearest = np.abs(downwards).argmax(axis=2)[..., None]
    rows = np.take_along_axis(likelihood.rotations, nearest[..., None], axis=2)
    signs = np.where(np.take_along_axis(downwards, nearest, axis=2) < 0.0, 1.0, -1.0)
    ups = signs * rows[:, :, 0]
    angles = np.arccos(np.clip(ups @ up, -1.0, 1.0))
    return math.sqrt(float(np.sum(chances * angles**2)))


def shift_evidence(likelihood: LineLikelihood) -> float:
    """Return by how many nats lines are likelier with a free axis than with one in the middle."""
    free = _log_joint(likelihood, SHIFTED_SIGMA)
    in_the_middle = _log_joint(likelihood, MIDDLE_SIGMA)
    return float(
        np.logaddexp.reduce(free, axis=None)
        - np.logaddexp.reduce(in_the_middle, axis=None)
    )


def upright_of(rotation: Floats, down: tuple[float, float] = DOWN) -> Floats:
    """Return the row of a (3, 3) rotation that is nearest to the picture's upright, upwards.

    Args:
        rotation: rows are directions in the camera's frame.
        down: downwards in the picture, right and down in the image as stored.
    """
    downwards = rotation[:, :2] @ np.array(down)
    number = np.abs(downwards).argmax()
    row = rotation[number]
    return np.asarray(row if downwards[number] < 0.0 else -row)


def _log_joint(likelihood: LineLikelihood, shift_sigma: float) -> Floats:
    """Return (F, S) log-likelihoods with log-probabilities beforehand, which sum to one."""
    prior, log_sum = _log_prior(shift_sigma)
    return np.asarray(likelihood.log_likelihoods + prior - log_sum)


@lru_cache(maxsize=8)
def _log_prior(shift_sigma: float) -> tuple[Floats, float]:
    """Return (F, S) log-probabilities beforehand up to a constant, and the log of their sum."""
    focal_prior = -0.5 * (np.log(FOCALS / USUAL_FOCAL) / USUAL_FOCAL_SIGMA) ** 2
    shift_prior = -0.5 * (SHIFTS / shift_sigma) ** 2
    prior = focal_prior[:, None] + shift_prior[None, :]
    return prior, float(np.logaddexp.reduce(prior, axis=None))


def posterior(likelihood: LineLikelihood, shift_sigma: float) -> Floats:
    """Return (F, S) probabilities of focal lengths and shifts."""
    logs = _log_joint(likelihood, shift_sigma)
    return np.asarray(np.exp(logs - np.logaddexp.reduce(logs, axis=None)))


def _likeliest(chances: Floats) -> tuple[int, int]:
    """Return row and column of the largest of (F, S) probabilities."""
    row, column = np.unravel_index(int(chances.argmax()), chances.shape)
    return int(row), int(column)


def line_likelihood(segments: Segments) -> LineLikelihood | None:
    """Return how likely focal lengths and shifts are by the straight lines of a photograph.

    Args:
        segments: of the photograph.

    Returns:
        The likelihood; None where there are too few segments to say anything.
    """
    if len(segments) < MIN_NUM_SEGMENTS:
        return None
    lens = _likeliest_lens(segments)
    straight = segments.undistorted(lens.distortion)
    rotations, scores = _rotations_of_shifts(straight, lens.rotations)
    log_likelihoods = (scores + lens.of_others[:, None]) / TEMPER
    return LineLikelihood(log_likelihoods, rotations, lens.distortion)


def _rotations_of_shifts(segments: Segments, centred: Floats) -> tuple[Floats, Floats]:
    """Return the rotations that explain most for each focal length and shift, and how much.

    A camera with a shifted axis is turned otherwise than one without. So the rotation of each
    shift is sought from that of the shift beside it, from the middle outwards: from the middle
    itself many are not found, and shifts then seem less likely than they are.

    Args:
        segments: of the photograph, undistorted.
        centred: (F, 3, 3) rotations without a shift.

    Returns:
        (F, S, 3, 3) rotations, and (F, S) log-likelihood ratios against chance alone.
    """
    num_focals = len(FOCALS)
    rotations = np.empty((num_focals, len(SHIFTS), 3, 3))
    scores = np.empty((num_focals, len(SHIFTS)))
    middle = len(SHIFTS) // 2
    starts = {middle: centred}
    for distance in range(middle + 1):
        columns = sorted({middle - distance, middle + distance})
        found, of_found = refined(
            segments=segments,
            rotations=np.concatenate([starts[column] for column in columns]),
            focals=np.tile(FOCALS, len(columns)),
            shifts=np.repeat(SHIFTS[columns], num_focals),
            num_steps=NUM_STEPS_FROM_BESIDE,
        )
        for number, column in enumerate(columns):
            part = slice(number * num_focals, (number + 1) * num_focals)
            rotations[:, column] = found[part]
            scores[:, column] = of_found[part]
        starts = {
            middle - distance - 1: rotations[:, middle - distance],
            middle + distance + 1: rotations[:, middle + distance],
        }
    return rotations, scores


@dataclass(frozen=True)
class _Lens:
    """The likeliest distortion of a camera with its axis in the middle.

    Attributes:
        distortion: of :data:`DISTORTIONS`.
        rotations: (F, 3, 3) that explain most with it.
        of_others: (F,) nats that the sum over all distortions adds to this one, with what is
            known of lenses beforehand.
    """

    distortion: float
    rotations: Floats
    of_others: Floats


def _likeliest_lens(segments: Segments) -> _Lens:
    """Compare distortions; the frames of each are found from those of a lens without any."""
    starts = _rotations_of_centred_cameras(segments)
    no_shift = np.zeros(len(FOCALS))
    rotations = np.empty((len(DISTORTIONS), *starts.shape))
    scores = np.empty((len(DISTORTIONS), len(FOCALS)))
    for number, distortion in enumerate(DISTORTIONS):
        straight = segments.undistorted(float(distortion))
        rotations[number], scores[number] = refined(
            segments=straight,
            rotations=starts,
            focals=FOCALS,
            shifts=no_shift,
            num_steps=NUM_STEPS_FROM_THERE,
        )
    best = int(scores.max(axis=1).argmax())
    means = np.logaddexp.reduce(scores, axis=0) - math.log(len(DISTORTIONS))
    of_others = means - scores[best]
    return _Lens(float(DISTORTIONS[best]), rotations[best], np.asarray(of_others))


def _rotations_of_centred_cameras(segments: Segments) -> Floats:
    """Return the (F, 3, 3) rotations that explain most, without a shift and a distortion."""
    starts = _first_rotations(segments)
    focals = np.repeat(FOCALS, NUM_KEPT)
    found, scores = refined(
        segments=segments,
        rotations=starts.reshape(-1, 3, 3),
        focals=focals,
        shifts=np.zeros(len(focals)),
        num_steps=NUM_STEPS,
    )
    best = scores.reshape(-1, NUM_KEPT).argmax(axis=1)
    return np.asarray(found.reshape(-1, NUM_KEPT, 3, 3)[np.arange(len(best)), best])


def _first_rotations(segments: Segments) -> Floats:
    """Return the (F, K, 3, 3) best of many frames for each focal length."""
    longest = segments.longest(NUM_SEGMENTS_OF_TRIALS)
    random = np.random.default_rng(0)
    importance = longest.weights * longest.lengths
    chances = importance / importance.sum()
    chosen = random.choice(len(longest), (NUM_TRIALS, 3), p=chances)
    no_shift = np.zeros(NUM_TRIALS)
    kept = np.empty((len(FOCALS), NUM_KEPT, 3, 3))
    for number, focal in enumerate(FOCALS):
        # Of planes with the camera's centre
        normals = _unit(longest.lines * [focal, focal, 1.0])
        rotations = _frames(normals[chosen])
        scores = VanishingFit(
            segments=longest,
            rotations=rotations,
            focals=np.full(NUM_TRIALS, focal),
            shifts=no_shift,
        ).scores()
        kept[number] = rotations[np.argsort(-scores, kind="stable")[:NUM_KEPT]]
    return kept


def _frames(normals: Floats) -> Floats:
    """Return the (K, 3, 3) frames of (K, 3, 3) normals of planes; where these do not tell, usual.

    The first two planes meet in the first direction, and the second direction lies in the third.
    """
    first = np.cross(normals[:, 0], normals[:, 1])
    second = np.cross(first, normals[:, 2])
    is_good = np.linalg.norm(first, axis=1) > MIN_SINE
    is_good &= np.linalg.norm(second, axis=1) > MIN_SINE
    first = _unit(np.where(is_good[:, None], first, [1.0, 0.0, 0.0]))
    second = _unit(np.where(is_good[:, None], second, [0.0, 1.0, 0.0]))
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
