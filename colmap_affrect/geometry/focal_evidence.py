"""What the matches of two images say about the focal lengths of their cameras.

For given focal lengths the essential matrix is fitted that explains the matches best. What is
not asked for is integrated out (Laplace's approximation): rotation, direction of the baseline,
principal points and one coefficient of radial distortion each, which all stay near what they are
without evidence. Without this integral the best fit is taken for the likely one, and long lenses
look short: hardly any perspective is left to see them by, and a short lens has more ways to bend
into the noise.

Points are (N, 2), from the image centre in units of the longer side; so are focal lengths.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools
from colmap_affrect.geometry.epipolar import sampson_errors

PRINCIPAL_POINT_SIGMA, DISTORTION_SIGMA = 0.02, 0.05  # longer sides; of what nobody cropped
MAX_NUM_MATCHES = 100  # of a pair; beyond, errors of the model weigh more than noise

MAX_MISFIT = 5.0
"""By how much the log-likelihood of the best essential matrix may fall short of that of the best
fundamental matrix; a pair beyond says nothing about cameras: its geometry is wrong."""

MAX_MISFIT_OF_CANDIDATES = 100.0  # the same of candidates far apart
BESIDE = np.geomspace(1 / 1.2, 1.2, 11)  # from a candidate at most halfway to the next
MAX_NUM_STEPS, MIN_GAIN = 15, 1e-3  # of Levenberg and Marquardt, and of log-likelihood

BASELINE, TILT, SCALE = slice(0, 3), slice(3, 5), 5
CENTERS, DISTORTIONS = slice(6, 10), slice(10, 12)
"""Parameters of a fit: turns of the left and the right factor, the second singular value, and the
nuisances of both images."""
NUM_PARAMETERS = 12


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Inliers of a pair with a fundamental matrix."""

    points1: Array  # (N, 2) in image 1
    points2: Array  # (N, 2) their matches
    fundamental: Array  # (3, 3) in the units of the points
    error: float  # of a match, to be expected, longer sides

    @classmethod
    def of(cls, points1: Array, points2: Array, fundamental: Array, least_error: float) -> Self:
        """Choose some of the matches, and measure their error, which is at least so large."""
        errors = sampson_errors(fundamental, points1, points2)
        error = max(least_error, 1.4826 * float(np.median(errors)))
        chosen = np.random.default_rng(0).permutation(len(points1))[:MAX_NUM_MATCHES]
        return cls(points1[chosen], points2[chosen], fundamental, error)


def log_evidence(
    pair: MatchedPair, focals1: Array, focals2: Array, *, max_misfit: float = MAX_MISFIT
) -> Array:
    """Return the (N,) logarithms of the evidence for (N,) pairs of focal lengths, up to a constant.

    All are 0 where the pair fits no camera, or its matches leave parameters undetermined.
    """
    essential = _Fit(pair, focals1, focals2, is_essential=True)
    fundamental = _Fit(pair, np.ones(1), np.ones(1), is_essential=False)
    best = int(essential.costs.argmin())
    misfit = essential.costs[best] - fundamental.costs[0]
    if max_misfit < misfit < MAX_MISFIT_OF_CANDIDATES:
        beside = np.stack(np.meshgrid(BESIDE * focals1[best], BESIDE * focals2[best]))
        nearby = _Fit(pair, *beside.reshape(2, -1), is_essential=True)
        misfit = nearby.costs.min() - fundamental.costs[0]
    found = -essential.costs - 0.5 * np.linalg.slogdet(essential.hessians)[1]
    if misfit > max_misfit or not np.isfinite(found).all():
        return np.zeros(len(focals1))
    return np.asarray(found - found.max())


@dataclass(frozen=True)
class _Residuals:
    """What derivatives are made of, at one point for each focals."""

    costs: Array
    errors: Array
    lengths: Array
    sides1: Array
    sides2: Array
    lines1: Array
    lines2: Array
    state: Array

    def replaced(self, where: Bools, other: Self) -> Self:
        """Return a copy with some focals as in another one."""
        values = {
            name: np.where(where.reshape(-1, *[1] * (old.ndim - 1)), vars(other)[name], old)
            for name, old in vars(self).items()
        }
        return type(self)(**values)


class _Fit:
    """Matrices ``E = U diag(1, s, 0) V^T`` in camera coordinates, one for each focals.

    An essential one has s = 1 and moves the nuisances; a fundamental one has them all at 0.
    """

    def __init__(
        self, pair: MatchedPair, focals1: Array, focals2: Array, *, is_essential: bool
    ) -> None:
        self._pair, num = pair, len(focals1)
        self._inverse1 = 1.0 / np.stack([focals1, focals1, np.ones(num)], axis=1)[:, None, :]
        self._inverse2 = 1.0 / np.stack([focals2, focals2, np.ones(num)], axis=1)[:, None, :]
        start = pair.fundamental / np.swapaxes(self._inverse2, 1, 2) / self._inverse1
        self._left, values, right = np.linalg.svd(start)
        self._right = np.swapaxes(right, 1, 2)
        self._state = np.zeros((num, NUM_PARAMETERS))  # of scale and nuisances only
        self._state[:, SCALE] = 1.0 if is_essential else values[:, 1] / values[:, 0]
        self._precision = np.zeros(NUM_PARAMETERS)
        self._precision[CENTERS] = PRINCIPAL_POINT_SIGMA**-2
        self._precision[DISTORTIONS] = DISTORTION_SIGMA**-2
        self._free = np.delete(np.arange(NUM_PARAMETERS), SCALE) if is_essential else np.arange(6)
        self._squares = [(points**2).sum(axis=1) for points in (pair.points1, pair.points2)]
        self.costs = np.zeros(0)
        self.hessians = np.zeros(0)
        self._minimize()

    def _minimize(self) -> None:
        damping = np.full(len(self._state), 1e-3)
        current = self._evaluate(self._left, self._right, self._state)
        for step in range(MAX_NUM_STEPS):
            hessians, gradients = self._derivatives(current)
            diagonals = damping[:, None] * np.einsum("gii->gi", hessians) + 1e-9
            damped = hessians + diagonals[..., None] * np.eye(diagonals.shape[1])
            moves = np.zeros_like(self._state)
            moves[:, self._free] = -np.linalg.solve(damped, gradients[..., None])[..., 0]
            state = self._state + moves
            left = self._left @ _rotations(moves[:, BASELINE])
            tilts = np.pad(moves[:, TILT], ((0, 0), (0, 1)))
            right = self._right @ _rotations(tilts)
            proposed = self._evaluate(left, right, state)
            gains = current.costs - proposed.costs
            better = gains > 0
            damping = np.where(better, np.maximum(damping / 5, 1e-7), damping * 10)
            self._left[better], self._right[better] = left[better], right[better]
            self._state[better] = state[better]
            current = current.replaced(better, proposed)
            if step > 3 and gains.max() < MIN_GAIN:
                break
        self.costs, self.hessians = current.costs, self._derivatives(current)[0]

    def _evaluate(self, left: Array, right: Array, state: Array) -> _Residuals:
        pair = self._pair
        centers, distortions = state[:, CENTERS], state[:, DISTORTIONS]
        moved1, moved2 = (
            points * (1.0 + distortions[:, None, side, None] * squares[:, None])
            - centers[:, None, 2 * side : 2 * side + 2]
            for side, (points, squares) in enumerate(
                zip((pair.points1, pair.points2), self._squares, strict=True)
            )
        )
        values = _singular_values(state)
        # rays in the frames of both factors, where E is diagonal
        rays1, rays2 = _rays(moved1, self._inverse1), _rays(moved2, self._inverse2)
        sides1, sides2 = rays1 @ right, rays2 @ left
        lines1 = ((sides2 * values) @ np.swapaxes(right, 1, 2))[..., :2] * self._inverse1[..., :2]
        lines2 = ((sides1 * values) @ np.swapaxes(left, 1, 2))[..., :2] * self._inverse2[..., :2]
        lengths = np.sqrt((lines1**2).sum(axis=2) + (lines2**2).sum(axis=2)) * pair.error
        lengths = np.maximum(lengths, np.finfo(float).tiny)
        errors = (sides1 * values * sides2).sum(axis=2) / lengths
        priors = 0.5 * (self._precision * state**2).sum(axis=1)
        costs = np.log1p(errors**2).sum(axis=1) + priors  # matches have Cauchy's distribution
        return _Residuals(costs, errors, lengths, sides1, sides2, lines1, lines2, state)

    def _derivatives(self, at: _Residuals) -> tuple[Array, Array]:
        """Return (G, P, P) second derivatives, to first order of the errors, and gradients."""
        pair = self._pair
        values = _singular_values(at.state)
        flat1, flat2 = at.sides1 * values, at.sides2 * values
        jacobians = np.empty((*at.errors.shape, NUM_PARAMETERS))
        jacobians[..., BASELINE] = np.cross(flat1, at.sides2)
        jacobians[..., TILT] = np.cross(flat2, at.sides1)[..., :2]
        jacobians[..., SCALE] = at.sides1[..., 1] * at.sides2[..., 1]
        jacobians[..., 6:8], jacobians[..., 8:10] = -at.lines1, -at.lines2
        jacobians[..., 10] = (at.lines1 * pair.points1).sum(axis=2) * self._squares[0]
        jacobians[..., 11] = (at.lines2 * pair.points2).sum(axis=2) * self._squares[1]
        jacobians = jacobians[..., self._free] / at.lengths[..., None]
        weights = 2.0 / (1.0 + at.errors**2)
        weighted = np.swapaxes(jacobians * weights[..., None], 1, 2)
        precision = self._precision[self._free]
        hessians = weighted @ jacobians + np.diag(precision)
        gradients = (weighted @ at.errors[..., None])[..., 0] + precision * at.state[:, self._free]
        return hessians, gradients


def _singular_values(state: Array) -> Array:
    """Return (G, 1, 3) singular values 1, s, 0 of the matrices."""
    values = np.tile([1.0, 0.0, 0.0], (len(state), 1, 1))
    values[:, 0, 1] = state[:, SCALE]
    return values


def _rays(points: Array, inverse: Array) -> Array:
    """Return (G, N, 3) rays of (G, N, 2) points."""
    return np.asarray(np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2) * inverse)


def _rotations(turns: Array) -> Array:
    """Return (G, 3, 3) rotations by (G, 3) axes times angles in rad (Rodrigues)."""
    angles = np.linalg.norm(turns, axis=1)[:, None, None]
    cross = np.zeros((len(turns), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -turns[:, 2], turns[:, 1], -turns[:, 0]
    cross -= np.swapaxes(cross, 1, 2)
    half = 0.5 * np.sinc(angles / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + np.sinc(angles / np.pi) * cross + half * cross @ cross)
