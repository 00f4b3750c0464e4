"""The points of a finished model: all that the verified pairs tell, where its poses put them.

Models are made from some of the tracks, and adjusted by tracks of three images where these are
enough (:mod:`colmap_affrect.mappers.adjustment`). In the end all tracks become points, each where
its errors are smallest; poses and cameras stay as they are, to the bit.

A robust loss places a point by the observations that agree, and the others leave it. Where fewer
than two are left, the point stands where COLMAP's own adjustment puts it, which shares the errors
among all observations: it stays if these are within COLMAP's limit then.
"""

import numpy as np
import pyceres

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.tie_points import TiePoints

# Each point is a problem of its own, for which few suffice; resource
MAX_ITERATIONS = 20


def complete_points(
    model: pycolmap.Reconstruction,
    graph: PairGraph,
    native: pycolmap.IncrementalPipelineOptions,
    noise_px: float,
    tie_points: TiePoints,
) -> None:
    """Give a model the points of all tracks of its images, refined; nothing else of it changes.

    Args:
        model: Changed in place.
        graph: The verified pairs. Those that contradict the model make no points.
        native: Options of triangulation and of what is left out.
        noise_px: Standard deviation of the keypoints, px.
        tie_points: Their points stay as they are.
    """
    correspondences = _correspondences(model, graph)
    manager = pycolmap.ObservationManager(model, correspondences)
    triangulator = pycolmap.IncrementalTriangulator(correspondences, model, manager)
    mapping = native.get_mapper()
    finding = native.get_triangulation()
    for image_id in sorted(model.reg_image_ids()):
        triangulator.triangulate_image(finding, image_id)
    triangulator.complete_all_tracks(finding)
    triangulator.merge_all_tracks(finding)
    by_hand = {mark.point3D_id for _, _, mark in tie_points.observed(model)}
    _refine(
        model=model,
        constant=by_hand,
        loss=pycolmap.LossFunctionType.CAUCHY,
        noise_px=noise_px,
    )
    max_error_px = mapping.filter_max_reproj_error
    failing = _failing(model, max_error_px) - by_hand
    if failing:
        _refine(
            model=model,
            constant=model.point3D_ids() - failing,
            loss=pycolmap.LossFunctionType.TRIVIAL,
            noise_px=noise_px,
        )
    refined = model.point3D_ids() - by_hand
    manager.filter_points3D(max_error_px, mapping.filter_min_tri_angle, refined)
    model.update_point_3d_errors()


def _correspondences(
    model: pycolmap.Reconstruction, graph: PairGraph
) -> pycolmap.CorrespondenceGraph:
    """Return the inliers of the pairs among a model's images, but for those it contradicts."""
    inside = set(model.reg_image_ids())
    against = graph.contradicted_verified(model)
    found = pycolmap.CorrespondenceGraph()
    for image_id in sorted(inside):
        found.add_image(image_id, model.images[image_id].num_points2D())
    for pair in graph.verified:
        if inside.issuperset(pair.ids) and pair.ids not in against:
            found.add_two_view_geometry(*pair.ids, pair.geometry)
    found.finalize()
    return found


def extract_colors(
    model: pycolmap.Reconstruction,
    task: MappingTask,
    native: pycolmap.IncrementalPipelineOptions,
) -> None:
    """Give points the colours of photographs, where there are some and the options ask for it.

    Args:
        model: Changed in place.
        task: Says where the photographs are.
        native: The options.
    """
    if native.extract_colors and task.image_path:
        model.extract_colors_for_all_images(task.image_path)


def _failing(model: pycolmap.Reconstruction, max_error_px: float) -> set[int]:
    """Return the ids of the points that have fewer than two observations within a limit."""
    model.update_point_3d_errors()
    found = set[int]()
    for point_id, point in model.points3D.items():
        if point.error * point.track.length() <= max_error_px:  # the sum: none is above
            continue
        num_within = 0
        for element in point.track.elements:
            error_px = _observation_error_px(model, point, element)
            num_within += error_px <= max_error_px
        if num_within < 2:
            found.add(point_id)
    return found


def _observation_error_px(
    model: pycolmap.Reconstruction,
    point: pycolmap.Point3D,
    element: pycolmap.TrackElement,
) -> float:
    """Return how far an observation is from its point; infinite behind the camera."""
    image = model.images[element.image_id]
    projected = image.project_point(point.xyz)
    if projected is None:
        return float("inf")
    observed = image.points2D[element.point2D_idx].xy
    return float(np.linalg.norm(projected - observed))


def _refine(
    model: pycolmap.Reconstruction,
    constant: set[int],
    loss: pycolmap.LossFunctionType,
    noise_px: float,
) -> None:
    """Move the points to where their errors are smallest; poses and cameras stay, to the bit.

    Args:
        model: Changed in place.
        constant: Ids of the points that stay, too.
        loss: How much an error costs.
        noise_px: Scale of the loss, px, where it is a robust one.
    """
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.refine_rig_from_world = False
    options.refine_sensor_from_rig = False
    options.min_track_length = 2
    options.ceres.loss_function_type = loss
    options.ceres.loss_function_scale = noise_px
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for point_id in sorted(constant):
        config.add_constant_point(point_id)
    poses = _pose_parameters(model)
    before = [pose.copy() for pose in poses]
    problem = pycolmap.create_default_ceres_bundle_adjuster(
        options, config, model
    ).problem
    solver = pyceres.SolverOptions()
    solver.max_num_iterations = MAX_ITERATIONS
    solver.num_threads = 1
    solver.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    pyceres.solve(solver, problem, pyceres.SolverSummary())
    for pose, known in zip(poses, before, strict=True):
        # COLMAP normalises quaternions, which may change a last bit.
        pose[:] = known


def _pose_parameters(model: pycolmap.Reconstruction) -> list[Array]:
    """Return the parameters of the poses of frames, and of the sensors in rigs, as the model's."""
    poses = [model.frames[key].rig_from_world for key in sorted(model.reg_frame_ids())]
    for rig_id in sorted(model.rigs):
        # Its sensors are copies there, and the model's by their ids
        rig = model.rigs[rig_id]
        poses += [rig.sensor_from_rig(sensor) for sensor in rig.non_ref_sensors]
    return [pose.params for pose in poses if pose is not None]
