"""The points of a finished model: all that the verified pairs tell, where its poses put them.

Models are made from some of the tracks, and adjusted by tracks of three images where these are
enough (:mod:`colmap_affrect.mappers.adjustment`). In the end all tracks become points, each where
its errors are smallest; poses and cameras stay as they are, to the bit.
"""

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import seen_points
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.refined_points import Observations, refined_points
from colmap_affrect.mappers.pair_graph import PairGraph, cameras_of, poses_of
from colmap_affrect.mappers.tie_points import TiePoints

STEP = 1e-4  # of normalized image coordinates, for derivatives


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
    mapping, finding = native.get_mapper(), native.get_triangulation()
    for image_id in sorted(model.reg_image_ids()):
        triangulator.triangulate_image(finding, image_id)
    triangulator.complete_all_tracks(finding)
    triangulator.merge_all_tracks(finding)
    by_hand = {mark.point3D_id for _, _, mark in tie_points.observed(model)}
    refined = _refine(model, graph, model.point3D_ids() - by_hand, noise_px)
    manager.filter_points3D(mapping.filter_max_reproj_error, mapping.filter_min_tri_angle, refined)
    model.update_point_3d_errors()


def _correspondences(
    model: pycolmap.Reconstruction, graph: PairGraph
) -> pycolmap.CorrespondenceGraph:
    """Return the inliers of the pairs among a model's images, but for those it contradicts."""
    inside, against = set(model.reg_image_ids()), graph.contradicted(model)
    found = pycolmap.CorrespondenceGraph()
    for image_id in sorted(inside):
        found.add_image(image_id, model.images[image_id].num_points2D())
    for pair in graph.verified:
        if inside.issuperset(pair.ids) and pair.ids not in against:
            found.add_two_view_geometry(*pair.ids, pair.geometry)
    found.finalize()
    return found


def _refine(
    model: pycolmap.Reconstruction, graph: PairGraph, point_ids: set[int], noise_px: float
) -> set[int]:
    """Move points, those of some ids, to where their errors are smallest; return their ids."""
    found = _observations(model, graph, point_ids)
    if found is None:
        return set()
    ids, seen = found
    points = model.points3D
    before = np.array([points[key].xyz for key in ids])
    after = refined_points(before, seen, noise_px)
    for key, place in zip(ids, after, strict=True):
        points[key].xyz = place
    return set(ids)


def _observations(
    model: pycolmap.Reconstruction, graph: PairGraph, point_ids: set[int]
) -> tuple[list[int], Observations] | None:
    """Return what is seen of points, those of some ids, and their ids in order; None if nothing."""
    wanted = np.array(sorted(point_ids), np.int64)
    seen_ids, parts = [], []
    cameras = cameras_of(model)
    for image_id, (rotation, translation) in sorted(poses_of(model).items()):
        seen = seen_points(model.images[image_id])
        keypoints = np.flatnonzero(np.isin(seen, wanted))
        if not len(keypoints):
            continue
        seen_ids.append(seen[keypoints])
        places = graph.keypoints[image_id][keypoints].astype(np.float64)
        rotations = np.broadcast_to(rotation, (len(keypoints), 3, 3))
        translations = np.broadcast_to(translation, (len(keypoints), 3))
        parts.append((rotations, translations, *_rays(cameras[image_id], places)))
    if not parts:
        return None
    ids, rows = np.unique(np.concatenate(seen_ids), return_inverse=True)
    order = np.argsort(rows, kind="stable")
    columns = [np.concatenate(column)[order] for column in zip(*parts, strict=True)]
    return ids.tolist(), Observations(rows[order], *columns)


def _rays(camera: pycolmap.Camera, places: Array) -> tuple[Array, Array]:
    """Return (N, 2) normalized coordinates of px, and (N, 2, 2) derivatives of px by these."""
    rays = np.asarray(camera.cam_from_img(places), np.float64).reshape(-1, 2)
    columns = []
    for step in (np.array([STEP, 0.0]), np.array([0.0, STEP])):
        ends = [_px(camera, rays + sign * step) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    return rays, np.stack(columns, axis=2)


def _px(camera: pycolmap.Camera, rays: Array) -> Array:
    rays = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(camera.img_from_cam(rays), np.float64).reshape(-1, 2)
