"""Which cameras have images that can tell their distortion, and how it begins.

What an image says of its camera is what its features say more than points and pose need. A point
that n images see has 2 n coordinates for three of its own, so that 2 - 3 / n of each observation
are left; features in one cell of an image err together and count as one. Of these redundant
observations (Förstner and Wrobel, Photogrammetric Computer Vision, 2016) the pose takes six.
"""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.mappers.camera_priors import CameraPrior
from colmap_affrect.mappers.model_score import GRID, grid_cells
from colmap_affrect.mappers.pair_graph import (
    PairGraph,
    num_matched_images,
    used_cameras,
)

NUM_POSE_PARAMETERS = 6  # theory
MIN_NUM_IMAGES = 3
"""Images of a camera, from which on they tell its distortion: what else is wrong of a model is not
the same in all of them (judged)."""
MIN_REDUNDANCY = 60.0
"""Redundant observations of one or two images, from which on these tell it (judged)."""


def cameras_that_tell_distortion(graph: PairGraph) -> frozenset[int]:
    """Return the ids of the cameras whose distortion the verified pairs of a graph tell."""
    redundancies: defaultdict[int, float] = defaultdict(float)
    num_images: defaultdict[int, int] = defaultdict(int)
    num_keypoints = {i: len(points) for i, points in graph.keypoints.items()}
    matched = num_matched_images(num_keypoints, graph.verified)
    for image_id, num_partners in matched.items():
        camera = graph.cameras[image_id]
        key = camera.camera_id
        keypoints = graph.keypoints[image_id].astype(np.float64)
        redundancies[key] += redundancy_of(camera, keypoints, num_partners)
        num_images[key] += 1
    found = set[int]()
    for key, redundancy in redundancies.items():
        if num_images[key] >= MIN_NUM_IMAGES or redundancy >= MIN_REDUNDANCY:
            found.add(key)
    return frozenset(found)


def redundancy_of(
    camera: pycolmap.Camera, keypoints: Array, num_partners: Indices
) -> float:
    """Return how many observations of an image are redundant.

    Args:
        camera: Of the image.
        keypoints: (N, 2) px.
        num_partners: (N,) numbers of other images in which they are matched.
    """
    most = np.zeros(GRID * GRID, np.int64)
    np.maximum.at(most, grid_cells(camera, keypoints), num_partners)
    num_views = most[most > 0] + 1
    return max(0.0, float((2.0 - 3.0 / num_views).sum()) - NUM_POSE_PARAMETERS)


def straighten(
    model: pycolmap.Reconstruction, priors: Mapping[int, CameraPrior]
) -> bool:
    """Take the distortion of unknown cameras away, in place.

    Args:
        model: Whose cameras change.
        priors: What is known of them, by camera id.

    Returns:
        Whether there was any.
    """
    was_bent = False
    for camera in used_cameras(model).values():
        if not priors[camera.camera_id].has_prior_focal_length:
            for index in camera.extra_params_idxs():
                was_bent |= bool(camera.params[index])
                camera.params[index] = 0.0
    return was_bent
