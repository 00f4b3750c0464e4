"""Whether the points of a model tell the focal lengths of cameras that nobody knows.

Where all cameras look at one thing from around it, or from afar, and few points are seen by three
images, a model bends to nearly any focal length. The adjustment still ends somewhere, with small
errors and small variances, and poses are off by tens of degrees.
"""

from collections.abc import Collection

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.last_adjustment import robust_options, solve, with_fewer_points

FACTORS = 1.25, 0.8  # other focal lengths that are tried: poses are off by 5 degrees and more then

MIN_GROWTH = 1.07
"""Of the error of adjustment, with another focal length. In models of good photographs it grows by
0.4 to 3 times, for long lenses around a small object by a tenth, where anything fits by 0.05."""

MAX_NUM_TRIALS = 12  # more cameras than that are tried several at once
MAX_NUM_IMAGES = 100  # looked at; larger models have points of many images


def loose_images(model: pycolmap.Reconstruction, task: MappingTask) -> tuple[str, ...]:
    """Return the images whose focal length neither anybody nor the points know, sorted.

    A copy with some of the points is adjusted, once as it is, and with a longer and with a shorter
    focal length of each camera that nobody knows, while all else may move. Cameras that are held
    stay as they are, and are left out: other points have told them.
    """
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    unknown = sorted(
        key
        for key in {image.camera_id for image in images} & task.cameras.keys() - task.held
        if task.cameras[key].source in ("guess", "pairs")
    )
    if not unknown or len(images) > MAX_NUM_IMAGES or model.num_points3D() == 0:
        return ()
    given = {key for key, record in task.cameras.items() if record.is_fixed}
    fixed = (given | task.held) & set(model.cameras)
    sparse = with_fewer_points(model)
    options = robust_options()
    is_straight = all(model.cameras[key].is_undistorted() for key in unknown)
    options.refine_extra_params = not is_straight  # what no point tells stays as it is
    most = MIN_GROWTH * solve(sparse, fixed, options)
    loose: set[int] = set()
    for keys in np.array_split(unknown, min(len(unknown), MAX_NUM_TRIALS)):
        held = fixed.union(keys.tolist())
        if any(solve(_scaled(sparse, keys, factor), held, options) < most for factor in FACTORS):
            loose.update(keys.tolist())
    return tuple(sorted(image.name for image in images if image.camera_id in loose))


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
