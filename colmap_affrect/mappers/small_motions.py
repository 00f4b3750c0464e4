"""Whether points of a model move against the others, by less than the tolerance of matches.

Ice that creeps, or a crowd that sways, moves so little from photograph to photograph that points of
what stays agree with poses by what moves, but for a pixel or two. What tells is that those points
of a model which fit badly fit well together with other poses. Errors of keypoints do not: there are
no poses that lower them. Motions that are larger make matches which contradict the model
(:mod:`colmap_affrect.mappers.other_motions`).
"""

import math
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Bools, Floats, sampling_step
from colmap_affrect.mappers.adjustment import Adjuster
from colmap_affrect.mappers.model_score import GRID, grid_cells
from colmap_affrect.mappers.other_cameras import pose_turns_deg
from colmap_affrect.mappers.other_motions import MIN_CELLS
from colmap_affrect.mappers.pair_graph import has_rigs

MAX_NUM_POINTS = 1500  # that are looked at; resource
MIN_VIEWS = 3  # of a point that tells poses from errors of its keypoints; theory
WORSE = 2.0
"""Times the median error, from which on a point fits badly. Measured: 8 to 26 per cent of the
points of sets in which nothing moves."""
# That fit badly, below which nothing is asked: poses have as many unknowns; theory
MIN_NUM_POINTS = 30
MAX_REMAINING = 0.8
"""Share of the cost of points that fit badly, for each degree of freedom, which is left with poses
of their own where something moves. Measured: 0.9 to 1.2 of sets in which nothing does."""
NUM_STEPS = 4  # of telling both motions apart; resource
NUM_ITERATIONS = 20  # of an adjustment; resource
MIN_TOGETHER = 0.5
"""Share of what a motion shows that lies in cells which are its own, more than which must: what
moves has a place in a photograph, points that were measured badly are among the others (theory)."""
# Points of each motion in an image whose pose both tell, twice what a pose needs; theory
MIN_NUM_SHOWN = 6


@dataclass(frozen=True)
class SmallMotion:
    """What moves against the points that a model follows, by little."""

    share: float  # of the cells of all images, of what moves as the model says
    changes_deg: Mapping[str, float]
    """How far the poses by both are apart, by image name: the median of rotations and directions
    to the other images."""


@dataclass(frozen=True)
class _Fit:
    """Poses by some of the points of a model."""

    model: pycolmap.Reconstruction  # has all points, where these poses put them
    remaining: float
    """Share of the cost of the points that the poses are by, for each degree of freedom, against
    the poses before."""

    def errors(self, point_ids: Collection[int]) -> Floats:
        """Return the mean error of each point, px."""
        points = self.model.points3D
        return np.array([points[point_id].error for point_id in point_ids])


def small_motion(model: pycolmap.Reconstruction) -> SmallMotion | None:
    """Return what moves against the points that a model follows; None where nothing does.

    Args:
        model: The model; it stays as it is.
    """
    if has_rigs(model) or model.num_reg_images() < MIN_VIEWS:
        return None
    base = _with_long_tracks(model)
    base.update_point_3d_errors()
    point_ids = sorted(base.point3D_ids())
    whole = _Fit(base, 1.0)  # the model as it is, of which nothing is fitted
    errors = whole.errors(point_ids)
    if len(errors) < 2 * MIN_NUM_POINTS:
        return None
    noise_px = float(np.median(errors))
    is_other = errors > WORSE * noise_px
    if np.count_nonzero(is_other) < MIN_NUM_POINTS:
        return None
    other = _fitted(base, _chosen(point_ids, is_other), noise_px)
    if other.remaining > MAX_REMAINING:
        return None
    own = whole
    for _ in range(NUM_STEPS):
        is_other = other.errors(point_ids) < own.errors(point_ids)
        if (
            min(np.count_nonzero(is_other), np.count_nonzero(~is_other))
            < MIN_NUM_POINTS
        ):
            return None
        own = _fitted(own.model, _chosen(point_ids, ~is_other), noise_px)
        other = _fitted(other.model, _chosen(point_ids, is_other), noise_px)
    sides = {False: own, True: other}
    follows_other = _is_nearer(model, other.model, own.model)
    if follows_other:
        is_other = ~is_other
        sides = {False: other, True: own}
    return _motion(model, sides, _labels(point_ids, is_other))


def _with_long_tracks(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with points that several images see, ``MAX_NUM_POINTS`` at most."""
    found = pycolmap.Reconstruction(model)
    long = []
    for point_id in sorted(model.point3D_ids()):
        if model.points3D[point_id].track.length() >= MIN_VIEWS:
            long.append(point_id)
    kept = set(long[:: sampling_step(len(long), MAX_NUM_POINTS)])
    for point_id in sorted(model.point3D_ids()):
        if point_id not in kept:
            found.delete_point3D(point_id)
    return found


def _chosen(point_ids: Collection[int], is_chosen: Bools) -> set[int]:
    return {key for key, does in zip(point_ids, is_chosen, strict=True) if does}


def _labels(point_ids: Collection[int], is_other: Bools) -> dict[int, bool]:
    return dict(zip(point_ids, is_other.tolist(), strict=True))


def _fitted(
    base: pycolmap.Reconstruction, chosen: Collection[int], noise_px: float
) -> _Fit:
    """Return a model with the poses that some of its points have, and all points placed by them.

    Args:
        base: Has the points, and poses to begin with; it stays as it is.
        chosen: Ids of the points that the poses are by.
        noise_px: Scale of the robust loss.
    """
    by_chosen = pycolmap.Reconstruction(base)
    for point_id in sorted(base.point3D_ids()):
        if point_id not in chosen:
            by_chosen.delete_point3D(point_id)
    cameras = frozenset(base.cameras)
    frames = frozenset(base.reg_frame_ids())
    options = pycolmap.BundleAdjustmentOptions()
    free = Adjuster({}, noise_px, options, cameras)
    held = Adjuster({}, noise_px, options, cameras, frames)
    cost_before = held.adjust(by_chosen, NUM_ITERATIONS)
    cost = free.adjust(by_chosen, NUM_ITERATIONS)
    num_residuals = 2 * by_chosen.compute_num_observations()
    num_free = num_residuals - 3 * by_chosen.num_points3D()
    num_left = num_free - 6 * base.num_reg_images() + 7
    remaining = 1.0
    if num_left > 0 and 0.0 < cost_before < math.inf:
        remaining = (cost / num_left) / (cost_before / num_free)
    found = pycolmap.Reconstruction(base)
    for frame_id in frames:
        found.frames[frame_id].rig_from_world = by_chosen.frames[
            frame_id
        ].rig_from_world
    held.adjust(found, NUM_ITERATIONS)
    return _Fit(found, remaining)


def _is_nearer(
    model: pycolmap.Reconstruction,
    first: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
) -> bool:
    """Tell whether the poses of a model are nearer to those of the first of two others."""
    to_first = pose_turns_deg(model, first)
    to_second = pose_turns_deg(model, second)
    return sum(to_first.values()) < sum(to_second.values())


def _motion(
    model: pycolmap.Reconstruction,
    sides: Mapping[bool, _Fit],
    labels: Mapping[int, bool],
) -> SmallMotion | None:
    """Return what is known of a motion; None where it has no place in the photographs.

    Args:
        model: The model.
        sides: The poses by what moves as the model says, and by what does not.
        labels: Whether a point does not, by id.
    """
    num_cells = np.zeros(2)
    num_together = 0
    num_others = 0
    both_tell = list[int]()
    for image_id in model.reg_image_ids():
        counts = _counts_in_cells(sides[False].model, image_id, labels)
        is_of_other = counts[1] > counts[0]
        num_cells += [np.sum((counts[0] > 0) & ~is_of_other), np.sum(is_of_other)]
        num_together += int(counts[1][is_of_other].sum())
        num_others += int(counts[1].sum())
        if counts.sum(axis=1).min() >= MIN_NUM_SHOWN:
            both_tell.append(image_id)
    if num_cells[1] < MIN_CELLS * model.num_reg_images():
        return None
    if num_together <= MIN_TOGETHER * num_others:
        return None
    changes_deg = pose_turns_deg(sides[False].model, sides[True].model, both_tell)
    return SmallMotion(float(num_cells[0] / num_cells.sum()), changes_deg)


def _counts_in_cells(
    model: pycolmap.Reconstruction, image_id: int, labels: Mapping[int, bool]
) -> Floats:
    """Return (2, N) numbers of points in the cells of an image, of both motions."""
    image = model.images[image_id]
    positions = defaultdict[bool, list[Floats]](list)
    for point in image.get_observation_points2D():
        positions[labels[point.point3D_id]].append(point.xy)
    counts = []
    for label in (False, True):
        points = np.array(positions[label]).reshape(-1, 2)
        cells = grid_cells(model.cameras[image.camera_id], points)
        counts.append(np.bincount(cells, minlength=GRID * GRID))
    return np.array(counts, np.float64)
