"""Metrics of frames and their logarithms against inverses and eigenvalues."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import Array, affine_shapes, classes

from colmap_affrect.geometry.shapes import log_metrics, metrics_from_log, rectifying_metrics
from colmap_affrect.geometry.tilts import metrics_from_tilts, tilts_from_metrics, unit_metrics

SINGLE = 1e-5
"""Relative: logarithms are kept in single precision."""

Class = tuple[float, float]


def matrices(metrics: Array) -> Array:
    """Symmetric (..., 2, 2) matrices of (..., 3) entries (S11, S22, S12)."""
    s11, s22, s12 = np.moveaxis(metrics, -1, 0)
    return np.stack([np.stack([s11, s12], -1), np.stack([s12, s22], -1)], -2)


@given(affine_shapes())
def test_rectifying_metrics_are_those_of_the_inverse(shape: Array) -> None:
    expected = unit_metrics(np.linalg.inv(shape))
    assert_allclose(rectifying_metrics(shape), expected, rtol=1e-9, atol=1e-9)


@given(classes(), st.floats(1e-3, 1e3))
def test_log_metrics_are_matrix_logarithms_whatever_the_scale(shape: Class, scale: float) -> None:
    metric = metrics_from_tilts(*shape)
    values, vectors = np.linalg.eigh(matrices(metric))
    expected = vectors @ np.diag(np.log(values)) @ vectors.T
    l11, l12 = log_metrics(scale * metric)
    assert_allclose([[l11, l12], [l12, -l11]], expected, atol=SINGLE)


def test_log_metrics_of_stripes_and_of_nothing_are_finite() -> None:
    stripes, nothing = log_metrics(np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert_allclose(nothing, 0.0)
    assert np.isfinite(stripes).all()
    tilt, _ = tilts_from_metrics(metrics_from_log(stripes))
    assert 40.0 < tilt < 50.0
