"""Principal points that the user gives, and that the points of a model contradict.

A wrong one, as of a calibration of other photographs or of the whole of a crop, is made up for by
wrong rotations, and nothing else shows it: it stays as the user says, so that no search finds a
better one. So models are adjusted once more, with it and without: at first as if all photographs
of which the user says the same had one camera, which tells most of it, then with their own.

Of a large set, photographs that see much of one another stand for all of which the user says the
same: what is wrong with that is wrong with each of them.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import sampling_step
from colmap_affrect.geometry.lines import MIDDLE_SIGMA, SHIFTED_SIGMA
from colmap_affrect.mappers.adjustment import FINAL, NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.camera_priors import (
    MAX_DEVIATIONS,
    CameraPrior,
    PrincipalPointPrior,
    camera_priors,
)
from colmap_affrect.mappers.focal_observability import (
    FREE_SIGMA,
    MAX_TRIAL_IMAGES,
    with_fewer_points,
)
from colmap_affrect.mappers.pair_graph import has_rigs, used_cameras
from colmap_affrect.mappers.principal_points import median_turns_deg
from colmap_affrect.project.report import PrincipalPointContradiction

MIN_MOVE = MAX_DEVIATIONS * MIDDLE_SIGMA
"""Longer sides from a given principal point, from which on another one is named (theory): nearer
ones are usual of whole photographs, for which many users give the middle."""
NUM_COORDINATES = 2  # of a principal point, each a free parameter; theory


MAX_NUM_SAMPLES = 3
"""Of a large set, each of which is judged as a set by itself; resource."""
MAX_POINTS_OF_IMAGE = 300
"""That are looked at, to find images that see the same; resource."""

GivenPrincipalPoint = tuple[float, ...]
"""A principal point that the user gives, and the size of the images, px."""
Given = Mapping[int, pycolmap.Camera]
"""Cameras whose principal points the user has given, by id."""


def contradicted_principal_points(
    model: pycolmap.Reconstruction, task: MappingTask
) -> list[PrincipalPointContradiction]:
    """Find given principal points that the points of a model contradict.

    The cost must be lower with free ones by more than free parameters are worth (BIC: Schwarz,
    Estimating the dimension of a model, 1978), half the logarithm of the number of observations
    each, as where nobody has given any (:mod:`colmap_affrect.mappers.principal_points`). Focal
    lengths and distortion are free in both adjustments, given or not: what these make up for is
    not the principal point's.

    Args:
        model: It stays as it is.
        task: Says which principal points were given.

    Returns:
        One contradiction for all images of the same given values.
    """
    given = _given_cameras(used_cameras(model), task)
    if not given or not model.num_points3D():
        return []
    if model.num_reg_images() <= MAX_TRIAL_IMAGES:
        return _judged(model, task)
    found = list[PrincipalPointContradiction]()
    names_of = _names_of_same(model, given)
    largest = sorted(names_of, key=lambda point: (-len(names_of[point]), point))
    judged = set[GivenPrincipalPoint]()
    for _ in range(MAX_NUM_SAMPLES):
        left = [point for point in largest if point not in judged]
        if not left:
            break
        sample = _sample(model, names_of[left[0]])
        points_of_sample = set(_names_of_same(sample, given))
        for one in _judged(sample, task):
            whole = _of_all_of_same(one, names_of)
            if whole and whole.turns_deg.keys().isdisjoint(_names(found)):
                found.append(whole)
        judged |= {left[0], *points_of_sample}
    return found


def _names_of_same(
    model: pycolmap.Reconstruction, given: Given
) -> dict[GivenPrincipalPoint, list[str]]:
    """Return the names of the registered images for which the user says the same."""
    found = defaultdict[GivenPrincipalPoint, list[str]](list)
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        if image.camera_id in given:
            found[_given_principal_point(given[image.camera_id])].append(image.name)
    return dict(found)


def _names(found: Sequence[PrincipalPointContradiction]) -> set[str]:
    """Return the names of all images of some contradictions."""
    return {name for one in found for name in one.turns_deg}


def _sample(
    model: pycolmap.Reconstruction, names: Collection[str]
) -> pycolmap.Reconstruction:
    """Return a copy with a part of the images, ``MAX_TRIAL_IMAGES`` about.

    It begins with the image of some names that sees most, and goes on with those that see most of
    what is seen already. What a rig takes at once is taken together.

    Args:
        model: It stays as it is.
        names: Of images, one of which is the first.
    """
    images = [model.find_image_with_name(name) for name in names]
    first = max(images, key=lambda image: (image.num_points3D, -image.image_id))
    chosen = {first.frame_id}
    num_images = 0
    shared = Counter[int]()  # points that images share with the chosen ones, by frame
    newest = first.frame_id
    while True:
        of_frame = _images_of_frame(model, newest)
        num_images += len(of_frame)
        for image in of_frame:
            shared.update(_frames_that_see_the_same(model, image))
        others = [(num, -key) for key, num in shared.items() if key not in chosen]
        if not others or num_images >= MAX_TRIAL_IMAGES:
            break
        newest = -max(others)[1]
        chosen.add(newest)
    copy = pycolmap.Reconstruction(model)
    for frame_id in list(copy.reg_frame_ids()):
        if frame_id not in chosen:
            copy.deregister_frame(frame_id)
    return copy


def _images_of_frame(
    model: pycolmap.Reconstruction, frame_id: int
) -> list[pycolmap.Image]:
    """Return the images that were taken at once."""
    found = []
    for data_id in model.frames[frame_id].image_ids:
        if data_id.id in model.images:
            found.append(model.images[data_id.id])
    return found


def _frames_that_see_the_same(
    model: pycolmap.Reconstruction, image: pycolmap.Image
) -> Counter[int]:
    """Count which frames see points of an image, a sample of them."""
    found = Counter[int]()
    points = image.get_observation_points2D()
    step = sampling_step(len(points), MAX_POINTS_OF_IMAGE)
    for point2d in points[::step]:
        track = model.points3D[point2d.point3D_id].track
        found.update({model.images[e.image_id].frame_id for e in track.elements})
    return found


def _of_all_of_same(
    one: PrincipalPointContradiction,
    names_of: Mapping[GivenPrincipalPoint, Collection[str]],
) -> PrincipalPointContradiction | None:
    """Return a contradiction of a sample for all images of which the user says the same.

    Rotations of those that are not in the sample change by as much as usual there. None where no
    image of the sample is among them.
    """
    for names in names_of.values():
        if not one.turns_deg.keys().isdisjoint(names):
            usual_deg = float(np.median(list(one.turns_deg.values())))
            turns_deg = {name: one.turns_deg.get(name, usual_deg) for name in names}
            return replace(one, turns_deg=turns_deg)
    return None


def _judged(
    model: pycolmap.Reconstruction, task: MappingTask
) -> list[PrincipalPointContradiction]:
    """Return what the points of a model of few images contradict."""
    given = _given_cameras(used_cameras(model), task)
    if not given:
        return []
    fewer = with_fewer_points(model)
    shared_ids = {} if has_rigs(model) else _ids_of_same(given)
    if shared_ids:
        shared = _with_shared_cameras(fewer, shared_ids)
        found = _contradictions(shared, task)
        if found:
            return found
    return _contradictions(fewer, task)


def _given_cameras(
    cameras: Mapping[int, pycolmap.Camera], task: MappingTask
) -> dict[int, pycolmap.Camera]:
    """Return the cameras whose principal points the user has given, by id."""
    found = {}
    for key, camera in cameras.items():
        record = task.cameras.get(key)
        is_given = record and "principal-point" in record.given
        if is_given and len(camera.principal_point_idxs()):
            found[key] = camera
    return found


def _given_principal_point(camera: pycolmap.Camera) -> GivenPrincipalPoint:
    """Return a given principal point and the size of the images, px."""
    center = (float(camera.principal_point_x), float(camera.principal_point_y))
    return (*center, float(camera.width), float(camera.height))


def _ids_of_same(given: Given) -> dict[int, int]:
    """Return the id of the first camera of the same model and given values, by that of others.

    The first one is not among the others.
    """
    firsts = dict[tuple[object, ...], int]()
    found = {}
    for key, camera in sorted(given.items()):
        first = firsts.setdefault((camera.model, *_given_principal_point(camera)), key)
        if first != key:
            found[key] = first
    return found


def _with_shared_cameras(
    model: pycolmap.Reconstruction, shared_ids: Mapping[int, int]
) -> pycolmap.Reconstruction:
    """Return a copy in which images share cameras.

    Args:
        model: Without rigs.
        shared_ids: The camera that images get, by the one that they have; others keep theirs.
    """
    copy = pycolmap.Reconstruction()
    for key, camera in used_cameras(model).items():
        if key not in shared_ids:
            copy.add_camera_with_trivial_rig(camera)
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        camera_id = shared_ids.get(image.camera_id, image.camera_id)
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        same = pycolmap.Image(
            name=image.name,
            keypoints=keypoints,
            camera_id=camera_id,
            image_id=image_id,
        )
        copy.add_image_with_trivial_frame(same, image.cam_from_world())
    for point in model.points3D.values():
        copy.add_point3D(point.xyz, point.track)
    return copy


def _contradictions(
    model: pycolmap.Reconstruction, task: MappingTask
) -> list[PrincipalPointContradiction]:
    """Return what the points of a model, some of them, contradict."""
    cameras = used_cameras(model)
    given = _given_cameras(cameras, task)
    priors = camera_priors(cameras.values(), task.cameras, task.lines)
    for key in given:
        priors[key] = replace(priors[key], sigma=priors[key].sigma or FREE_SIGMA)
    constant = pycolmap.Reconstruction(model)
    constant_cost = _adjust(constant, priors)
    for key, camera in given.items():
        priors[key] = replace(priors[key], principal_point=_near_given(camera))
    free = pycolmap.Reconstruction(model)
    free_cost = _adjust(free, priors)
    num_observations = max(2, constant.compute_num_observations())
    worth = 0.5 * math.log(num_observations) * NUM_COORDINATES * len(given)
    if constant_cost - free_cost < worth:
        return []
    return _far_ones(given, model, free)


def _near_given(camera: pycolmap.Camera) -> PrincipalPointPrior:
    """Return the prior of a principal point that may be elsewhere than it was given."""
    sigma_px = SHIFTED_SIGMA * max(camera.width, camera.height)
    center = (float(camera.principal_point_x), float(camera.principal_point_y))
    return PrincipalPointPrior(center, (sigma_px, sigma_px))


def _adjust(model: pycolmap.Reconstruction, priors: Mapping[int, CameraPrior]) -> float:
    """Adjust a model in place, and return its cost."""
    refining = pycolmap.BundleAdjustmentOptions()
    adjuster = Adjuster(priors=priors, noise_px=NOISE_PX, refining=refining)
    return adjuster.adjust(model, FINAL)


def _far_ones(
    given: Given, model: pycolmap.Reconstruction, free: pycolmap.Reconstruction
) -> list[PrincipalPointContradiction]:
    """Return what fits better where that is far from what is given.

    Args:
        given: The cameras, as the user gives their principal points.
        model: The model with these.
        free: The same with free ones.
    """
    groups = defaultdict[GivenPrincipalPoint, list[int]](list)
    for key, camera in sorted(given.items()):
        groups[_given_principal_point(camera)].append(key)
    turns_deg = median_turns_deg(model, free)
    found = []
    for point, keys in groups.items():
        x_px, y_px, *sides_px = point
        fitting = _median_principal_point(free, keys)
        move_px = math.dist((x_px, y_px), fitting)
        if move_px > MIN_MOVE * max(sides_px):
            turns_of_group = _of_cameras(turns_deg, model, keys)
            found.append(
                PrincipalPointContradiction((x_px, y_px), fitting, turns_of_group)
            )
    return found


def _median_principal_point(
    model: pycolmap.Reconstruction, keys: Sequence[int]
) -> tuple[float, float]:
    """Return the median of the principal points of some cameras, px."""
    across_px = [model.cameras[key].principal_point_x for key in keys]
    down_px = [model.cameras[key].principal_point_y for key in keys]
    return float(np.median(across_px)), float(np.median(down_px))


def _of_cameras(
    turns_deg: Mapping[str, float],
    model: pycolmap.Reconstruction,
    keys: Collection[int],
) -> dict[str, float]:
    """Return the part of what is known by image name that belongs to images of some cameras."""
    found = {}
    for name, turn_deg in turns_deg.items():
        if model.find_image_with_name(name).camera_id in keys:
            found[name] = turn_deg
    return found
