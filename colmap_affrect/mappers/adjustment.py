"""Bundle adjustment with priors on intrinsics.

It minimises robust reprojection errors and, for each camera that is not constant, the deviation of
focal length and distortion from their priors. COLMAP's own adjustment has no such priors: where
few points are seen by many images, its focal lengths run away.
"""

import copy
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyceres
from pycolmap.cost_functions import ReprojErrorCost

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import AGREEING_SIGMAS, SIGMA_PX
from colmap_affrect.colmap.model_files import all_see_long_tracks
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.camera_priors import (
    DISTORTION_SIGMA,
    MIN_FOCAL_PX,
    CameraPrior,
    usual_principal_point,
)
from colmap_affrect.mappers.tie_points import NO_TIE_POINTS, TiePoints

NOISE_PX = 0.7  # standard deviation of keypoints, measured on the benchmark scenes

FAST = 15  # iterations while a model grows; resource
MEDIUM = 50  # iterations before models are compared; resource
FINAL = 300  # iterations of models that are kept; resource
# Relative change of the cost at which Ceres ends a fast adjustment; numeric
FAST_TOLERANCE = 1e-5
TOLERANCE = 1e-7  # the same of all others; numeric
DENSE_LIMIT = 60  # images up to which Ceres' dense solver is the faster one (measured)
MIN_LONG_TRACKS = 100
"""Tracks of three images that every image needs before tracks of two are left out (judged)."""

# When a trial adjustment ends early. Measured: this changes the growth of the cost by less than
# three times as many iterations do, four per cent.
FIRST_STEPS = 3  # of an adjustment, which say nothing of those that follow
# Part of the excess over the other cost, below which a step is small; measured
SMALL_STEP = 0.001
NUM_SMALL = 3  # small steps in a row that end an adjustment; measured
SMALL_CHANGE = 0.01
"""Nats that a small step lowers a cost by which is only compared: hundreds of them are needed for a
gain that counts (model_score.MIN_SCORE_GAIN; theory)."""


class CostStop(pyceres.IterationCallback):  # type: ignore[misc]
    """Ends an adjustment whose cost, or score, is all that is asked for.

    That is so once some steps in a row lower the cost by next to nothing. Those that are left only
    let single outliers go.
    """

    def __init__(self) -> None:
        """Begin; one adjustment has one."""
        super().__init__()
        self.noise_px = 1.0  # scale of the solver's costs; the adjuster sets it
        self._num_small = 0  # small steps in a row

    def __call__(self, step: Any) -> Any:
        """See Ceres' IterationCallback."""
        if step.iteration == 0 or not step.step_is_successful:
            return pyceres.CallbackReturnType.SOLVER_CONTINUE
        if step.cost_change <= SMALL_CHANGE * self.noise_px**2:
            self._num_small += 1
        else:
            self._num_small = 0
        if self._num_small >= NUM_SMALL:
            return pyceres.CallbackReturnType.SOLVER_TERMINATE_SUCCESSFULLY
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


class EarlyStop(pyceres.IterationCallback):  # type: ignore[misc]
    """Ends an adjustment once it is clear how far its cost stays above that of another one.

    That is so where the excess hardly shrinks any more, and where even all iterations that are left
    would not bring the cost down to ``enough`` times the other one.
    """

    def __init__(self, other_cost: float, enough: float, max_iterations: int) -> None:
        """Begin.

        Args:
            other_cost: Cost to compare with, as :meth:`Adjuster.adjust` returns it.
            enough: Factor from which on it does not matter how much higher the cost is.
            max_iterations: Limit of the adjustment.
        """
        super().__init__()
        self.other_cost = other_cost
        self.enough = enough
        self.max_iterations = max_iterations
        self.noise_px = 1.0  # scale of the solver's costs; the adjuster sets it
        self._num_small = 0  # small steps in a row

    def __call__(self, step: Any) -> Any:
        """See Ceres' IterationCallback."""
        if step.iteration >= FIRST_STEPS and self._is_clear(step):
            return pyceres.CallbackReturnType.SOLVER_TERMINATE_SUCCESSFULLY
        return pyceres.CallbackReturnType.SOLVER_CONTINUE

    def _is_clear(self, step: Any) -> bool:
        if not step.step_is_successful:
            return False
        cost = step.cost / self.noise_px**2
        change = step.cost_change / self.noise_px**2
        excess = cost - self.other_cost
        if change <= SMALL_STEP * excess:
            self._num_small += 1
        else:
            self._num_small = 0
        num_left = max(0, self.max_iterations - step.iteration)
        lowest_cost = cost - num_left * change
        stays_above = lowest_cost >= self.enough * self.other_cost
        return stays_above or self._num_small >= NUM_SMALL


class IntrinsicsCost(pyceres.CostFunction):  # type: ignore[misc]
    """The prior of intrinsics: focal lengths log-normal, all else that is free normal.

    Residuals are deviations in units of ``noise_px``, as reprojection errors are in px.
    """

    def __init__(
        self,
        camera: pycolmap.Camera,
        prior: CameraPrior,
        noise_px: float,
        constant: Sequence[int],
    ) -> None:
        """Begin.

        Args:
            camera: Whose parameters are observed.
            prior: What is known of them.
            noise_px: Standard deviation of keypoints.
            constant: Indices of the parameters that are constant, which cost nothing.
        """
        super().__init__()
        number = len(camera.params)
        self.focal = list(camera.focal_length_idxs())
        self.focal_px = prior.focal_px
        self.mean: Array = np.zeros(number)
        self.weights: Array = np.zeros(number)
        if prior.sigma:
            # Two focal lengths of one camera are one observation, as the score counts them.
            num_focals = len(self.focal)
            self.weights[self.focal] = noise_px / prior.sigma / math.sqrt(num_focals)
        self.weights[list(camera.extra_params_idxs())] = noise_px / DISTORTION_SIGMA
        indices = list(camera.principal_point_idxs())
        center = prior.principal_point or usual_principal_point(camera)
        self.mean[indices] = center.center_px
        self.weights[indices] = noise_px / np.array(center.sigmas_px)
        self.weights[list(constant)] = 0.0
        self.set_num_residuals(number)
        self.set_parameter_block_sizes([number])

    def Evaluate(
        self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None
    ) -> bool:
        """See Ceres' CostFunction."""
        params = parameters[0]
        focals_px = np.maximum(params[self.focal], MIN_FOCAL_PX)
        deviations = params - self.mean
        deviations[self.focal] = np.log(focals_px / self.focal_px)
        residuals[:] = self.weights * deviations
        if jacobians is not None and jacobians[0] is not None:
            slopes = self.weights.copy()
            slopes[self.focal] /= focals_px
            jacobians[0][:] = np.diag(slopes).ravel()
        return True


@dataclass(frozen=True)
class _Mark:
    """Where an image of a problem observes a tie point."""

    xy: Array  # (2,) px
    camera_model: pycolmap.CameraModelId
    blocks: list[
        Array
    ]  # parameters of its pose and of its camera, as the problem has them


@dataclass(frozen=True)
class Adjuster:
    """Adjusts models with priors on intrinsics."""

    priors: Mapping[int, CameraPrior]  # by camera id
    noise_px: float  # standard deviation of the keypoints, the scale of the robust loss
    # Say which parameters of cameras are refined
    refining: pycolmap.BundleAdjustmentOptions
    # Ids of the cameras of which nothing is refined
    constant: frozenset[int] = frozenset()
    # Ids of the frames whose poses are constant
    constant_frames: frozenset[int] = frozenset()
    # Observed by all models that have two of their images
    tie_points: TiePoints = NO_TIE_POINTS
    # Of models only costs and scores are asked for, which single outliers do not decide
    compares_only: bool = False

    def set_initial_focals(
        self, model: pycolmap.Reconstruction, used: Collection[int] = ()
    ) -> None:
        """Give the cameras of a model that are not constant the focal lengths of their priors.

        Args:
            model: Changed in place.
            used: Ids of the cameras that stay as they are.
        """
        for key, camera in model.cameras.items():
            if key not in used:
                self._set_initial_focal(camera)

    def initial_camera(self, camera: pycolmap.Camera) -> pycolmap.Camera:
        """Return a camera of the database as models begin with it, by its prior."""
        initial = copy.copy(camera)
        self._set_initial_focal(initial)
        return initial

    def _set_initial_focal(self, camera: pycolmap.Camera) -> None:
        prior = self.priors.get(camera.camera_id)
        if prior and prior.sigma and camera.camera_id not in self.constant:
            camera.params[list(camera.focal_length_idxs())] = prior.focal_px

    def adjust(
        self,
        model: pycolmap.Reconstruction,
        max_iterations: int,
        image_ids: Iterable[int] | None = None,
        early_stop: EarlyStop | None = None,
    ) -> float:
        """Adjust poses, points and cameras in place.

        Args:
            model: Changed in place.
            max_iterations: Limit for Ceres.
            image_ids: Images to adjust, all by default. The other images are constant, and
                the cameras that they share with these.
            early_stop: May end the adjustment before it has converged.

        Returns:
            The cost in units of the variance of the keypoints, a negative log-likelihood;
            infinite if the adjustment fails.
        """
        self.tie_points.observe(model)
        registered = set(model.reg_image_ids())
        images = sorted(registered if image_ids is None else set(image_ids))
        cameras = {model.images[image_id].camera_id for image_id in images}
        others = registered.difference(images)
        cameras_of_others = {model.images[image_id].camera_id for image_id in others}
        constant = cameras_of_others | self.constant
        config = self._config(
            model=model,
            image_ids=images,
            constant_cameras=cameras & constant,
            fix_gauge=image_ids is None,
        )
        problem = self._problem(model, config, cameras - constant)
        solver = solver_options(max_iterations, len(images))
        stop: CostStop | EarlyStop | None = early_stop
        if self.compares_only and not stop:
            stop = CostStop()
        if stop:
            stop.noise_px = self.noise_px
            solver.callbacks = [stop]
        summary = pyceres.SolverSummary()
        pyceres.solve(solver, problem, summary)
        model.update_point_3d_errors()
        if not summary.IsSolutionUsable():
            return math.inf
        return float(summary.final_cost) / self.noise_px**2

    def whole_problem(self, model: pycolmap.Reconstruction) -> Any:
        """Return Ceres' problem of all images of a model, whose frame nothing fixes."""
        images = sorted(model.reg_image_ids())
        cameras = {model.images[image_id].camera_id for image_id in images}
        config = self._config(
            model=model,
            image_ids=images,
            constant_cameras=cameras & self.constant,
            fix_gauge=False,
        )
        return self._problem(model, config, cameras - self.constant)

    def _problem(
        self,
        model: pycolmap.Reconstruction,
        config: pycolmap.BundleAdjustmentConfig,
        free_cameras: Set[int],
    ) -> Any:
        """Return Ceres' problem, with tie points and the priors of the cameras that are free."""
        options = self._options(model, free_cameras)
        problem = pycolmap.create_default_ceres_bundle_adjuster(
            options, config, model
        ).problem
        self._add_tie_points(problem, model)
        for key in sorted(free_cameras):
            if problem.has_parameter_block(model.cameras[key].params):
                self._add_prior(problem, model.cameras[key])
        return problem

    def _options(
        self, model: pycolmap.Reconstruction, free_cameras: Iterable[int]
    ) -> pycolmap.BundleAdjustmentOptions:
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.refine_focal_length = self.refining.refine_focal_length
        options.refine_principal_point = any(map(self._is_center_free, free_cameras))
        options.refine_extra_params = self.refining.refine_extra_params
        options.refine_sensor_from_rig = self.refining.refine_sensor_from_rig
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = self.noise_px
        has_long = all_see_long_tracks(model, model.reg_image_ids(), MIN_LONG_TRACKS)
        options.min_track_length = 3 if has_long else 2
        return options

    def _config(
        self,
        model: pycolmap.Reconstruction,
        image_ids: Iterable[int],
        constant_cameras: Iterable[int],
        *,
        fix_gauge: bool,
    ) -> pycolmap.BundleAdjustmentConfig:
        """Return which images are adjusted, and which cameras and frames are constant."""
        config = pycolmap.BundleAdjustmentConfig()
        frames = set[int]()
        for image_id in image_ids:
            config.add_image(image_id)
            frames.add(model.images[image_id].frame_id)
        for key in sorted(constant_cameras):
            config.set_constant_cam_intrinsics(key)
        constant_frames = frames & self.constant_frames
        for frame_id in constant_frames:
            config.set_constant_rig_from_world_pose(frame_id)
        if fix_gauge and not constant_frames:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        return config

    def _add_tie_points(self, problem: Any, model: pycolmap.Reconstruction) -> None:
        """Add tie points once more, with the weight of their own noise.

        COLMAP has added them as points like all others, whose robust loss hardly pulls where a
        mark is far from its reprojection. Here it does up to the error of marks that fit. Where
        COLMAP leaves out tracks of two images, tie points of two images are added here alone.
        """
        covariance = np.eye(2) * (SIGMA_PX / self.noise_px) ** 2
        marks_of = defaultdict[int, list[_Mark]](list)
        for _, image_id, observed in self.tie_points.observed(model):
            blocks = _pose_and_camera(model, image_id)
            if blocks and all(map(problem.has_parameter_block, blocks)):
                camera = model.cameras[model.images[image_id].camera_id]
                mark = _Mark(observed.xy, camera.model, blocks)
                marks_of[observed.point3D_id].append(mark)
        for point_id, marks in marks_of.items():
            point = model.points3D[point_id]
            has_all_marks = len(marks) == point.track.length()
            if not (problem.has_parameter_block(point.xyz) or has_all_marks):
                continue
            for mark in marks:
                cost = ReprojErrorCost(mark.camera_model, covariance, mark.xy)
                loss = pyceres.CauchyLoss(AGREEING_SIGMAS * self.noise_px)
                problem.add_residual_block(cost, loss, [point.xyz, *mark.blocks])

    def _add_prior(self, problem: Any, camera: pycolmap.Camera) -> None:
        """Keep constant what of a camera is known, and add the prior of what is not."""
        prior = self.priors[camera.camera_id]
        constant = self._constant_parameters(camera)
        number = len(camera.params)
        if len(constant) == number:
            problem.set_parameter_block_constant(camera.params)
            return
        if constant:
            problem.set_manifold(
                camera.params, pyceres.SubsetManifold(number, constant)
            )
        problem.add_residual_block(
            IntrinsicsCost(camera, prior, self.noise_px, constant),
            None,
            [camera.params],
        )

    def _constant_parameters(self, camera: pycolmap.Camera) -> list[int]:
        """Return the indices of the parameters of a camera that are constant."""
        prior = self.priors[camera.camera_id]
        constant = list[int]()
        if not (self.refining.refine_focal_length and prior.sigma):
            constant += camera.focal_length_idxs()
        if not self._is_center_free(camera.camera_id):
            constant += camera.principal_point_idxs()
        if not (self.refining.refine_extra_params and prior.has_distortion):
            constant += camera.extra_params_idxs()
        return sorted(constant)

    def _is_center_free(self, camera_id: int) -> bool:
        """Tell whether the principal point of a camera is refined."""
        prior = self.priors[camera_id]
        return bool(prior.principal_point) or (
            self.refining.refine_principal_point and prior.sigma > 0.0
        )


def _pose_and_camera(model: pycolmap.Reconstruction, image_id: int) -> list[Array]:
    """Return the parameters of the pose and of the camera of an image.

    None of a sensor of a rig that is not its reference: the pose of its frame is that of another.
    """
    image = model.images[image_id]
    camera = model.cameras[image.camera_id]
    frame = model.frames[image.frame_id]
    rig = frame.rig
    is_reference = rig is None or rig.is_ref_sensor(camera.sensor_id)
    if frame.rig_from_world is None or not is_reference:
        return []
    return [frame.rig_from_world.params, camera.params]


def solver_options(max_iterations: int, num_images: int) -> Any:
    """Return Ceres' options for an adjustment of so many images."""
    options = pyceres.SolverOptions()
    options.max_num_iterations = max_iterations
    options.num_threads = 1
    options.function_tolerance = FAST_TOLERANCE if max_iterations <= FAST else TOLERANCE
    is_small = num_images <= DENSE_LIMIT
    kinds = pyceres.LinearSolverType
    options.linear_solver_type = kinds.DENSE_SCHUR if is_small else kinds.SPARSE_SCHUR
    return options
