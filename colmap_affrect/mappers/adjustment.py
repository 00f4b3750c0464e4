"""Bundle adjustment that knows what is known of the cameras.

It minimises robust reprojection errors and, of each camera that is not held, how far focal length
and distortion are from what is known of them beforehand. COLMAP's own adjustment has no such
priors: where few points are seen by many images, its focal lengths run away.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyceres
from pycolmap.cost_functions import ReprojErrorCost

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import SIGMA_PX
from colmap_affrect.colmap.cameras import TRUSTED, CameraRecord
from colmap_affrect.colmap.model_files import all_see_long_tracks
from colmap_affrect.mappers.tie_points import NONE, TiePoints

USUAL_FOCAL = 1.15  # longer sides: the median of usual lenses, which are of 25 to 70 mm on film
USUAL_SIGMA = 0.4  # deviation of the logarithm of a focal length of which nothing is known
EXIF_SIGMA = 0.08  # the same of one by EXIF: rounded, and of another distance of focus
DISTORTION_SIGMA = 0.07  # of the coefficients of a lens that is no fisheye
NOISE_PX = 0.7  # standard deviation of keypoints
UNKNOWN_SIGMA = 1e6  # of parameters that have no prior
DENSE_LIMIT = 60  # images up to which Ceres' dense solver is the faster one
MIN_LONG_TRACKS = 100  # of three images, that each image needs to do without tracks of two
FAST, MEDIUM, FINAL = 15, 50, 300  # iterations on the way, of models to compare, and at last
FIRST_STEPS = 3  # of an adjustment: they say nothing of those that follow
SMALL_STEP, NUM_SMALL = 0.001, 3
"""Steps in a row that bring less than this part of what the cost is above another one: the rest
changes that by less than other numbers of iterations do, four per cent."""


@dataclass(frozen=True)
class FocalPrior:
    """What is known of a focal length."""

    focal_px: float  # its median
    sigma: float  # standard deviation of its logarithm; 0 where it is given and held

    @classmethod
    def of(cls, camera: pycolmap.Camera, record: CameraRecord | None) -> "FocalPrior":
        """Return what is known of a camera of a database, by the record of it if there is one."""
        focal_px = float(camera.mean_focal_length())
        if record and "focal" in record.given:
            return cls(focal_px, 0.0)
        if record.source in TRUSTED if record else camera.has_prior_focal_length:
            return cls(focal_px, EXIF_SIGMA)
        return cls(USUAL_FOCAL * max(camera.width, camera.height), USUAL_SIGMA)

    def cost(self, focal_px: float) -> float:
        """Return how much a focal length costs, in nats."""
        if not self.sigma:
            return 0.0
        return 0.5 * (math.log(max(focal_px, 1e-9) / self.focal_px) / self.sigma) ** 2


class Settled(pyceres.IterationCallback):  # type: ignore[misc]
    """Ends an adjustment once it is clear how far its cost stays above that of another one.

    That is so where the excess hardly shrinks any more, and where even all iterations that are left
    would not bring the cost down to ``enough`` times the other one.
    """

    def __init__(self, other_cost: float, enough: float, max_iterations: int) -> None:
        """Begin.

        Args:
            other_cost: what the cost is compared with, in nats.
            enough: factor from which on it does not matter how much higher the cost is.
            max_iterations: of the adjustment.
        """
        super().__init__()
        self.other_cost = other_cost
        self.enough = enough
        self.max_iterations = max_iterations
        self.noise_px = 1.0  # by which the solver's costs are scaled; an adjuster says it
        self._num_small = 0  # steps in a row that brought little

    def __call__(self, step: Any) -> Any:
        """See Ceres' IterationCallback."""
        is_settled = step.iteration >= FIRST_STEPS and self._is_settled(step)
        types = pyceres.CallbackReturnType
        return types.SOLVER_TERMINATE_SUCCESSFULLY if is_settled else types.SOLVER_CONTINUE

    def _is_settled(self, step: Any) -> bool:
        if not step.step_is_successful:
            return False
        cost = step.cost / self.noise_px**2
        change = step.cost_change / self.noise_px**2
        excess = cost - self.other_cost
        self._num_small = self._num_small + 1 if change <= SMALL_STEP * excess else 0
        num_left = max(0, self.max_iterations - step.iteration)
        is_enough = cost - num_left * change >= self.enough * self.other_cost
        return is_enough or self._num_small >= NUM_SMALL


def priors_of(
    cameras: Iterable[pycolmap.Camera], records: Mapping[int, CameraRecord]
) -> dict[int, FocalPrior]:
    """Return what is known of the focal lengths of cameras, by id."""
    return {c.camera_id: FocalPrior.of(c, records.get(c.camera_id)) for c in cameras}


@dataclass(frozen=True)
class Adjuster:
    """Adjusts models."""

    priors: Mapping[int, FocalPrior]  # by camera id
    noise_px: float  # standard deviation of the keypoints, the scale of the robust loss
    refining: pycolmap.BundleAdjustmentOptions  # say which parameters of cameras are refined
    constant: frozenset[int] = frozenset()  # ids of the cameras of which nothing is refined
    constant_frames: frozenset[int] = frozenset()  # ids of the frames that stay where they are
    tie_points: TiePoints = NONE  # observed by all models that have two of their images

    def begin(self, model: pycolmap.Reconstruction) -> None:
        """Give the cameras of a model that are not held the focal lengths of their priors."""
        for key, camera in model.cameras.items():
            prior = self.priors.get(key)
            if prior and prior.sigma and key not in self.constant:
                camera.params[list(camera.focal_length_idxs())] = prior.focal_px

    def adjust(
        self,
        model: pycolmap.Reconstruction,
        max_iterations: int,
        image_ids: Iterable[int] | None = None,
        settled: Settled | None = None,
    ) -> float:
        """Adjust poses, points and cameras in place; return the cost, infinite if that fails.

        Of some images only, the others stay, and the cameras that they share. The cost is in nats.
        ``settled`` may end it before.
        """
        self.tie_points.observe(model)
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.refine_focal_length = self.refining.refine_focal_length
        options.refine_principal_point = self.refining.refine_principal_point
        options.refine_extra_params = self.refining.refine_extra_params
        options.refine_sensor_from_rig = self.refining.refine_sensor_from_rig
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = self.noise_px
        config, registered = pycolmap.BundleAdjustmentConfig(), set(model.reg_image_ids())
        has_long = all_see_long_tracks(model, registered, MIN_LONG_TRACKS)
        options.min_track_length = 3 if has_long else 2
        images = sorted(registered if image_ids is None else set(image_ids))
        for image_id in images:
            config.add_image(image_id)
        used = {model.images[image_id].camera_id for image_id in images}
        others = registered.difference(images)
        held = {model.images[image_id].camera_id for image_id in others} | self.constant
        for key in sorted(used & held):
            config.set_constant_cam_intrinsics(key)
        frames = {model.images[image_id].frame_id for image_id in images} & self.constant_frames
        for frame_id in frames:
            config.set_constant_rig_from_world_pose(frame_id)
        if image_ids is None and not frames:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        problem = pycolmap.create_default_ceres_bundle_adjuster(options, config, model).problem
        self._add_tie_points(problem, model)
        for key in sorted(used - held):
            if problem.has_parameter_block(model.cameras[key].params):
                self._add_prior(problem, model.cameras[key])
        solver = pyceres.SolverOptions()
        solver.max_num_iterations, solver.num_threads = max_iterations, 1
        solver.function_tolerance = 1e-5 if max_iterations <= FAST else 1e-7
        kinds = pyceres.LinearSolverType
        is_small = len(images) <= DENSE_LIMIT
        solver.linear_solver_type = kinds.DENSE_SCHUR if is_small else kinds.SPARSE_SCHUR
        if settled:
            settled.noise_px = self.noise_px
            solver.callbacks = [settled]
        summary = pyceres.SolverSummary()
        pyceres.solve(solver, problem, summary)
        model.update_point_3d_errors()
        usable = summary.IsSolutionUsable()
        return float(summary.final_cost) / self.noise_px**2 if usable else math.inf

    def _add_tie_points(self, problem: Any, model: pycolmap.Reconstruction) -> None:
        """Give tie points the weight of their noise, far from where they should be, too.

        They are points as all others before, whose loss hardly pulls from there.
        """
        covariance = np.eye(2) * (SIGMA_PX / self.noise_px) ** 2
        for _, image_id, mark in self.tie_points.observed(model):
            image, place = model.images[image_id], model.points3D[mark.point3D_id].xyz
            camera, frame = model.cameras[image.camera_id], model.frames[image.frame_id]
            is_reference = frame.rig is None or frame.rig.is_ref_sensor(camera.sensor_id)
            if frame.rig_from_world is None or not is_reference:
                continue
            blocks = [place, frame.rig_from_world.params, camera.params]
            if all(map(problem.has_parameter_block, blocks)):
                cost = ReprojErrorCost(camera.model, covariance, mark.xy)
                problem.add_residual_block(cost, pyceres.CauchyLoss(4 * self.noise_px), blocks)

    def _add_prior(self, problem: Any, camera: pycolmap.Camera) -> None:
        prior = self.priors[camera.camera_id]
        focal, extra = list(camera.focal_length_idxs()), list(camera.extra_params_idxs())
        if not prior.sigma:  # distortion alone is refined
            fixed = [*focal, *camera.principal_point_idxs()]
            if len(fixed) == len(camera.params):
                return  # COLMAP holds it already
            manifold = pyceres.SubsetManifold(len(camera.params), fixed)
            problem.set_manifold(camera.params, manifold)
            return
        mean, sigma = camera.params.copy(), np.full(len(camera.params), UNKNOWN_SIGMA)
        mean[focal], sigma[focal] = prior.focal_px, prior.sigma * prior.focal_px
        mean[extra], sigma[extra] = 0.0, DISTORTION_SIGMA
        # Reprojection errors are in px, priors in units of their deviation times the noise.
        normal = pyceres.factors.NormalPrior(mean, np.diag((sigma / self.noise_px) ** 2))
        problem.add_residual_block(normal, None, [camera.params])
