"""The last adjustment of models that matches or cameras of little certainty hold.

Guided matches are less exact than others. They register images and tie them together, but where
exact matches suffice to hold images these alone say where they stand. Where nobody knows cameras
COLMAP stops on the way, and takes distortions for focal lengths.
"""

import copy
from collections import Counter
from collections.abc import Collection, Mapping
from itertools import combinations
from typing import cast

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import run_leavable
from colmap_affrect.colmap.model_files import seen_points
from colmap_affrect.geometry.arrays import rows_in

Matches = Mapping[tuple[int, int], NDArray[np.int64]]
Observations = NDArray[np.int64]
"""An image id in the upper 32 bits, and the number of a keypoint."""

MIN_NUM_TRACKS = 30
"""Exact tracks through three images or more that hold an image, as many as COLMAP asks for when it
registers one."""

LOSS_SCALE_PX = 0.5
"""Of the robust loss: about the error of exact matches."""

NUM_ROUNDS = 3
"""Adjustments, with what does not fit taken out after each."""

MAX_NUM_ITERATIONS = 300
"""Where nobody knows the cameras and few points are seen by three images, focal lengths move slowly
and far: 100 end on the way."""

MIN_CHANGE = 1e-8
"""Of the error in one iteration; what changes less has ended. COLMAP's 0 makes all iterations."""

MIN_GROWTH_WITHOUT_DISTORTION = 1.07
"""Of the error of adjustment, with lenses that distort as at the start; less, and the points do not
tell the distortion. It then takes up what belongs to focal lengths."""

MAX_NUM_POINTS = 2_000
"""Of a model, for what need not be exact."""

MAX_ERROR_PX, MIN_ANGLE_DEG = 4.0, 1.5
"""What fits, as for COLMAP's mappers."""

MIN_SHARED_TRACKS = 10
"""Of these tracks so many hold two images together."""


def adjust_last(
    model: pycolmap.Reconstruction,
    verified: Matches,
    guided: Matches,
    *,
    constant_cameras: Collection[int] = (),
    starts: Mapping[int, pycolmap.Camera] | None = None,
    options: pycolmap.BundleAdjustmentOptions | None = None,
) -> int:
    """Adjust a model whose matches or cameras are uncertain, and take out what no longer fits.

    Observations that only guided matches tie to their tracks are taken out first where exact ones
    hold all images. Elsewhere they fix what exact ones leave open, the scale of one part against
    another for one; the loss is robust, so that the exact ones, which fit better, count more.
    Lenses distort as at the start where the points do not tell another distortion.

    Args:
        model: changed in place.
        verified: (M, 2) inliers of each pair of image ids, as they made the model.
        guided: those of them that only guided matching has found.
        constant_cameras: ids of cameras whose parameters stay as they are.
        starts: cameras that nobody knows, by id, as they were before they were refined.
        options: changed in place; by default :func:`robust_options`.

    Returns:
        How many observations of guided matches were taken out first.
    """
    points = {i: seen_points(model.images[i]) for i in model.reg_image_ids()}
    all_ties, guided_ties = _ties(points, verified), _ties(points, guided)
    ties = all_ties[~rows_in(all_ties, guided_ties)]
    dropped = np.setdiff1d(all_ties, ties)
    if len(exactly_held(ties)) < len(points):
        dropped = dropped[:0]
    for image_id, index in zip(dropped >> 32, dropped & 0xFFFFFFFF, strict=True):
        if model.images[image_id].points2D[index].has_point3D():
            model.delete_observation(image_id, index)
    options = options or robust_options()
    found = {
        key: start
        for key, start in (starts or {}).items()
        if key in model.cameras and key not in constant_cameras and len(start.extra_params_idxs())
    }
    asks = bool(found) and options.refine_extra_params
    if asks and not _tells_distortion(model, constant_cameras, found, options):
        _take_back_distortion(model, found)
        options.refine_extra_params = False
    adjust(model, options, constant_cameras)
    return len(dropped)


def _tells_distortion(
    model: pycolmap.Reconstruction,
    constant_cameras: Collection[int],
    starts: Mapping[int, pycolmap.Camera],
    options: pycolmap.BundleAdjustmentOptions,
) -> bool:
    """Tell whether the points say how much the lenses distort that may be refined."""
    refined = with_fewer_points(model)
    start = pycolmap.Reconstruction(refined)
    _take_back_distortion(start, starts)
    held = copy.deepcopy(options)
    held.refine_extra_params = False
    most = MIN_GROWTH_WITHOUT_DISTORTION * solve(refined, constant_cameras, options)
    return solve(start, constant_cameras, held) > most


def with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with every n-th point, of ``MAX_NUM_POINTS`` at most."""
    fewer = pycolmap.Reconstruction(model)
    ids = sorted(fewer.point3D_ids())
    kept = set(ids[:: max(1, -(-len(ids) // MAX_NUM_POINTS))])
    for point_id in ids:
        if point_id not in kept:
            fewer.delete_point3D(point_id)
    return fewer


def _take_back_distortion(
    model: pycolmap.Reconstruction, starts: Mapping[int, pycolmap.Camera]
) -> None:
    """Let cameras distort as they did before they were refined."""
    for key, start in starts.items():
        for index in start.extra_params_idxs():
            model.cameras[key].params[index] = start.params[index]


def robust_options() -> pycolmap.BundleAdjustmentOptions:
    """Return options of an adjustment in which what fits well counts more."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE_PX
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = MAX_NUM_ITERATIONS
    options.ceres.solver_options.function_tolerance = MIN_CHANGE
    return options


def _ties(points: Mapping[int, NDArray[np.int64]], matches: Matches) -> Observations:
    """Return the (E, 2) observations of matches that see the same point."""
    found = [np.zeros((0, 2), np.int64)]
    for (first, second), indices in matches.items():
        if first in points and second in points:
            seen = points[first][indices[:, 0]]
            same = indices[(seen >= 0) & (seen == points[second][indices[:, 1]])]
            found.append(same + np.array([first << 32, second << 32]))
    return np.concatenate(found)


def exactly_held(ties: Observations) -> set[int]:
    """Return the ids of the largest part of the images that hang together by long exact tracks.

    Args:
        ties: (E, 2) observations that exact matches tie together.
    """
    tracks = nx.Graph()
    tracks.add_edges_from(ties.tolist())
    num_tracks: Counter[int] = Counter()
    shared: Counter[tuple[int, int]] = Counter()
    for track in nx.connected_components(tracks):
        images = sorted({observation >> 32 for observation in track})
        if len(images) > 2:
            num_tracks.update(images)
            shared.update(combinations(images, 2))
    parts = nx.Graph()
    parts.add_nodes_from(image for image, count in num_tracks.items() if count >= MIN_NUM_TRACKS)
    parts.add_edges_from(
        pair
        for pair, count in shared.items()
        if count >= MIN_SHARED_TRACKS and all(image in parts for image in pair)
    )
    return set(max(nx.connected_components(parts), key=len, default=()))


def adjust(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    constant_cameras: Collection[int],
) -> None:
    """Adjust a model, of which some cameras stay, and take out what does not fit."""
    for _ in range(NUM_ROUNDS):
        solve(model, constant_cameras, options)
        pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    model.update_point_3d_errors()


def solve(
    model: pycolmap.Reconstruction,
    constant_cameras: Collection[int],
    options: pycolmap.BundleAdjustmentOptions,
) -> float:
    """Adjust all images of a model, of which some cameras stay.

    Args:
        model: changed in place.
        constant_cameras: ids of cameras whose parameters stay as they are.
        options: of the adjustment.

    Returns:
        The error in the unit of the loss, infinite if the adjustment fails.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in constant_cameras:
        config.set_constant_cam_intrinsics(int(camera_id))
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    solved = run_leavable(adjuster.solve)
    summary = cast("pycolmap.CeresBundleAdjustmentSummary", solved)
    return summary.ceres_summary.final_cost if summary.is_solution_usable() else np.inf
