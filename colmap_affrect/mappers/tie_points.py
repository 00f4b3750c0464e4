"""Tie points: what a person has marked in several photographs, as observations of a model.

Models that have two of their images observe them, again before each adjustment while they are made:
COLMAP's filters may have taken them away.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import AGREEING_SIGMAS, SIGMA_PX, triangulated
from colmap_affrect.geometry.arrays import Array, sampling_step
from colmap_affrect.geometry.two_views import NUM_NEIGHBORS
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.project.report import Residual

# Residuals up to which a tie point agrees with a pose; theory
AGREEING_PX = AGREEING_SIGMAS * SIGMA_PX
# Shares of tie points that agree (judged).
AGREES_IF_RIGHT = 0.9  # with right poses: some marks are wrong
AGREES_BY_CHANCE = 0.05  # with wrong poses; judged
# That must agree to register an image: three always do, the others are the test; theory
MIN_NUM_POINTS = 4
MAX_LOG_ODDS = 2.5
"""Of an image by its tie points. Measured: of images that six tie points alone register, twelve of
thirteen are right."""
NUM_FREE = 3  # tie points with which any pose of an image can agree (P3P); theory
# A tie point that one image alone sees has the median depth of the points near its mark (judged).
MARK_RADIUS = 0.1  # of the longer side of the image
# Of an image, among which neighbours are looked for, to save time; resource
MAX_NUM_OBSERVED = 2_000


class ImageResidual(NamedTuple):
    """How far a tie point is from its mark in an image."""

    point: str  # name
    image_id: int
    error_px: float  # reprojection error


@dataclass(frozen=True)
class TiePoints:
    """Tie points of one database."""

    keypoints: Mapping[str, Mapping[int, int]]  # of each point, by image id

    def observe(self, model: pycolmap.Reconstruction) -> None:
        """Give a model a point for each tie point that two of its images see, with all of them."""
        nearby = _NearbyDepths(model)
        for seen in self._seen(model).values():
            if len(seen) > 1 and not _is_observed(model, seen):
                position = _position(nearby, _marks(model, seen))
                if position is not None:
                    _replace_point(model, seen, position)

    def observed(
        self,
        model: pycolmap.Reconstruction,
    ) -> Iterator[tuple[str, int, pycolmap.Point2D]]:
        """Yield name of the point, image id and mark of all that a model observes."""
        for name, seen in self._seen(model).items():
            for image_id, keypoint in seen.items():
                mark = model.images[image_id].points2D[keypoint]
                if mark.has_point3D():
                    yield name, image_id, mark

    def residuals(self, model: pycolmap.Reconstruction) -> list[ImageResidual]:
        """Return the residuals of all that a model observes."""
        found = list[ImageResidual]()
        for name, image_id, mark in self.observed(model):
            position = model.points3D[mark.point3D_id].xyz
            error_px = _mark_error_px(model, image_id, mark.xy, position)
            found.append(
                ImageResidual(point=name, image_id=image_id, error_px=error_px)
            )
        return found

    def report(self, model: pycolmap.Reconstruction) -> tuple[Residual, ...]:
        """Return the residuals as a report has them, the worst first."""
        residuals = self.residuals(model)
        residuals.sort(key=lambda residual: -residual.error_px)
        found = list[Residual]()
        for residual in residuals:
            found.append(
                Residual(
                    point=residual.point,
                    image=model.images[residual.image_id].name,
                    error_px=round(residual.error_px, 2),
                )
            )
        return tuple(found)

    def positions(self, model: pycolmap.Reconstruction) -> dict[str, Array]:
        """Return the (3,) positions in a model, by two images or else by depths near a mark."""
        found = {}
        nearby = _NearbyDepths(model)
        for name, seen in self._seen(model).items():
            position = _position(nearby, _marks(model, seen)) if seen else None
            if position is not None:
                found[name] = position
        return found

    def misplaced(self, model: pycolmap.Reconstruction) -> list[int]:
        """Return images that half of their tie points, by two other images, and four contradict."""
        num_points = Counter[int]()
        num_far = Counter[int]()
        for seen in self._seen(model).values():
            if len(seen) < 3:
                continue
            marks = _marks(model, seen)
            for image_id, xy in marks.items():
                others = {i: mark for i, mark in marks.items() if i != image_id}
                position = triangulated(model, others)
                if position is None:
                    continue
                if _max_mark_error_px(model, others, position) > AGREEING_PX:
                    continue
                error_px = _mark_error_px(model, image_id, xy, position)
                num_points[image_id] += 1
                num_far[image_id] += error_px > AGREEING_PX
        found = list[int]()
        for image_id, num in num_far.items():
            if num >= max(MIN_NUM_POINTS, num_points[image_id] / 2):
                found.append(image_id)
        return found

    def marks(self, image: pycolmap.Image) -> dict[str, Array]:
        """Return the (2,) px of the points in an image, by name."""
        found = {}
        for name, keypoints in self.keypoints.items():
            if image.image_id in keypoints:
                found[name] = image.points2D[keypoints[image.image_id]].xy
        return found

    def _seen(self, model: pycolmap.Reconstruction) -> dict[str, dict[int, int]]:
        """Return the keypoints of each tie point in the images of a model, by name and image id."""
        inside = set(model.reg_image_ids())
        found = {}
        for name, keypoints in self.keypoints.items():
            found[name] = {i: key for i, key in keypoints.items() if i in inside}
        return found


NO_TIE_POINTS = TiePoints({})


def tie_point_log_odds(residuals: Sequence[ImageResidual]) -> dict[int, float]:
    """Return the log odds of right against wrong poses, by image id.

    Only points that three images or more see count: two nearly always agree.
    """
    num_views = Counter(residual.point for residual in residuals)
    errors_px = defaultdict[int, list[float]](list)
    for residual in residuals:
        if num_views[residual.point] > 2:
            errors_px[residual.image_id].append(residual.error_px)
    log_ratio_agreeing = math.log(AGREES_IF_RIGHT / AGREES_BY_CHANCE)
    log_ratio_differing = math.log((1.0 - AGREES_IF_RIGHT) / (1.0 - AGREES_BY_CHANCE))
    found = {}
    for image_id, of_image in errors_px.items():
        num_agreeing = sum(error_px <= AGREEING_PX for error_px in of_image)
        num_differing = len(of_image) - num_agreeing
        log_odds = max(0, num_agreeing - NUM_FREE) * log_ratio_agreeing
        log_odds += num_differing * log_ratio_differing
        found[image_id] = min(log_odds, MAX_LOG_ODDS)
    return found


def tie_points_of(task: MappingTask, graph: PairGraph) -> TiePoints:
    """Return the tie points of a task, by the ids of its images."""
    ids = {name: image_id for image_id, name in graph.names.items()}
    keypoints = {}
    for point, seen in task.tie_points.items():
        keypoints[point] = {ids[name]: keypoint for name, keypoint in seen.items()}
    return TiePoints(keypoints)


def _marks(model: pycolmap.Reconstruction, seen: Mapping[int, int]) -> dict[int, Array]:
    """Return the (2,) px of keypoints, by image id."""
    return {i: model.images[i].points2D[keypoint].xy for i, keypoint in seen.items()}


def _is_observed(model: pycolmap.Reconstruction, seen: Mapping[int, int]) -> bool:
    """Tell whether keypoints all observe one point of a model."""
    marks = [model.images[i].points2D[keypoint] for i, keypoint in seen.items()]
    points = {mark.point3D_id for mark in marks}
    return len(points) == 1 and all(mark.has_point3D() for mark in marks)


def _replace_point(
    model: pycolmap.Reconstruction,
    seen: Mapping[int, int],
    position: Array,
) -> None:
    """Let keypoints observe a new point, in the place of all that they have observed."""
    track = pycolmap.Track()
    for image_id, keypoint in seen.items():
        mark = model.images[image_id].points2D[keypoint]
        if mark.has_point3D():
            model.delete_point3D(mark.point3D_id)
        track.add_element(image_id, keypoint)
    model.add_point3D(position, track)


def _position(nearby: "_NearbyDepths", marks: Mapping[int, Array]) -> Array | None:
    """Return the position of a point with marks in some images, None where they do not tell it."""
    position = triangulated(nearby.model, marks) if len(marks) > 1 else None
    if position is not None:
        return position
    # Where rays do not meet, the residuals will say so.
    for image_id, xy in marks.items():
        position = nearby.position(image_id, xy)
        if position is not None:
            return position
    return None


def _mark_error_px(
    model: pycolmap.Reconstruction, image_id: int, xy: Array, position: Array
) -> float:
    """Return a reprojection error, at most the diagonal of the image, also of points behind it."""
    image = model.images[image_id]
    camera = model.cameras[image.camera_id]
    diagonal = math.hypot(camera.width, camera.height)
    projected = image.project_point(position)
    return diagonal if projected is None else min(diagonal, math.dist(projected, xy))


def _max_mark_error_px(
    model: pycolmap.Reconstruction,
    marks: Mapping[int, Array],
    position: Array,
) -> float:
    return max(
        _mark_error_px(model, image_id, xy, position) for image_id, xy in marks.items()
    )


@dataclass(frozen=True)
class _Observed:
    """Points that an image sees."""

    points_px: Array  # (N, 2)
    depths: Array  # (N,)


class _NearbyDepths:
    """Tells where the ray of a mark is as deep as the points that its image sees around it.

    What an image sees is looked up once, so that many marks take no longer each than few.
    """

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model = model
        self._observed = dict[int, _Observed]()

    def position(self, image_id: int, xy: Array) -> Array | None:
        """Return the (3,) position of a mark at (2,) px; None where few points are near it."""
        if image_id not in self._observed:
            self._observed[image_id] = self._observed_by(image_id)
        observed = self._observed[image_id]
        distances_px = np.linalg.norm(observed.points_px - xy, axis=1)
        nearest = np.argsort(distances_px)[:NUM_NEIGHBORS]
        if len(nearest) < NUM_NEIGHBORS:
            return None
        image = self.model.images[image_id]
        camera = self.model.cameras[image.camera_id]
        radius_px = MARK_RADIUS * max(camera.width, camera.height)
        if distances_px[nearest[-1]] > radius_px:
            return None
        depth = np.median(observed.depths[nearest])
        ray = np.append(np.asarray(camera.cam_from_img(xy)).ravel(), 1.0)
        return np.asarray(image.cam_from_world().inverse() * (depth * ray))

    def _observed_by(self, image_id: int) -> _Observed:
        image = self.model.images[image_id]
        seen = image.get_observation_points2D()
        step = sampling_step(len(seen), MAX_NUM_OBSERVED)
        pose = image.cam_from_world()
        points_px = list[Array]()
        depths = list[float]()
        for point in seen[::step]:
            points_px.append(point.xy)
            depths.append((pose * self.model.points3D[point.point3D_id].xyz)[2])
        return _Observed(np.array(points_px).reshape(-1, 2), np.array(depths))
