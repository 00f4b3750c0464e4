"""Models of points that all images see, for what the covariance says of them."""

from __future__ import annotations

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster
from colmap_affrect.mappers.camera_priors import CameraPrior

FOCAL_PX = 1200.0
FAR = ((0.0, 0.0, 0.0), (4.0, 0.5, 0.3), (-3.0, 1.0, 0.5), (1.0, -3.0, 0.2))
NEAR = ((0.0, 0.0, 0.0), (0.05, 0.02, 0.1), (-0.04, 0.06, 0.05), (4.0, 0.5, 0.3))
"""Three of them stand at one place, seen from 12 away."""


def model_of(
    centers: tuple[tuple[float, float, float], ...],
    noise_px: float = 0.0,
    seed: int = 0,
    turns_deg: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
) -> pycolmap.Reconstruction:
    """Points that all images see, with noise on their keypoints.

    Args:
        centers: Of the cameras.
        noise_px: Standard deviation of keypoints.
        seed: Of the noise.
        turns_deg: Angles about the vertical, by which cameras are turned; none by default.
    """
    random = np.random.default_rng(5)
    points = random.uniform((-4, -3, 9), (4, 3, 15), (120, 3))
    noise = np.random.default_rng(seed)
    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in points]
    for number, center in enumerate(centers, 1):
        camera = pycolmap.Camera.create_from_model_name(
            number, "SIMPLE_RADIAL", FOCAL_PX, 1600, 1200
        )
        model.add_camera_with_trivial_rig(camera)
        angle = np.array([0.0, np.deg2rad(turns_deg[number - 1]), 0.0])
        turn = pycolmap.Rotation3d(angle)
        rays = (points - center) @ turn.matrix().T
        pixels = FOCAL_PX * rays[:, :2] / rays[:, 2:] + (800.0, 600.0)
        pixels += noise_px * noise.normal(size=pixels.shape)
        image = pycolmap.Image(f"{number}.jpg", pixels, number, number)
        pose = pycolmap.Rigid3d(turn, -turn.matrix() @ np.array(center))
        model.add_image_with_trivial_frame(image, pose)
        for index, track in enumerate(tracks):
            track.add_element(number, index)
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


def adjuster(focal_sigma: float) -> Adjuster:
    priors = {key: CameraPrior(FOCAL_PX, focal_sigma) for key in range(1, 5)}
    return Adjuster(priors, NOISE_PX, pycolmap.BundleAdjustmentOptions())
