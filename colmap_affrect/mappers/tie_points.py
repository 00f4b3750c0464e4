"""Tie points: what a person has marked in several photographs, as observations of a model.

Models that have two of their images observe them, in all adjustments; filters never take them away.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import SIGMA_PX, triangulated
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.project.report import Residual

AGREEING_PX = 4.0 * SIGMA_PX  # residuals up to which a tie point agrees with a pose
AGREES_IF_RIGHT, AGREES_BY_CHANCE = 0.9, 0.05
"""Shares of tie points that agree with right places, as some marks are wrong, and with others."""
MIN_NUM_POINTS = 4  # that must agree to place an image: three do so, of which others are the test
MOST = 2.5  # nats: of images that six tie points alone hold twelve of thirteen stand right
NUM_FREE = 3  # tie points that any place of an image can agree with
NEAR, NUM_NEAR = 0.1, 5
"""Depths of so many points near a mark, up to this part of the longer side, stand for its own."""
ImageResidual = tuple[str, int, float]
"""Name of a point, id of an image, and the reprojection error of the one in the other in px."""


@dataclass(frozen=True)
class TiePoints:
    """Tie points of one database."""

    keypoints: Mapping[str, Mapping[int, int]]  # of each point, by image id

    def observe(self, model: pycolmap.Reconstruction) -> None:
        """Give a model a point for each tie point that two of its images see, with all of them."""
        for seen in self._seen(model).values():
            if len(seen) < 2:
                continue
            marks = {i: model.images[i].points2D[k] for i, k in seen.items()}
            known = {p.point3D_id for p in marks.values() if p.has_point3D()}
            if len(known) == 1 and all(p.has_point3D() for p in marks.values()):
                continue
            places = {i: p.xy for i, p in marks.items()}
            place = triangulated(model, places)
            if place is None:  # they do not meet, and the residuals say so
                place = _place_by_neighbors(model, *next(iter(places.items())))
            if place is None:
                continue
            for point_id in known:
                model.delete_point3D(point_id)
            track = pycolmap.Track()
            for image_id, keypoint in seen.items():
                track.add_element(image_id, keypoint)
            model.add_point3D(place, track)

    def observed(
        self, model: pycolmap.Reconstruction
    ) -> Iterator[tuple[str, int, pycolmap.Point2D]]:
        """Yield name of the point, image id and mark of all that a model observes."""
        for name, seen in self._seen(model).items():
            for image_id, keypoint in seen.items():
                mark = model.images[image_id].points2D[keypoint]
                if mark.has_point3D():
                    yield name, image_id, mark

    def residuals(self, model: pycolmap.Reconstruction) -> list[ImageResidual]:
        """Return the residuals of all that a model observes."""
        places = (
            (n, i, m.xy, model.points3D[m.point3D_id].xyz) for n, i, m in self.observed(model)
        )
        return [(n, i, _errors_px(model, {i: xy}, place)[0]) for n, i, xy, place in places]

    def report(self, model: pycolmap.Reconstruction) -> tuple[Residual, ...]:
        """Return the residuals as a report has them, the worst first."""
        found = sorted(self.residuals(model), key=lambda residual: -residual[2])
        return tuple(Residual(n, model.images[i].name, round(px, 2)) for n, i, px in found)

    def places(self, model: pycolmap.Reconstruction) -> dict[str, Array]:
        """Return where a model has tie points: by two images, or else by depths near a mark."""
        found = {}
        for name, seen in self._seen(model).items():
            xy = {i: model.images[i].points2D[k].xy for i, k in seen.items()}
            place = triangulated(model, xy) if len(xy) > 1 else None
            if place is None and xy:
                place = _place_by_neighbors(model, *next(iter(xy.items())))
            if place is not None:
                found[name] = place
        return found

    def misplaced(self, model: pycolmap.Reconstruction) -> list[int]:
        """Return images of most of whose tie points two others agree that they are elsewhere."""
        far, num = Counter[int](), Counter[int]()
        for seen in self._seen(model).values():
            xy = {i: model.images[i].points2D[k].xy for i, k in seen.items()}
            for image_id in xy if len(xy) > 2 else ():
                others = {i: mark for i, mark in xy.items() if i != image_id}
                place = triangulated(model, others)
                if place is None or max(_errors_px(model, others, place)) > AGREEING_PX:
                    continue
                num[image_id] += 1
                far[image_id] += _errors_px(model, {image_id: xy[image_id]}, place)[0] > AGREEING_PX
        return [i for i, count in far.items() if count >= max(MIN_NUM_POINTS, num[i] / 2)]

    def marks(self, image: pycolmap.Image) -> dict[str, Array]:
        """Return where the points are in an image, px."""
        seen = ((name, keypoints.get(image.image_id)) for name, keypoints in self.keypoints.items())
        return {name: image.points2D[key].xy for name, key in seen if key is not None}

    def _seen(self, model: pycolmap.Reconstruction) -> dict[str, dict[int, int]]:
        inside = set(model.reg_image_ids())
        return {
            name: {i: key for i, key in keypoints.items() if i in inside}
            for name, keypoints in self.keypoints.items()
        }


NONE = TiePoints({})


def tied_evidence(residuals: Sequence[ImageResidual]) -> dict[int, float]:
    """Return what residuals say for the places of images, by image id, in nats.

    Of points that three images see or more: two nearly always agree.
    """
    errors, views = defaultdict[int, list[float]](list), Counter(name for name, *_ in residuals)
    for name, image_id, error_px in residuals:
        if views[name] > 2:
            errors[image_id].append(error_px)
    agreeing = math.log(AGREES_IF_RIGHT / AGREES_BY_CHANCE)
    differing = math.log((1.0 - AGREES_IF_RIGHT) / (1.0 - AGREES_BY_CHANCE))
    found = {}
    for image_id, of_image in errors.items():
        num = sum(error_px <= AGREEING_PX for error_px in of_image)
        nats = max(0, num - NUM_FREE) * agreeing + (len(of_image) - num) * differing
        found[image_id] = min(nats, MOST)
    return found


def tie_points_of(task: MappingTask, graph: PairGraph) -> TiePoints:
    """Return the tie points of a task, by the ids of its images."""
    ids = {name: image_id for image_id, name in graph.names.items()}
    found = task.tie_points.items()
    return TiePoints({p: {ids[name]: key for name, key in seen.items()} for p, seen in found})


def _errors_px(
    model: pycolmap.Reconstruction, marks: Mapping[int, Array], place: Array
) -> list[float]:
    """Return reprojection errors, those of a point behind the camera as large as the image."""
    found = []
    for image_id, xy in marks.items():
        image = model.images[image_id]
        camera, projected = model.cameras[image.camera_id], image.project_point(place)
        largest = math.hypot(camera.width, camera.height)
        found.append(largest if projected is None else min(largest, math.dist(projected, xy)))
    return found


def _place_by_neighbors(model: pycolmap.Reconstruction, image_id: int, xy: Array) -> Array | None:
    """Return where the ray of a mark is as deep as the points that the image sees around it."""
    image, camera = model.images[image_id], model.cameras[model.images[image_id].camera_id]
    seen = image.get_observation_points2D()
    distances = np.array([np.linalg.norm(point.xy - xy) for point in seen])
    near = np.argsort(distances)[:NUM_NEAR]
    if len(near) < NUM_NEAR or distances[near[-1]] > NEAR * max(camera.width, camera.height):
        return None
    pose = image.cam_from_world()
    depths = [(pose * model.points3D[seen[i].point3D_id].xyz)[2] for i in near]
    ray = np.append(np.asarray(camera.cam_from_img(xy)).ravel(), 1.0)
    return np.asarray(pose.inverse() * (np.median(depths) * ray))
