"""How uncertain the focal lengths of a model are, and whether all fit better by one factor.

The joint covariance (:mod:`colmap_affrect.mappers.covariance`) has what poses, points, principal
points and all other focal lengths leave open. So it has what no trial of one camera finds: all
focal lengths of some prints may grow at once.
"""

import math
from collections.abc import Sequence

import numpy as np
import pyceres

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.adjustment import FINAL, Adjuster, solver_options
from colmap_affrect.mappers.camera_priors import MIN_FOCAL_PX
from colmap_affrect.mappers.covariance import ALL, CovarianceProblem

COMMON_SIGMA = 1e-3
"""By which logarithms of focal lengths that grow together may differ: less than any is known to,
and enough for the solver to move them; numeric."""


class CommonFactorCost(pyceres.CostFunction):  # type: ignore[misc]
    """Ties the focal length of a camera to a factor that it has in common with others."""

    def __init__(self, camera: pycolmap.Camera, sigma: float) -> None:
        """Begin.

        Args:
            camera: With the focal length for which the factor is one. Its parameters are the first
                block, the logarithm of the factor is the second one.
            sigma: By which the logarithms may differ, in units of the residuals of the problem.
        """
        super().__init__()
        self.focal = list(camera.focal_length_idxs())
        self.focals_px = np.maximum(camera.params[self.focal], MIN_FOCAL_PX)
        self.weight = 1.0 / sigma
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([len(camera.params), 1])

    def Evaluate(
        self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None
    ) -> bool:
        """Compute the residual; see Ceres' CostFunction.

        Args:
            parameters: The blocks.
            residuals: Of one number, changed in place.
            jacobians: One for each block, changed in place; None where none is wanted.

        Returns:
            Whether that was possible.
        """
        focals_px = np.maximum(parameters[0][self.focal], MIN_FOCAL_PX)
        factor = float(np.mean(np.log(focals_px / self.focals_px)))
        residuals[0] = self.weight * (factor - parameters[1][0])
        if jacobians is None:
            return True
        if jacobians[0] is not None:
            slopes = np.zeros(len(parameters[0]))
            slopes[self.focal] = self.weight / (len(self.focal) * focals_px)
            jacobians[0][:] = slopes
        if jacobians[1] is not None:
            jacobians[1][:] = -self.weight
        return True


def adjust_common_factor(
    model: pycolmap.Reconstruction, adjuster: Adjuster, camera_ids: Sequence[int]
) -> float:
    """Adjust a model while some focal lengths may grow by one factor, all together.

    Args:
        model: Changed in place.
        adjuster: With priors by which these focal lengths are free.
        camera_ids: Their cameras.

    Returns:
        The cost as of :meth:`Adjuster.adjust`, infinite if the adjustment fails.
    """
    problem = adjuster.whole_problem(model)
    log_factor = np.zeros(1)
    for key in camera_ids:
        camera = model.cameras[key]
        if problem.has_parameter_block(camera.params):
            cost = CommonFactorCost(camera, COMMON_SIGMA / adjuster.noise_px)
            problem.add_residual_block(cost, None, [camera.params, log_factor])
    summary = pyceres.SolverSummary()
    pyceres.solve(solver_options(FINAL, model.num_reg_images()), problem, summary)
    model.update_point_3d_errors()
    if not summary.IsSolutionUsable():
        return math.inf
    return float(summary.final_cost) / adjuster.noise_px**2


def focal_sigmas(
    model: pycolmap.Reconstruction, adjuster: Adjuster, camera_ids: Sequence[int]
) -> dict[int, float] | None:
    """Return how uncertain focal lengths are while all else of a model may move.

    Args:
        model: That has been adjusted.
        adjuster: With the priors of its cameras.
        camera_ids: Cameras whose focal lengths are refined, one at least.

    Returns:
        The deviations of the logarithms of the focal lengths, by camera id; None where they cannot
        be computed.
    """
    joint = CovarianceProblem.of(model, adjuster)
    covariance = joint.covariance(ALL) if joint else None
    if joint is None or covariance is None:
        return None
    found = dict[int, float]()
    for key in camera_ids:
        sigma = _log_focal_sigma(joint.model.cameras[key], covariance)
        found[key] = adjuster.noise_px * sigma
    return found if all(map(math.isfinite, found.values())) else None


def _log_focal_sigma(
    camera: pycolmap.Camera, covariance: pycolmap.BACovariance
) -> float:
    """Return the deviation of the mean logarithm of the focal lengths of a camera.

    Of cameras that are not refined it is infinite. Focal lengths are the first free parameters.
    """
    of_camera = covariance.get_other_params_cov(camera.params)
    if of_camera is None:
        return math.inf
    indices = list(camera.focal_length_idxs())
    number = len(indices)
    slopes = 1.0 / (number * np.maximum(camera.params[indices], MIN_FOCAL_PX))
    variance = float(slopes @ of_camera[:number, :number] @ slopes)
    return math.sqrt(max(variance, 0.0))
