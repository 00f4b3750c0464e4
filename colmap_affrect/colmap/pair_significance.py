"""The significance of a two-view geometry: of its inliers, and of what their frames say.

A match of two local affine frames is a local map from image 1 to image 2. It must carry the
epipolar direction of image 1 to that of image 2. The epipolar geometry of a plane is arbitrary;
there the map must turn as the homography does.
"""

from __future__ import annotations

import math

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.two_views import PLANAR, epipolar_pair, keypoint_shapes
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.epipolar import common_sign
from colmap_affrect.geometry.pair_models import HomographyModel, PairModel, Points, Rows
from colmap_affrect.geometry.shapes import of_unit_area, vary_singly
from colmap_affrect.geometry.significance import log10_bayes_factor, log10_false_alarms, shuffled

MAX_FRAME_ANGLE_DEG = 20.0  # frames of right matches are off by 5 to 10 degrees
CHANCE_OF_AGREEMENT = MAX_FRAME_ANGLE_DEG / 180.0  # of frames that are turned at random
MAX_CHANCE = 0.99  # frames that agree by chance nearly always, upright ones for one, say nothing
MIN_VARIETY = 0.05  # of elements of shapes of area one; below they have no direction


def significance(
    geometry: pycolmap.TwoViewGeometry,
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    keypoints: tuple[Floats, Floats],
    max_error_px: float,
) -> float:
    """Return the decimal logarithm of how many pairs chance needs to have one that looks as good.

    It is infinite for a geometry that there is nothing to test in (a watermark). ``keypoints`` are
    those of the raw matches, from which COLMAP estimated the geometry: twice (M, 2, 4 or 6), with
    columns as in the database; without shapes, in 2 columns, positions count alone.
    """
    with np.errstate(all="ignore"):  # points that a camera cannot undistort are no inliers
        model = _model(geometry, cameras, keypoints)
        if model is None:
            return math.inf
        rows = np.arange(len(keypoints[0]))
        inliers = rows[model.errors(rows, rows) <= max_error_px]
        hits = model.errors(*shuffled(len(rows))) <= max_error_px
        chance = max(float(hits.mean()), 1.0 / len(hits))
        alarms = log10_false_alarms(len(rows), len(inliers), model.sample_size, chance)
        shapes = (telling_shapes(keypoints[0]), telling_shapes(keypoints[1]))
        if math.isinf(alarms) or shapes[0] is None or shapes[1] is None:
            return -alarms
        return _frame_evidence(model, inliers, (shapes[0], shapes[1])) - alarms


def telling_shapes(keypoints: Floats) -> Points | None:
    """Return the shapes of keypoints; None if they tell nothing.

    That is without any, of circles, if all are alike, or only differ from view to view.
    """
    shapes = keypoint_shapes(keypoints)
    if shapes is None or not len(shapes):
        return None
    alike = np.ptp(of_unit_area(shapes), axis=0).max() < MIN_VARIETY
    return None if alike or not vary_singly(shapes) else shapes


def _model(
    geometry: pycolmap.TwoViewGeometry,
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    keypoints: tuple[Floats, Floats],
) -> PairModel | None:
    if geometry.config in PLANAR and geometry.H is not None:
        points1, points2 = (np.asarray(points[:, :2], np.float64) for points in keypoints)
        return HomographyModel(np.asarray(geometry.H, np.float64), (points1, points2))
    if geometry.config == pycolmap.TwoViewGeometryConfiguration.WATERMARK:
        return None
    return epipolar_pair(geometry, cameras, keypoints)


def _frame_evidence(model: PairModel, inliers: Rows, shapes: tuple[Points, Points]) -> float:
    """Return the Bayes factor of the agreement of frames, as a decimal logarithm."""
    cosines = model.cosines(inliers, inliers, shapes)
    first, second = shuffled(len(inliers))
    by_chance = model.cosines(inliers[first], inliers[second], shapes)
    limit = math.cos(math.radians(MAX_FRAME_ANGLE_DEG))
    signs = (1.0, -1.0) if model.has_sign else (1.0,)
    chance = max(float((by_chance * sign >= limit).mean()) for sign in signs)
    chance = min(max(chance, CHANCE_OF_AGREEMENT), MAX_CHANCE)
    sign = common_sign(cosines) if model.has_sign else 1.0
    num_agreeing = int(np.count_nonzero(cosines * sign >= limit))
    # The better of two signs: chance has two tries.
    return log10_bayes_factor(len(inliers), num_agreeing, chance) - math.log10(len(signs))
