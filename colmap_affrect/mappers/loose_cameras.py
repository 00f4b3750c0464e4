"""Whether the points of a model tell the focal lengths of cameras that nobody knows.

Where all cameras look at one thing from around it, or from afar, and few points are seen by three
images, a model bends to nearly any focal length. The adjustment still ends somewhere, with small
errors and small variances, and poses are off by tens of degrees.
"""

from __future__ import annotations

from typing import cast

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.last_adjustment import config_of, robust_options

FACTORS = 1.25, 0.8
"""Other focal lengths that are tried: poses are off by more than 5 degrees then."""

MIN_GROWTH = 1.07
"""Of the error of adjustment with another focal length. Models of good photographs grow by 0.5 to 4
times, long lenses around a small object by a tenth; what bends to anything by 0.05 at most."""

MAX_NUM_POINTS, MAX_NUM_IMAGES = 2_000, 100
"""Points looked at, every n-th; so many tell a focal length or never do. Larger models are not
looked at: they have enough points of three images."""


def loose_images(model: pycolmap.Reconstruction, task: MappingTask) -> tuple[str, ...]:
    """Return the images whose cameras neither anybody nor the points of the model know, sorted.

    The model stays as it is: a copy with some of its points is adjusted, with the focal lengths
    that it has, and with longer and with shorter ones of all unknown cameras at once.
    """
    unknown = {key for key, record in task.cameras.items() if record.source in ("guess", "pairs")}
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    loose = sorted(image.name for image in images if image.camera_id in unknown)
    if not loose or len(images) > MAX_NUM_IMAGES or model.num_points3D() == 0:
        return ()
    sparse = _with_fewer_points(model)
    least = _adjusted(sparse, focals_free=True)
    for factor in FACTORS:
        other = pycolmap.Reconstruction(sparse)
        for key in unknown & set(other.cameras):
            camera = other.cameras[key]
            for index in camera.focal_length_idxs():
                camera.params[index] *= factor
        if _adjusted(other, focals_free=False) < MIN_GROWTH * least:
            return tuple(loose)
    return ()


def _with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with every n-th point."""
    copy = pycolmap.Reconstruction(model)
    ids = sorted(copy.point3D_ids())
    kept = set(ids[:: -(-len(ids) // MAX_NUM_POINTS)])
    for point_id in ids:
        if point_id not in kept:
            copy.delete_point3D(point_id)
    return copy


def _adjusted(model: pycolmap.Reconstruction, *, focals_free: bool) -> float:
    """Adjust a model; return the error that is left."""
    options = robust_options()
    options.refine_focal_length = focals_free
    adjuster = pycolmap.create_default_bundle_adjuster(options, config_of(model), model)
    summary = cast("pycolmap.CeresBundleAdjustmentSummary", adjuster.solve())
    return float(summary.ceres_summary.final_cost)
