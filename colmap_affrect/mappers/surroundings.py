"""Whether photographs that something ties show the same surroundings, as their model says.

A poster in two places, or a sculpture, ties photographs of both by many matches of one right
geometry, and so places one scene inside of the other. Then the model says that surfaces beside it
are seen by photographs of both, and these do not match. What is expected and what is found is
counted in cells of a grid: a point of one photograph is expected in another one where that looks
from a similar direction and has no surface of its own before it.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.geometry.arrays import Array, Bools, Indices
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.model_score import (
    GRID,
    RIGHT_PAIR,
    Beta,
    beta_log_ratio,
    grid_cells,
)
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, sampling_step

MIN_POINTS = 4  # expected of a cell that counts: fewer may be lost by chance (judged)
MAX_ANGLE_DEG = 40.0
"""Between the rays of two photographs to a point: beyond, matching loses much (judged)."""
MAX_ZOOM = 2.2  # ratio of scales, beyond which the same is true (judged)
# Times the depth of a surface before a point, which is hidden then; judged
HIDDEN = 1.15
# Of the longer side: surfaces of a photograph are known so far from its points; judged
SURFACE_RADIUS = 0.06
NUM_NEIGHBORS = 3  # whose median depth is that of the surface; theory
MAX_NUM_POINTS = 500  # of a photograph that are looked at; resource
MAX_NUM_PAIRS = 1000  # of a model: larger ones are not looked at; resource
CONTRADICTED = -6.0
"""Log-likelihood ratio of one place against two, below which parts are two places: twenty to one,
where one place is twenty times as probable beforehand (theory)."""
TIED = 1.5  # of a pair: as much as about ten cells tell that are all found (theory)
ONE_PLACE = 3.0  # log odds beforehand of one place, twenty to one (theory)
# Share of the cells of the smaller region that two regions share; judged
MAX_COMMON = 0.1
MIN_EXPECTED = 8  # cells, an eighth of a photograph: less tells nothing (judged)
# Shares of expected cells that are found. Measured: 0.85 to 1 of pairs of true scenes, seldom 0.6.
# A poster or a statue in two places may take any share: 0.22 to 0.54, and 0.55 to 0.8 (theory)
SAME_PLACE = RIGHT_PAIR
OTHER_PLACE = Beta(1.0, 1.0)  # any share is as probable as another one (theory)


@dataclass(frozen=True)
class Overlap:
    """What two photographs have in common as a model says, and of that what matches."""

    num_expected: float  # cells
    num_found: float  # of them

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of one place against two, 0 where too little is expected."""
        if not self.tells:
            return 0.0
        return beta_log_ratio(
            self.num_found, self.num_expected, SAME_PLACE, OTHER_PLACE
        )

    @property
    def tells(self) -> bool:
        """Whether enough is expected."""
        return self.num_expected >= MIN_EXPECTED


class _Views:
    """What the photographs of a model observe."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model = model
        self._seen = dict[int, tuple[Array, Indices, Array]]()
        self._observed = dict[int, Indices]()

    def seen(self, image_id: int) -> tuple[Array, Indices, Array]:
        """Return (N, 2) px, (N,) ids and (N, 3) positions of points that an image observes."""
        if image_id not in self._seen:
            observed = self.model.images[image_id].get_observation_points2D()
            kept = observed[:: sampling_step(len(observed), MAX_NUM_POINTS)]
            points_px = np.array([mark.xy for mark in kept]).reshape(-1, 2)
            ids = np.array([mark.point3D_id for mark in kept], np.int64)
            points = [self.model.points3D[mark.point3D_id].xyz for mark in kept]
            positions = np.array(points).reshape(-1, 3)
            self._seen[image_id] = points_px, ids, positions
        return self._seen[image_id]

    def observes(self, image_id: int, ids: Indices) -> Bools:
        """Return which points an image observes, of all and not of a sample."""
        if image_id not in self._observed:
            observed = self.model.images[image_id].get_observation_points2D()
            self._observed[image_id] = np.array([p.point3D_id for p in observed])
        return np.isin(ids, self._observed[image_id])

    def overlap(self, first: int, second: int) -> Overlap:
        """Return the mean of what is expected and found of both images in the other one."""
        there = self._expected(first, second)
        back = self._expected(second, first)
        return Overlap(
            (there.num_expected + back.num_expected) / 2,
            (there.num_found + back.num_found) / 2,
        )

    def regions_differ(self, image_id: int, first: set[int], second: set[int]) -> bool:
        """Tell whether an image shares points with two sets of images in different regions of it.

        Args:
            image_id: Of the image.
            first: Other images.
            second: Others.
        """
        points_px, ids, _ = self.seen(image_id)
        camera = self.model.cameras[self.model.images[image_id].camera_id]
        cells = grid_cells(camera, points_px)
        regions = []
        for side in (first, second):
            is_shared = np.zeros(len(ids), bool)
            for other in side:
                is_shared |= self.observes(other, ids)
            regions.append(set(cells[is_shared].tolist()))
        smaller = min(map(len, regions))
        common = len(regions[0] & regions[1])
        return smaller > 0 and common <= MAX_COMMON * smaller

    def _expected(self, source: int, target: int) -> Overlap:
        """Return the cells of the target where points of the source are expected, and found."""
        _, ids, positions = self.seen(source)
        if not len(ids):
            return Overlap(0, 0)
        camera = self.model.cameras[self.model.images[target].camera_id]
        pose = self.model.images[target].cam_from_world().matrix()
        local = positions @ pose[:, :3].T + pose[:, 3]
        points_px = _projected(camera, local)
        is_inside = (points_px >= 0).all(axis=1)
        is_inside &= (points_px < [camera.width, camera.height]).all(axis=1)
        is_expected = is_inside & self._looks_alike(source, target, positions)
        is_found = self.observes(target, ids)
        open_rows = np.flatnonzero(is_expected & ~is_found)
        is_hidden = self._is_hidden(target, points_px[open_rows], local[open_rows, 2])
        is_expected[open_rows[is_hidden]] = False
        cells = grid_cells(camera, points_px[is_expected])
        return _counted(cells, is_found[is_expected])

    def _looks_alike(self, source: int, target: int, positions: Array) -> Bools:
        """Tell which positions two images see from similar directions and at similar scales."""
        lengths = []
        directions = []
        scales = []
        for image_id in (source, target):
            image = self.model.images[image_id]
            rays = positions - image.projection_center()
            length = np.maximum(np.linalg.norm(rays, axis=1), np.finfo(float).tiny)
            lengths.append(length)
            directions.append(rays / length[:, None])
            focal_px = self.model.cameras[image.camera_id].mean_focal_length()
            scales.append(focal_px / length)
        cosines = (directions[0] * directions[1]).sum(axis=1)
        zooms = np.abs(np.log(scales[0] / scales[1]))
        is_near = cosines > np.cos(np.radians(MAX_ANGLE_DEG))
        return np.asarray(is_near & (zooms < np.log(MAX_ZOOM)))

    def _is_hidden(self, image_id: int, points_px: Array, depths: Array) -> Bools:
        """Tell which points lie behind a surface that an image sees.

        Args:
            image_id: Of the image.
            points_px: (N, 2) px where it would see them.
            depths: (N,) in its camera.
        """
        own, _, positions = self.seen(image_id)
        if len(own) < NUM_NEIGHBORS:
            return np.zeros(len(points_px), bool)
        image = self.model.images[image_id]
        pose = image.cam_from_world().matrix()
        own_depths = positions @ pose[2, :3] + pose[2, 3]
        camera = self.model.cameras[image.camera_id]
        radius_px = SURFACE_RADIUS * max(camera.width, camera.height)
        across = points_px[:, :1] - own[:, 0]
        down = points_px[:, 1:] - own[:, 1]
        squares = across * across + down * down
        nearest = np.argpartition(squares, NUM_NEIGHBORS - 1, axis=1)
        nearest = nearest[:, :NUM_NEIGHBORS]
        farthest = np.take_along_axis(squares, nearest, axis=1).max(axis=1)
        is_known = farthest < radius_px * radius_px
        surfaces = np.median(own_depths[nearest], axis=1)
        return np.asarray(is_known & (depths > HIDDEN * surfaces))


def _projected(camera: pycolmap.Camera, local: Array) -> Array:
    """Return the (N, 2) px of (N, 3) points, -1 of those behind the camera."""
    points_px = np.full((len(local), 2), -1.0)
    is_before = local[:, 2] > 0
    if is_before.any():
        projected = np.asarray(camera.img_from_cam(local[is_before]), np.float64)
        points_px[is_before] = np.where(np.isfinite(projected), projected, -1.0)
    return points_px


def _counted(cells: Indices, is_found: Bools) -> Overlap:
    """Count the cells that have matches, and those that would if matches were where points are.

    Few matches are in few cells, wherever they are.

    Args:
        cells: (N,) number of the cell of each point that is expected.
        is_found: (N,) whether it is found.
    """
    num_points = np.bincount(cells, minlength=GRID * GRID)
    num_found = np.bincount(cells, weights=is_found, minlength=GRID * GRID)
    counts = num_points >= MIN_POINTS
    num_matches = float(num_found[counts].sum())
    shares = num_points[counts] / max(num_points[counts].sum(), 1)
    num_expected = float((1.0 - (1.0 - shares) ** num_matches).sum())
    num_occupied = float((num_found[counts] > 0).sum())
    return Overlap(max(num_expected, num_occupied), num_occupied)


@dataclass
class Places:
    """The images of each place that a model holds, the largest place first."""

    images: list[set[int]]
    collages: set[int] = field(default_factory=set)
    """Images of two places: one region matches one of them, another one the other."""
    unclear: dict[int, float] = field(default_factory=dict)
    """Probability, by image, that it is of the place of others that it is taken for."""

    @property
    def is_clearly_one(self) -> bool:
        """Whether nothing speaks for more than one place."""
        return len(self.images) == 1 and not self.collages and not self.unclear


def known_places(mapped: MappedModel, graph: PairGraph) -> Places:
    """Return the places that a model holds, and look at it only if nobody has."""
    model = mapped.reconstruction
    if mapped.one_place_by is graph:
        return Places([set(model.reg_image_ids())])
    return places_of(model, graph)


def places_of(model: pycolmap.Reconstruction, graph: PairGraph) -> Places:
    """Return the places that a model holds.

    Images are of one place where pairs tie them whose surroundings match. Parts that other pairs
    tie are two places only where the surroundings contradict that on the whole: images far apart
    have none in common. Parts that one image alone ties, by matches in other regions of it, are two
    places, too: it may be a collage, and nothing tells the scale of one part in the other.

    Args:
        model: The model.
        graph: Its pairs.
    """
    images = set(model.reg_image_ids())
    pairs = graph.pairs_inside(images)
    with_pairs = {image_id for pair in pairs for image_id in pair.ids}
    if len(pairs) > MAX_NUM_PAIRS or with_pairs != images:
        return Places([images])  # too many to look at, or tied by something else
    views = _Views(model)
    overlaps = {pair.ids: views.overlap(*pair.ids) for pair in pairs}
    tied = list[Ids]()
    for ids, one in overlaps.items():
        if one.tells and one.log_ratio >= TIED:
            tied.append(ids)
    found = Places([])
    merged = _merged(connected_parts(tied, images), overlaps, found.unclear)
    for place in merged:
        found.images += _cut_at_collages(place, overlaps, views, found.collages)
    found.images.sort(key=lambda part: (-len(part), min(part)))
    return found


@dataclass(frozen=True)
class _Merger:
    """Two parts that pairs tie."""

    log_ratio: float  # of one place against two
    first: set[int]
    second: set[int]


def _merged(
    parts: Sequence[set[int]],
    overlaps: Mapping[Ids, Overlap],
    unclear: dict[int, float],
) -> list[set[int]]:
    """Merge parts unless the surroundings of the pairs between them contradict that.

    Args:
        parts: Of images.
        overlaps: By pair.
        unclear: Gets the images of smaller parts of which that is not clear.
    """
    left = list(parts)
    merger = _best_merger(left, overlaps)
    while merger:
        first = merger.first
        second = merger.second
        if merger.log_ratio < -ONE_PLACE:  # two places are more likely
            probability = 1.0 / (1.0 + math.exp(-merger.log_ratio - ONE_PLACE))
            for image_id in _not_larger(first, second):
                unclear[image_id] = min(probability, unclear.get(image_id, 1.0))
        left = [part for part in left if part not in (first, second)]
        left.append(first | second)
        merger = _best_merger(left, overlaps)
    return left


def _not_larger(first: set[int], second: set[int]) -> set[int]:
    """Return the images of the smaller part, of both where they are equal."""
    if len(first) == len(second):
        return first | second
    return min(first, second, key=len)


def _best_merger(
    parts: Sequence[set[int]], overlaps: Mapping[Ids, Overlap]
) -> _Merger | None:
    """Return the two parts that are most likely of one place, if any are not contradicted."""
    best = None
    highest = CONTRADICTED
    for first, second in combinations(parts, 2):
        between = list[Overlap]()
        for ids, one in overlaps.items():
            if not first.isdisjoint(ids) and not second.isdisjoint(ids):
                between.append(one)
        log_ratio = _joint_log_ratio(between)
        is_better = log_ratio > highest or (best is None and log_ratio == highest)
        if between and is_better:
            highest = log_ratio
            best = _Merger(log_ratio, first, second)
    return best


def _joint_log_ratio(overlaps: Sequence[Overlap]) -> float:
    """Return the log-likelihood ratio of pairs that err together, at least in part.

    It grows with the root of their number, as if each told half of what it tells alone.
    """
    ratios = [one.log_ratio for one in overlaps if one.tells]
    return float(np.sum(ratios) / np.sqrt(len(ratios))) if ratios else 0.0


def _cut_at_collages(
    place: set[int],
    overlaps: Mapping[Ids, Overlap],
    views: _Views,
    collages: set[int],
) -> list[set[int]]:
    """Cut off the parts that one image alone ties, by another region of it.

    Args:
        place: Images.
        overlaps: By pair.
        views: What images observe.
        collages: Gets these images.
    """
    inside = [ids for ids in overlaps if place.issuperset(ids)]
    for middle in sorted(place):
        others = [ids for ids in inside if middle not in ids]
        sides = connected_parts(others, place - {middle})
        for side in sides[1:]:
            if len(side) > 1 and views.regions_differ(middle, sides[0], side):
                collages.add(middle)
                rest = _cut_at_collages(place - side, overlaps, views, collages)
                return [*rest, *_cut_at_collages(side, overlaps, views, collages)]
    return [place]


def apart(mapped: MappedModel, places: Places) -> list[MappedModel]:
    """Return a model for each place that a model holds; itself, without the others, is the first.

    Args:
        mapped: The model; its reconstruction is changed where it holds several places.
        places: That it holds.
    """
    model = mapped.reconstruction
    found = list[MappedModel]()
    for place in places.images[1:]:
        other = copy.deepcopy(model)
        _keep(other, place)
        found.append(replace(mapped, reconstruction=other))
    if found:
        _keep(model, places.images[0])
    return [mapped, *found]


def _keep(model: pycolmap.Reconstruction, image_ids: set[int]) -> None:
    """Deregister all other images."""
    for image_id in sorted(set(model.reg_image_ids()) - image_ids):
        image = model.images[image_id]
        if image.has_pose:
            model.deregister_frame(image.frame_id)
