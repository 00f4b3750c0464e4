"""The joint covariance of all that a bundle adjustment refines.

COLMAP computes it (Triggs et al., Bundle adjustment - a modern synthesis, 2000, Sec. 9) of a
problem whose frame is fixed. Of COLMAP's own gauges, three constant points also fix the shape of
their triangle: a model that may be stretched along the axes of its images looks sure then. Here
seven numbers are fixed, as many as a frame has, so that what does not depend on the frame is as
uncertain as its images leave it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyceres

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.adjustment import Adjuster

POSES = pycolmap.BACovarianceOptionsParams.POSES
ALL = pycolmap.BACovarianceOptionsParams.ALL
NUM_FRAME_POINTS = 200  # of the longest tracks, among which three are chosen; resource
MIN_HEIGHT = 1e-3
"""Least height of the triangle of these, parts of its base: lower ones are lines; numeric."""
PLANE_SIGMA = 1e-3
"""By which the third point may leave its plane, parts of the base. Any number gives the same
covariances, but for rounding; numeric."""


class PlaneCost(pyceres.CostFunction):  # type: ignore[misc]
    """Keeps a point in a plane."""

    def __init__(self, point: Array, normal: Array, sigma: float) -> None:
        """Begin.

        Args:
            point: In the plane, (3,).
            normal: Of the plane, (3,), a unit vector.
            sigma: Distance of the plane at which the residual is one.
        """
        super().__init__()
        self.point = point.copy()
        self.slopes = normal / sigma
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([3])

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
        residuals[0] = self.slopes @ (parameters[0] - self.point)
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = self.slopes
        return True


@dataclass(frozen=True)
class CovarianceProblem:
    """Ceres' problem of a model, with all that its covariances need."""

    model: pycolmap.Reconstruction  # without frames that have no pose
    problem: Any

    @classmethod
    def of(
        cls, model: pycolmap.Reconstruction, adjuster: Adjuster
    ) -> "CovarianceProblem | None":
        """Return the problem of a model that has been adjusted.

        Args:
            model: It stays as it is.
            adjuster: With the priors of its cameras.

        Returns:
            The problem, None of rigs and where points lie on a line.
        """
        image_ids = model.reg_image_ids()
        if not all(model.images[key].is_ref_in_frame() for key in image_ids):
            return None  # COLMAP has no covariances of rigs
        if model.num_frames() > model.num_reg_frames():
            # COLMAP looks for covariances of all frames, also of those without a pose.
            model = pycolmap.Reconstruction(model)
            model.tear_down()
        found = cls(model, adjuster.whole_problem(model))
        return found if found._fix_frame() else None

    def covariance(self, params: Any) -> pycolmap.BACovariance | None:
        """Return the covariance, in units in which keypoints have a variance of one.

        Args:
            params: Whether only ``POSES`` are wanted, which is faster, or ``ALL``.

        Returns:
            The covariance, None where something is not determined at all.
        """
        wanted = pycolmap.BACovarianceOptions()
        wanted.params = params
        return pycolmap.estimate_ba_covariance_from_problem(
            wanted, self.model, self.problem
        )

    def _fix_frame(self) -> bool:
        """Fix two points, and a third one in a plane; tell whether there are such points."""
        corners = self._triangle()
        if corners is None:
            return False
        first, second, third = corners
        normal = np.cross(second - first, third - first)
        sigma = PLANE_SIGMA * float(np.linalg.norm(second - first))
        self.problem.set_parameter_block_constant(first)
        self.problem.set_parameter_block_constant(second)
        plane = PlaneCost(third, normal / np.linalg.norm(normal), sigma)
        self.problem.add_residual_block(plane, None, [third])
        return True

    def _triangle(self) -> list[Array] | None:
        """Return the positions of three points far from each other, None where there are none."""
        points = self.model.points3D
        ranked = sorted(points, key=lambda key: (-points[key].track.length(), key))
        blocks = list[Array]()
        for key in ranked[:NUM_FRAME_POINTS]:
            if self.problem.has_parameter_block(points[key].xyz):
                blocks.append(points[key].xyz)
        if len(blocks) < 3:
            return None
        from_first = np.array(blocks) - blocks[0]
        distances = np.linalg.norm(from_first, axis=1)
        second = int(distances.argmax())
        base = from_first[second]
        heights = np.linalg.norm(np.cross(from_first, base), axis=1)
        third = int(heights.argmax())
        if heights[third] <= MIN_HEIGHT * distances[second] ** 2:
            return None
        return [blocks[0], blocks[second], blocks[third]]
