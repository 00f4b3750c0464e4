"""Caches of pycolmap's mappers with the images of other ones."""

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from colmap_affrect.colmap import pycolmap


def empty_copy(
    cache: pycolmap.DatabaseCache, camera_of: Mapping[str, int]
) -> pycolmap.DatabaseCache:
    """Return the used cameras, rigs and images of a cache, without pairs.

    Args:
        cache: It stays as it is.
        camera_of: Other cameras of some images, by image name.
    """
    rig_of = {rig.ref_sensor_id: rig.rig_id for rig in cache.rigs.values()}
    frames = dict(cache.frames)
    images = [copy.copy(image) for image in cache.images.values()]
    for image in images:
        key = camera_of.get(image.name, image.camera_id)
        if key != image.camera_id:
            image.camera_id = key
            rig_id = rig_of[cache.cameras[key].sensor_id]
            frame = pycolmap.Frame(frame_id=image.frame_id, rig_id=rig_id)
            frame.add_data_id(image.data_id)
            frames[image.frame_id] = frame
    used_rigs = sorted({frame.rig_id for frame in frames.values()})
    return _filled_cache(
        cache=cache,
        rig_ids=used_rigs,
        frames=frames.values(),
        images=images,
    )


def _filled_cache(
    cache: pycolmap.DatabaseCache,
    rig_ids: Sequence[int],
    frames: Iterable[pycolmap.Frame],
    images: Iterable[pycolmap.Image],
) -> pycolmap.DatabaseCache:
    """Return a cache with some rigs of another one and their cameras, frames and images."""
    new = pycolmap.DatabaseCache()
    sensors = set[Any]()
    for rig_id in rig_ids:
        sensors |= cache.rigs[rig_id].sensor_ids()
    for camera in cache.cameras.values():
        if camera.sensor_id in sensors:
            new.add_camera(camera)
    for rig_id in rig_ids:
        new.add_rig(cache.rigs[rig_id])
    for frame in frames:
        new.add_frame(frame)
    for image in images:
        new.add_image(image)
    for prior in cache.pose_priors:
        new.add_pose_prior(prior)
    return new
