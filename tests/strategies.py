"""Hypothesis strategies for the geometry of rectifications."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_affrect.geometry.affine import rotation
from colmap_affrect.geometry.tilts import cosh_distances, metrics_from_tilts

Array = NDArray[np.float64]

IMAGE_SIZE = (160, 90)
"""(width, height) of the image that frames and homographies live in; not square."""

tilts = st.floats(1.0, 8.0)
tilt_angles = st.floats(0.0, np.pi, exclude_max=True)
turns = st.floats(-np.pi, np.pi)
scales = st.floats(0.1, 10.0)


def compose_affine(scale: float, psi_rad: float, tilt: float, phi_rad: float) -> Array:
    """Return the (2, 2) map scale R(psi) diag(tilt, 1) R(phi)."""
    return np.asarray(
        scale * rotation(psi_rad) @ np.diag([tilt, 1.0]) @ rotation(phi_rad)
    )


def tilt_distance(
    tilt1: float, angle1_rad: float, tilt2: float, angle2_rad: float
) -> float:
    """Return d = log tau, the log of the transition tilt between two classes.

    cosh d = ((t1/t2 + t2/t1) cos^2 D + (t1 t2 + 1/(t1 t2)) sin^2 D) / 2 with D = phi1 - phi2.
    """
    metrics = metrics_from_tilts([tilt1, tilt2], [angle1_rad, angle2_rad])
    return float(
        np.arccosh(np.maximum(cosh_distances(metrics[:1], metrics[1:])[0, 0], 1.0))
    )


@st.composite
def classes(draw: st.DrawFn) -> tuple[float, float]:
    """A class (tilt, angle) of the space of tilts."""
    return draw(tilts), draw(tilt_angles)


@st.composite
def affine_shapes(draw: st.DrawFn) -> Array:
    """A (2, 2) map of positive determinant and condition number at most 8."""
    return compose_affine(draw(scales), draw(turns), draw(tilts), draw(tilt_angles))


@st.composite
def frames(draw: st.DrawFn, min_size: int = 1, max_size: int = 4) -> Array:
    """(N, 2, 3) local affine frames with centres in the image."""
    width, height = IMAGE_SIZE
    count = draw(st.integers(min_size, max_size))
    lafs = np.empty((count, 2, 3))
    for laf in lafs:
        laf[:, :2] = draw(affine_shapes())
        laf[:, 2] = draw(st.floats(0, width - 1)), draw(st.floats(0, height - 1))
    return lafs


@st.composite
def homographies(draw: st.DrawFn) -> Array:
    """(3, 3) maps that move each image corner by at most a fifth of the image size.

    The corners stay a convex quadrangle, hence no point of the image goes to infinity.
    """
    width, height = IMAGE_SIZE
    corners = np.array(
        [[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]]
    )
    moves = draw(st.lists(st.floats(-0.2, 0.2), min_size=8, max_size=8))
    moved = corners + np.reshape(moves, (4, 2)) * IMAGE_SIZE
    return np.asarray(
        cv2.getPerspectiveTransform(
            corners.astype(np.float32), moved.astype(np.float32)
        )
    )
