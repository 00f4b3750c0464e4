"""The last points of models, found in another thread while the images of these are scored.

Scoring takes images out of few models. The others have their last points when it ends.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.pair_graph import cameras_of, poses_of
from colmap_affrect.parallel.executor import available_cores, begin_in_thread

# Of a model that is copied, which takes memory; resource
MAX_IMAGES = 100
NUM_NORMALIZATIONS = 5  # of quaternions, whose last bits may change twice; numeric


class LastPoints:
    """Gives models their last points, some of them meanwhile."""

    def __init__(self) -> None:
        """Begin with none."""
        self._begun = list[tuple[list[bytes], Future[pycolmap.Reconstruction]]]()

    def begin(self, models: Sequence[MappedModel]) -> None:
        """Begin with a copy of the first of some models, in another thread.

        Args:
            models: The largest first; the last bits of quaternions may change.
        """
        if not models:
            return
        model = models[0].reconstruction
        _normalize_quaternions(model)
        add_points = models[0].add_last_points
        is_small = model.num_reg_images() <= MAX_IMAGES
        if add_points and is_small and available_cores() > 1:
            copy = pycolmap.Reconstruction(model)
            added = begin_in_thread(partial(_with_points, copy, add_points))
            self._begun.append((_content(model), added))

    def added_to(self, mapped: MappedModel) -> pycolmap.Reconstruction:
        """Return a model with its last points.

        Args:
            mapped: The model, whose images are scored. It is changed, unless points were found
                meanwhile for what it is now.
        """
        model = mapped.reconstruction
        if mapped.add_last_points is None:
            return model
        content = _content(model)
        for before, added in self._begun:
            if before == content:
                return added.result()
        mapped.add_last_points(model)
        return model


def _with_points(
    model: pycolmap.Reconstruction,
    add_points: Callable[[pycolmap.Reconstruction], None],
) -> pycolmap.Reconstruction:
    """Return a model to which points were added."""
    add_points(model)
    return model


def _normalize_quaternions(model: pycolmap.Reconstruction) -> None:
    """Normalize quaternions so often that it changes nothing more: adjustments begin with it."""
    for frame_id in model.reg_frame_ids():
        pose = model.frames[frame_id].rig_from_world
        if pose is not None:
            for _ in range(NUM_NORMALIZATIONS):
                pose.rotation.normalize()


def _content(model: pycolmap.Reconstruction) -> list[bytes]:
    """Return what the points of a model follow from: its images, poses, cameras and tracks."""
    numbers = [*sorted(model.reg_image_ids()), model.num_points3D()]
    numbers.append(model.compute_num_observations())
    content = [repr(numbers).encode()]
    poses = poses_of(model)
    cameras = cameras_of(model)
    for image_id in sorted(poses):
        rotation, translation = poses[image_id]
        content += [rotation.tobytes(), translation.tobytes()]
        content.append(cameras[image_id].params.tobytes())
    return content
