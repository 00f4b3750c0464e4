"""How well segments point at the vanishing points of three orthogonal directions.

Each segment points at one of three vanishing points or is there by chance: the mixture of Coughlan
and Yuille (Manhattan world, ICCV 1999). The shares of these kinds are estimated together with the
rotation. Many cameras are looked at in one go, as arrays.

A camera has a focal length and a shift of its principal point, down from the middle of the image,
both in longer sides; it looks along z, x right, y down. The rows of a rotation are the three
directions in its frame.
"""

import math

import numpy as np

from colmap_affrect.geometry.arrays import Floats, Indices
from colmap_affrect.geometry.segments import Segments

# Of the angle of a segment that is there by chance, per rad; theory
CHANCE_DENSITY = 2.0 / math.pi
CHANCE_COUNT = 4.0  # segments by chance that are reckoned with beforehand; judged
# Segments of each direction that are reckoned with beforehand; theory
DIRECTION_COUNT = 1.0
NUM_EM_STEPS = 3  # for the shares of the directions and of chance; resource
MAX_STEP = 0.1  # rad, of a step of refinement; numeric
DAMPING = 1e-6  # of it, relative to what is known of the turn; numeric
TINY = 1e-12  # numeric
# Cameras; the arrays of more of them do not stay in the cache; resource
NUM_AT_ONCE = 80
CHANCE = -1  # kind of a segment that belongs to no direction; format


class VanishingFit:
    """How well segments fit vanishing points of several cameras at once.

    Args:
        segments: N of them.
        rotations: (K, 3, 3), rows are directions in the camera's frame.
        focals: (K,) focal lengths.
        shifts: (K,) shifts of the principal point.
    """

    def __init__(
        self,
        segments: Segments,
        rotations: Floats,
        focals: Floats,
        shifts: Floats,
    ) -> None:
        self.segments = segments
        self.rotations = rotations
        self.focals = focals
        self.shifts = shifts
        points = self._vanishing_points(rotations)
        # (K, 3, N) from middles to vanishing points, and sines of the angles to these
        self.distances = self._distances(points)
        self.sines = self._crossed(points)
        self.sines /= self.distances
        sigmas = segments.sigmas
        densities = np.empty((len(focals), 4, len(segments)))
        of_directions = densities[:, :3]
        np.divide(self.sines, sigmas, out=of_directions)
        np.square(of_directions, out=of_directions)
        of_directions *= -0.5
        np.exp(of_directions, out=of_directions)
        of_directions *= math.sqrt(2.0 / math.pi) / sigmas
        densities[:, 3] = CHANCE_DENSITY
        self.densities = densities  # (K, 4, N) of the three directions and of chance
        self.shares = self._estimated_shares()

    def _vanishing_points(self, directions: Floats) -> Floats:
        """Return the (K, 3, 3) homogeneous points in which directions vanish."""
        x, y, z = np.moveaxis(directions, -1, 0)
        focals = self.focals[:, None]
        shifts = self.shifts[:, None]
        return np.stack([focals * x, focals * y + shifts * z, z], axis=-1)

    def _distances(self, points: Floats) -> Floats:
        """Return the (K, 3, N) lengths of the vectors from middles to homogeneous points."""
        middles = self.segments.middles
        across = points[..., 2:] * middles[:, 0]
        np.subtract(points[..., :1], across, out=across)
        down = points[..., 2:] * middles[:, 1]
        np.subtract(points[..., 1:2], down, out=down)
        # In place: making and leaving large arrays takes longer than the sums.
        across *= across
        down *= down
        across += down
        np.sqrt(across, out=across)
        across += TINY
        return np.asarray(across)

    def _crossed(self, points: Floats) -> Floats:
        """Return the (K, 3, N) cross products of these vectors with the directions of segments."""
        return np.asarray(points @ self.segments.lines.T)

    def _estimated_shares(self) -> Floats:
        """Return the (K, 4) shares of the kinds of segments, by a few steps of EM."""
        beforehand = np.array([DIRECTION_COUNT] * 3 + [CHANCE_COUNT])
        num_segments = beforehand.sum() + self.segments.weights.sum()
        shares = np.tile(beforehand / beforehand.sum(), (len(self.focals), 1))
        for _ in range(NUM_EM_STEPS):
            portions = self.segments.weights / self._likelihoods(shares)
            counts = shares * (self.densities @ portions[:, :, None])[:, :, 0]
            shares = (counts + beforehand) / num_segments
        return shares

    def _likelihoods(self, shares: Floats) -> Floats:
        """Return the (K, N) densities of the angles of segments."""
        return np.asarray((shares[:, None, :] @ self.densities)[:, 0])

    def scores(self) -> Floats:
        """Return (K,) log-likelihood ratios against chance alone."""
        ratios = self._likelihoods(self.shares) / CHANCE_DENSITY
        return np.asarray(np.log(ratios) @ self.segments.weights)

    def improved(self) -> Floats:
        """Return the (K, 3, 3) rotations after a Gauss-Newton step.

        It holds the distances to the vanishing points, as a small turn hardly changes them.
        """
        segments = self.segments
        portions = (
            segments.weights / segments.sigmas**2 / self._likelihoods(self.shares)
        )
        parts = self.densities[:, :3] * self.shares[:, :3, None] * portions[:, None, :]
        num_cameras = len(self.focals)
        slopes = np.empty((num_cameras, 3, *self.sines.shape[1:]))
        for axis in range(3):
            turned = _turning(self.rotations, axis)
            crossed = self._crossed(self._vanishing_points(turned))
            np.divide(crossed, self.distances, out=slopes[:, axis])
        weighted = (slopes * parts[:, None]).reshape(num_cameras, 3, -1)
        slopes = slopes.reshape(num_cameras, 3, -1)
        normal = weighted @ np.swapaxes(slopes, 1, 2)
        gradient = weighted @ self.sines.reshape(num_cameras, -1, 1)
        damping = DAMPING * (1.0 + np.trace(normal, axis1=1, axis2=2))
        normal += damping[:, None, None] * np.eye(3)
        steps = -np.linalg.solve(normal, gradient)[..., 0]
        sizes = np.linalg.norm(steps, axis=1, keepdims=True)
        steps *= np.minimum(1.0, MAX_STEP / np.maximum(sizes, TINY))
        return _turned(self.rotations, steps)

    def kinds(self) -> Indices:
        """Return the (K, N) likeliest kinds, ``CHANCE`` for chance."""
        kinds = (self.densities * self.shares[:, :, None]).argmax(axis=1)
        return np.where(kinds == 3, CHANCE, kinds)


def refined(
    segments: Segments,
    rotations: Floats,
    focals: Floats,
    shifts: Floats,
    num_steps: int,
) -> tuple[Floats, Floats]:
    """Turn cameras so that their vanishing points explain more segments.

    Args:
        segments: of the photograph.
        rotations: (K, 3, 3), rows are the three directions in the camera's frame.
        focals: (K,) focal lengths, longer sides.
        shifts: (K,) shifts of the principal point, longer sides.
        num_steps: of Gauss-Newton; those that explain less are passed over.

    Returns:
        (K, 3, 3) rotations, and (K,) log-likelihood ratios against chance alone.
    """
    best = np.empty_like(rotations)
    scores = np.empty(len(rotations))
    for begin in range(0, len(rotations), NUM_AT_ONCE):
        part = slice(begin, begin + NUM_AT_ONCE)
        best[part], scores[part] = _refined_at_once(
            segments=segments,
            rotations=rotations[part],
            focals=focals[part],
            shifts=shifts[part],
            num_steps=num_steps,
        )
    return best, scores


def _refined_at_once(
    segments: Segments,
    rotations: Floats,
    focals: Floats,
    shifts: Floats,
    num_steps: int,
) -> tuple[Floats, Floats]:
    """Do what :func:`refined` does, for all cameras together."""
    best = rotations
    fit = VanishingFit(segments, rotations, focals, shifts)
    scores = fit.scores()
    for _ in range(num_steps):
        fit = VanishingFit(segments, fit.improved(), focals, shifts)
        found = fit.scores()
        is_better = found > scores
        best = np.where(is_better[:, None, None], fit.rotations, best)
        scores = np.where(is_better, found, scores)
    return best, scores


def _turning(rotations: Floats, axis: int) -> Floats:
    """Return how (K, 3, 3) rows change when they begin to turn about an axis of the camera."""
    change = np.zeros_like(rotations)
    second = (axis + 1) % 3
    third = (axis + 2) % 3
    change[..., second] = -rotations[..., third]
    change[..., third] = rotations[..., second]
    return change


def _turned(rotations: Floats, steps: Floats) -> Floats:
    """Turn (K, 3, 3) rows by (K, 3) rotation vectors (Rodrigues)."""
    angles = np.linalg.norm(steps, axis=1)[:, None, None]
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    axes = steps / np.maximum(lengths, TINY)
    crossed = np.cross(axes[:, None, :], rotations)
    along = (rotations @ axes[:, :, None]) * axes[:, None, :]
    return np.asarray(
        rotations * np.cos(angles)
        + crossed * np.sin(angles)
        + along * (1.0 - np.cos(angles))
    )
