"""Two cameras that differ in all, so that what is swapped or forgotten shows."""

import numpy as np

from colmap_affrect.colmap import pycolmap

WIDE = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=900, height=600, params=[500.0, 430.0, 310.0, -0.08]
)
LONG = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=700, height=1000, params=[1400.0, 345.0, 560.0, 0.15]
)
POSE = pycolmap.Rigid3d(
    pycolmap.Rotation3d(np.array([0.05, -0.2, 0.03])), np.array([0.9, -0.2, 0.4])
)
"""cam2_from_cam1."""
