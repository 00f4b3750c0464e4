"""How well the points of a model tell its focal lengths.

Models are adjusted again with other focal lengths: where that hardly raises the cost, any focal
length fits, and where it lowers the cost, a given one is wrong.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import sampling_step
from colmap_affrect.mappers.adjustment import FINAL, NOISE_PX, Adjuster, EarlyStop
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.camera_priors import (
    LYING_LINES,
    CameraPrior,
    camera_priors,
    with_distortion_of,
)
from colmap_affrect.mappers.focal_uncertainty import (
    adjust_common_factor,
    focal_sigmas,
)
from colmap_affrect.mappers.model_score import num_occupied_cells
from colmap_affrect.mappers.other_cameras import (
    NO_OTHER_CAMERAS,
    OtherCameras,
    pose_turns_deg,
)
from colmap_affrect.mappers.pair_graph import cameras_of, has_rigs
from colmap_affrect.parallel.executor import available_cores, map_ordered

FACTORS = 1.25, 0.8
"""Other focal lengths that are tried: with these, poses are off by 5 degrees and more (judged)."""
MIN_GROWTH = 0.003  # of the cost with another focal length: less is nothing (judged)
MAX_GROWTH = 1.0  # that of a known focal length: more makes none surer; theory
# Of the logarithm of a given focal length while others are tried: nearly free; theory
FREE_SIGMA = 1.0
# Of the logarithm of a given focal length, from which on another one is named; display
MIN_MOVE = 0.1
WRONG_SHARE = LYING_LINES
"""Of given focal lengths, those of another lens or of enlarged parts, before points are seen: the
same as of lines."""
# Of a trial: three times as many change growths by 4 % at most (measured)
NUM_ITERATIONS = 100
# More cameras than that are tried several at once, to save time; resource
MAX_NUM_TRIALS = 12
# Larger models have points of many images, which tell focal lengths; resource
MAX_TRIAL_IMAGES = 100
MAX_NUM_POINTS = 2_000  # of a model that is tried, to save time; resource
MAX_NUM_OBSERVATIONS = 3_000
"""The same of a model of rigs: with the poses of the sensors as unknowns, too, each observation
takes two or three times as long; resource."""
NUM_OBSERVATIONS_PER_IMAGE = 15
"""Of the same where growths are measured: with 12 they are within a third of what all observations
say, with 20 within a seventh, at keypoint noise of 0.1 to 1 px (measured)."""
MIN_COST = 1e-9  # costs are divided by; numeric
MIN_SIGMA = 1e-6  # of the logarithm of a focal length, which is divided by; numeric
GAUSSIAN_BY_ROBUST = 2.5
"""Growth by the covariance over that of trials, in which errors count less the larger they are: the
median of cameras whose cost grows by 0.01 to 0.03 (measured, 96 cameras of 25 models)."""


class _FocalTrials:
    """Adjusts a model with other focal lengths of some cameras."""

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        priors: Mapping[int, CameraPrior],
        refining: pycolmap.BundleAdjustmentOptions,
        constant: frozenset[int],
    ) -> None:
        """Adjust the model as it is.

        Args:
            model: Changed in place.
            priors: Priors of the focal lengths, by camera id.
            refining: Say which parameters of cameras are refined.
            constant: Ids of the cameras of which nothing is refined.
        """
        self.model = model
        self.priors = priors
        self.refining = refining
        self.constant = constant
        self.adjuster = Adjuster(
            priors=priors, noise_px=NOISE_PX, refining=refining, constant=constant
        )
        self.cost = max(self.adjuster.adjust(model, NUM_ITERATIONS), MIN_COST)

    def growths_by_covariance(self, camera_ids: Sequence[int]) -> dict[int, float]:
        """Return the growths by camera id as the joint covariance has them.

        Returns:
            The growths, empty where there is no covariance.
        """
        sigmas = focal_sigmas(self.model, self.adjuster, camera_ids)
        if sigmas is None:
            return {}
        found = dict[int, float]()
        for key, sigma in sigmas.items():
            found[key] = self._growth_of(sigma)
        return found

    def _growth_of(self, sigma: float) -> float:
        """Return the part by which the cost grows with another focal length.

        Args:
            sigma: Of its logarithm.
        """
        deviations = math.log(max(FACTORS)) / max(sigma, MIN_SIGMA)
        growth = 0.5 * deviations**2 / self.cost / GAUSSIAN_BY_ROBUST
        return min(growth, MAX_GROWTH)

    def growth(self, camera_ids: Sequence[int]) -> float:
        """Return the part by which the cost grows, with the factor for which that is least."""
        constant = self.constant.union(camera_ids)
        adjuster = Adjuster(
            priors=self.priors,
            noise_px=NOISE_PX,
            refining=self.refining,
            constant=constant,
        )
        least = math.inf
        for factor in FACTORS:
            trial = pycolmap.Reconstruction(self.model)
            for camera_id in camera_ids:
                camera = trial.camera(camera_id)
                camera.params[list(camera.focal_length_idxs())] *= factor
            early_stop = EarlyStop(self.cost, 1.0 + MAX_GROWTH, NUM_ITERATIONS)
            cost = adjuster.adjust(trial, NUM_ITERATIONS, early_stop=early_stop)
            least = min(least, cost / self.cost)
            if least - 1.0 <= MIN_GROWTH:
                break
        return least - 1.0

    def growths(self, camera_ids: Sequence[int]) -> dict[int, float]:
        """Return the growths by camera id; of many cameras several are tried at once."""
        groups = []
        for keys in np.array_split(camera_ids, min(len(camera_ids), MAX_NUM_TRIALS)):
            groups.append(keys.tolist())
        found: dict[int, float] = {}
        growths = map_ordered(self.growth, groups, available_cores())
        for keys, growth in zip(groups, growths, strict=True):
            found.update(dict.fromkeys(keys, growth))
        return found


def focal_growths(
    model: pycolmap.Reconstruction, task: MappingTask
) -> dict[int, float]:
    """Return by what part the cost grows with another focal length, by id of the camera.

    A copy with some of the points is adjusted. What its joint covariance leaves open tells the
    growths. Where there is none, the copy is adjusted again with longer and with shorter focal
    lengths of uncalibrated cameras, whose other intrinsics are constant, while all else may move.
    """
    cameras = cameras_of(model).values()
    priors = camera_priors(cameras, task.cameras, task.lines)
    priors = with_distortion_of(priors, cameras)
    recorded = sorted(priors.keys() & task.cameras.keys())
    unknown = [key for key in recorded if not priors[key].has_prior_focal_length]
    if not unknown or not _is_tried(model):
        return {}
    constant = frozenset(key for key in recorded if task.cameras[key].is_all_given)
    is_straight = all(model.cameras[key].is_undistorted() for key in unknown)
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=not is_straight)
    if has_rigs(model):
        max_number = NUM_OBSERVATIONS_PER_IMAGE * model.num_reg_images()
        fewer = _with_observations(model, min(max_number, MAX_NUM_OBSERVATIONS))
    else:
        fewer = with_fewer_points(model)
    trials = _FocalTrials(fewer, priors, refining, constant)
    return _growths(trials, unknown)


def _growths(trials: _FocalTrials, camera_ids: Sequence[int]) -> dict[int, float]:
    """Return the growths by camera id, by the joint covariance where there is one.

    Of one camera, nothing is left open together with others, but the cost may fall again beyond
    what the covariance sees: unless that is sure of the focal length, it is tried as well.
    """
    found = trials.growths_by_covariance(camera_ids)
    if not found:
        return trials.growths(camera_ids)
    (first, *others) = camera_ids
    if not others and MIN_GROWTH < found[first] < MAX_GROWTH:
        found[first] = min(found[first], trials.growth(camera_ids))
    return found


@dataclass(frozen=True)
class FreedFocals:
    """What becomes of a model where its given focal lengths are free."""

    fitting_px: Mapping[int, float] = field(default_factory=dict)
    """By camera id the focal lengths that fit better than given ones, where that is clear."""
    other: OtherCameras = NO_OTHER_CAMERAS  # which may be right, where it is not


def freed_focals(
    model: pycolmap.Reconstruction,
    task: MappingTask,
    priors: Mapping[int, CameraPrior],
) -> FreedFocals:
    """Free the focal lengths that the user gave, each or by one factor all together.

    They are clearly wrong where that lowers the cost by more than free parameters are worth (BIC):
    half the logarithm of the number of observations each, of which those in one cell of an image
    count once.

    Args:
        model: It stays as it is.
        task: Says which focal lengths were given.
        priors: Priors of the focal lengths, by camera id.
    """
    recorded = priors.keys() & task.cameras.keys()
    given = {key for key in recorded if "focal" in task.cameras[key].given}
    if not given or not _is_tried(model):
        return FreedFocals()
    # A wrong focal length is made up for by distortion, where that was free.
    constant = frozenset(key for key in given if task.cameras[key].is_all_given)
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=not constant)
    given_adjuster = Adjuster(
        priors=priors, noise_px=NOISE_PX, refining=refining, constant=constant
    )
    given_model = with_fewer_points(model)
    given_cost = given_adjuster.adjust(given_model, FINAL)
    free_adjuster = Adjuster(
        priors=_with_free_focals(priors, given), noise_px=NOISE_PX, refining=refining
    )
    freed_model = with_fewer_points(model)
    gain = given_cost - free_adjuster.adjust(freed_model, FINAL)
    is_wrong = _is_worth_parameters(gain, len(given), given_model)
    if not is_wrong and len(given) > 1:
        # What is wrong in the same way everywhere is one parameter.
        freed_model = with_fewer_points(model)
        cost = adjust_common_factor(freed_model, free_adjuster, sorted(given))
        gain = given_cost - cost
        is_wrong = _is_worth_parameters(gain, 1, given_model)
    fitting_px = _moved_focals(freed_model, priors, given) if is_wrong else {}
    return FreedFocals(fitting_px, _other_focals(given_model, freed_model, gain))


def _other_focals(
    model: pycolmap.Reconstruction, freed: pycolmap.Reconstruction, gain: float
) -> OtherCameras:
    """Return how likely freed focal lengths are, and how far poses turn with them.

    Args:
        model: With the given ones.
        freed: The same with free ones.
        gain: By what its cost is lower, in nats.
    """
    if not math.isfinite(gain):
        return NO_OTHER_CAMERAS
    log_odds = math.log(WRONG_SHARE / (1.0 - WRONG_SHARE)) + gain * _counted_share(
        model
    )
    return OtherCameras(log_odds, pose_turns_deg(model, freed))


def _with_free_focals(
    priors: Mapping[int, CameraPrior], camera_ids: Collection[int]
) -> dict[int, CameraPrior]:
    """Return priors, of which those of some cameras hardly restrict the focal length."""
    found = dict(priors)
    for key in camera_ids:
        found[key] = replace(priors[key], sigma=FREE_SIGMA)
    return found


def _is_worth_parameters(
    gain: float, num_parameters: int, model: pycolmap.Reconstruction
) -> bool:
    """Tell whether free parameters lower a cost by as much as they are worth (BIC).

    Args:
        gain: By what the cost is lower, which is a sum over all observations.
        num_parameters: How many are free.
        model: Has the observations, of which those in one cell of an image count once.
    """
    worth = 0.5 * math.log(max(2, num_independent(model))) * num_parameters
    return gain * _counted_share(model) >= worth


def _counted_share(model: pycolmap.Reconstruction) -> float:
    """Return the share of the observations that counts: those in one cell err together."""
    return num_independent(model) / max(1, model.compute_num_observations())


def _moved_focals(
    model: pycolmap.Reconstruction,
    priors: Mapping[int, CameraPrior],
    given: Collection[int],
) -> dict[int, float]:
    """Return the focal lengths in px of a model that are not those that were given."""
    found = {}
    for key in sorted(given):
        focal_px = float(model.cameras[key].mean_focal_length())
        if abs(math.log(focal_px / priors[key].focal_px)) > MIN_MOVE:
            found[key] = focal_px
    return found


def with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with every n-th point, of ``MAX_NUM_POINTS`` at most.

    A model of rigs has ``MAX_NUM_OBSERVATIONS`` at most.
    """
    step = sampling_step(model.num_points3D(), MAX_NUM_POINTS)
    if has_rigs(model):
        of_rigs = sampling_step(model.compute_num_observations(), MAX_NUM_OBSERVATIONS)
        step = max(step, of_rigs)
    return _every_nth_point(model, step)


def _with_observations(
    model: pycolmap.Reconstruction, max_number: int
) -> pycolmap.Reconstruction:
    """Return a copy with a sample of the points, which has so many observations at most."""
    step = sampling_step(model.compute_num_observations(), max_number)
    return _every_nth_point(model, step)


def _every_nth_point(
    model: pycolmap.Reconstruction, step: int
) -> pycolmap.Reconstruction:
    fewer = pycolmap.Reconstruction(model)
    ids = sorted(fewer.point3D_ids())
    kept = set(ids[::step])
    for point_id in ids:
        if point_id not in kept:
            fewer.delete_point3D(point_id)
    return fewer


def _is_tried(model: pycolmap.Reconstruction) -> bool:
    # A limit of models, other than sparse.MIN_LARGE_SET, which is one of photographs
    return model.num_reg_images() <= MAX_TRIAL_IMAGES and model.num_points3D() > 0


def num_independent(model: pycolmap.Reconstruction) -> int:
    """Return how many cells of all images hold observations, which err together in a cell."""
    num_cells = 0
    for image_id, camera in cameras_of(model).items():
        observations = model.images[image_id].get_observation_points2D()
        points_px = np.array([point.xy for point in observations]).reshape(-1, 2)
        num_cells += num_occupied_cells(camera, points_px)
    return num_cells
