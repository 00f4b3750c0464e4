"""Whether the points of a model determine the focal lengths that nobody knows.

Where all cameras look at one thing from around it, or from afar, and few points are seen by three
images, a model bends to nearly any focal length. The adjustment still ends somewhere, with small
errors and small variances, and poses are off by tens of degrees.
"""

from collections.abc import Collection

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import (
    EXIF_SIGMA,
    FINAL,
    NOISE_PX,
    USUAL_SIGMA,
    Adjuster,
    FocalPrior,
    priors_of,
)
from colmap_affrect.mappers.base import MappingTask

FACTORS = 1.25, 0.8  # other focal lengths that are tried: poses are off by 5 degrees and more then

MIN_GROWTH = 1.07
"""Of the cost of adjustment, with another focal length. In models of good photographs it grows by
0.4 to 3 times, for long lenses around a small object by a tenth, where anything fits by 0.05."""

MIN_MOVE = 0.1  # of the logarithm of a focal length that is told from another
MAX_NUM_TRIALS = 12  # more cameras than that are tried several at once
MAX_NUM_IMAGES = 100  # looked at; larger models have points of many images
MAX_NUM_POINTS = 2_000  # of a model, for what need not be exact


def loose_images(model: pycolmap.Reconstruction, task: MappingTask) -> tuple[str, ...]:
    """Return the images whose focal length neither anybody nor the points know, sorted.

    A copy with some of the points is adjusted, once as it is, and with a longer and with a shorter
    focal length of each camera that nobody knows, while all else may move.
    """
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    used = {image.camera_id for image in images}
    priors = priors_of((model.cameras[key] for key in sorted(used)), task.cameras)
    unknown = [key for key, p in priors.items() if p.sigma > EXIF_SIGMA and key in task.cameras]
    if not unknown or len(images) > MAX_NUM_IMAGES or model.num_points3D() == 0:
        return ()
    fixed = frozenset(key for key in used & task.cameras.keys() if task.cameras[key].is_fixed)
    is_straight = all(model.cameras[key].is_undistorted() for key in unknown)
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=not is_straight)
    sparse = _with_fewer_points(model)
    most = MIN_GROWTH * Adjuster(priors, NOISE_PX, refining, fixed).adjust(sparse, FINAL)
    loose: set[int] = set()
    for keys in np.array_split(unknown, min(len(unknown), MAX_NUM_TRIALS)):
        held = Adjuster(priors, NOISE_PX, refining, fixed.union(keys.tolist()))
        if any(held.adjust(_scaled(sparse, keys, factor), FINAL) < most for factor in FACTORS):
            loose.update(keys.tolist())
    return tuple(sorted(image.name for image in images if image.camera_id in loose))


def contradicted_focals(model: pycolmap.Reconstruction, task: MappingTask) -> dict[str, float]:
    """Return the focal length that fits, by image, where the one that the user gave does not.

    There is one where freeing it lowers the cost by more than a free parameter is worth, and moves
    it by more than a tenth.
    """
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    used = sorted({image.camera_id for image in images} & task.cameras.keys())
    given = {key for key in used if "focal" in task.cameras[key].given}
    if not given or len(images) > MAX_NUM_IMAGES or model.num_points3D() == 0:
        return {}
    priors = priors_of(model.cameras.values(), task.cameras)
    free = priors | {key: FocalPrior(priors[key].focal_px, USUAL_SIGMA) for key in given}
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=False)
    held, freed = _with_fewer_points(model), _with_fewer_points(model)
    before = Adjuster(priors, NOISE_PX, refining, frozenset(given)).adjust(held, FINAL)
    gain = before - Adjuster(free, NOISE_PX, refining).adjust(freed, FINAL)
    if gain < 0.5 * len(given) * np.log(max(2, held.compute_num_observations())):
        return {}
    found = {key: freed.cameras[key].mean_focal_length() for key in given}
    moved = {key for key in given if abs(np.log(found[key] / priors[key].focal_px)) > MIN_MOVE}
    return {image.name: found[image.camera_id] for image in images if image.camera_id in moved}


def _with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with every n-th point, of ``MAX_NUM_POINTS`` at most."""
    fewer = pycolmap.Reconstruction(model)
    ids = sorted(fewer.point3D_ids())
    kept = set(ids[:: max(1, -(-len(ids) // MAX_NUM_POINTS))])
    for point_id in ids:
        if point_id not in kept:
            fewer.delete_point3D(point_id)
    return fewer


def _scaled(
    model: pycolmap.Reconstruction, cameras: Collection[int], factor: float
) -> pycolmap.Reconstruction:
    """Return a copy with other focal lengths of some cameras."""
    copy = pycolmap.Reconstruction(model)
    for key in cameras:
        camera = copy.cameras[key]
        for index in camera.focal_length_idxs():
            camera.params[index] *= factor
    return copy
