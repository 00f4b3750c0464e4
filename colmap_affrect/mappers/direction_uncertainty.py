"""How well a model tells in which direction its photographs stand from each other.

Photographs that were taken from nearly one place have relative positions that noise decides, and
where their focal lengths are not known an error of these moves them along their axes. The
joint covariance (:mod:`colmap_affrect.mappers.covariance`) tells how far.
"""

import itertools
import math

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.two_views import cross_product_matrix
from colmap_affrect.mappers.adjustment import Adjuster
from colmap_affrect.mappers.covariance import POSES, CovarianceProblem

MAX_COVARIANCE_IMAGES = 100
"""Larger models are not looked at: the time grows with the cube of the images, and half of so many
hardly stand at one place; resource."""
UNDETERMINED_DEG = 180.0
"""From this deviation on a direction may be any: what tracks tell is off by a few degrees, what
they do not tell by thousands; theory."""


def direction_sigmas_deg(
    model: pycolmap.Reconstruction, adjuster: Adjuster
) -> dict[int, float]:
    """Return how uncertain the directions from each image to others are.

    Directions that tracks do not determine are passed over: the scale of bridges is known by
    something else (:mod:`colmap_affrect.mappers.bridging`), of which the covariance knows nothing.

    Args:
        model: That has been adjusted.
        adjuster: With the priors of its cameras.

    Returns:
        By image id the deviation in degrees that the directions of translation to at least half of
        the others do not exceed. Images of which it is not known are left out.
    """
    image_ids = sorted(model.reg_image_ids())
    # A limit of time, other than that of focal_observability
    if not 3 <= len(image_ids) <= MAX_COVARIANCE_IMAGES:
        return {}
    problem = CovarianceProblem.of(model, adjuster)
    covariance = problem.covariance(POSES) if problem else None
    if problem is None or covariance is None:
        return {}
    num_needed = math.ceil((len(image_ids) - 1) / 2)
    found = dict[int, float]()
    determined = _determined(model, covariance, adjuster.noise_px)
    for image_id, sigmas_deg in determined.items():
        if len(sigmas_deg) >= num_needed:
            found[image_id] = sorted(sigmas_deg)[num_needed - 1]
    return found


def _determined(
    model: pycolmap.Reconstruction, covariance: pycolmap.BACovariance, noise_px: float
) -> dict[int, list[float]]:
    """Return the deviations of the directions of each image that tracks determine, in degrees."""
    image_ids = sorted(model.reg_image_ids())
    found: dict[int, list[float]] = {image_id: [] for image_id in image_ids}
    for first, second in itertools.combinations(image_ids, 2):
        sigma_deg = noise_px * _direction_sigma_deg(model, covariance, first, second)
        if sigma_deg < UNDETERMINED_DEG:
            found[first].append(sigma_deg)
            found[second].append(sigma_deg)
    return found


def _direction_sigma_deg(
    model: pycolmap.Reconstruction,
    covariance: pycolmap.BACovariance,
    first: int,
    second: int,
) -> float:
    """Return the deviation of the direction from one image to another, in the frame of the first.

    It is that of both angles together, the root of the sum of their variances, for keypoints with a
    variance of one. COLMAP's own covariance of relative poses takes the parameters of a pose for
    those of SE(3); they are half the angles of a rotation, applied last, and the translation.
    """
    of_first = covariance.get_cam_cov_from_world(first)
    of_second = covariance.get_cam_cov_from_world(second)
    cross = covariance.get_cam_cross_cov_from_world(first, second)
    if of_first is None or of_second is None or cross is None:
        return math.inf
    joint = np.block([[of_first, cross], [np.transpose(cross), of_second]])
    if not np.isfinite(joint).all():
        return math.inf
    first_pose = model.images[first].cam_from_world()
    second_pose = model.images[second].cam_from_world()
    rotation: Array = first_pose.rotation.matrix() @ second_pose.rotation.matrix().T
    carried: Array = rotation @ second_pose.translation
    to_second: Array = first_pose.translation - carried
    distance = float(np.linalg.norm(to_second))
    if distance == 0.0:
        return math.inf
    by_first_rotation = 2.0 * cross_product_matrix(carried)
    by_second_rotation = -2.0 * rotation @ cross_product_matrix(second_pose.translation)
    jacobian = np.hstack([by_first_rotation, np.eye(3), by_second_rotation, -rotation])
    direction = to_second / distance
    across = np.eye(3) - np.outer(direction, direction)
    variance = float(np.trace(across @ jacobian @ joint @ jacobian.T @ across))
    return math.degrees(math.sqrt(max(variance, 0.0)) / distance)
