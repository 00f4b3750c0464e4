"""Whether photographs that something ties show the same surroundings, as their model says.

A poster in two places, or a sculpture, ties photographs of both by many matches of one right
geometry, and so places one scene inside of the other. Then the model says that surfaces beside it
are seen by photographs of both, and these do not match. What is expected and what is found is
counted in cells of a grid: a point of one photograph is expected in another one where that looks
from a similar direction and has no surface of its own before it.
"""

import copy
import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.geometry.arrays import Array, Bools, Indices, sampling_step
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.model_score import (
    GRID,
    RIGHT_PAIR,
    Beta,
    beta_log_ratio,
    grid_cells,
)
from colmap_affrect.mappers.pair_graph import Ids, PairGraph
from colmap_affrect.project.reasons import DoubtCode

MIN_PLACE = 2  # photographs that make a model; theory
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
CLUSTER_SIZE = 1.25
"""Matches that come together: few of them leave cells empty by chance. Measured: with 1 right
photographs of an old print look like another place, with 1.5 two places with one statue do not."""
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
        if not self.has_enough:
            return 0.0
        return beta_log_ratio(
            num_agreeing=self.num_found,
            num=self.num_expected,
            right=SAME_PLACE,
            wrong=OTHER_PLACE,
        )

    @property
    def has_enough(self) -> bool:
        """Whether enough is expected to tell anything."""
        return self.num_expected >= MIN_EXPECTED


@dataclass(frozen=True)
class _Observed:
    """Points that an image observes."""

    points_px: Array  # (N, 2)
    ids: Indices  # (N,)
    positions: Array  # (N, 3)


@dataclass(frozen=True)
class _Expected:
    """Points of one photograph where another one should see them."""

    ids: Indices  # (N,)
    cells: Indices  # (N,) of the other photograph
    is_found: Bools  # (N,) whether that observes them


class _Views:
    """What the photographs of a model observe."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model = model
        self._expectations = dict[Ids, _Expected]()
        self._samples = dict[int, _Observed]()
        self._observed_ids = dict[int, Indices]()

    def sample(self, image_id: int) -> _Observed:
        """Return some of the points that an image observes."""
        if image_id not in self._samples:
            observed = self.model.images[image_id].get_observation_points2D()
            kept = observed[:: sampling_step(len(observed), MAX_NUM_POINTS)]
            points_px = [keypoint.xy for keypoint in kept]
            ids = [keypoint.point3D_id for keypoint in kept]
            positions = [self.model.points3D[point_id].xyz for point_id in ids]
            self._samples[image_id] = _Observed(
                points_px=np.array(points_px).reshape(-1, 2),
                ids=np.array(ids, np.int64),
                positions=np.array(positions).reshape(-1, 3),
            )
        return self._samples[image_id]

    def observes(self, image_id: int, ids: Indices) -> Bools:
        """Return which points an image observes, of all and not of a sample."""
        if image_id not in self._observed_ids:
            observed = self.model.images[image_id].get_observation_points2D()
            self._observed_ids[image_id] = np.array([p.point3D_id for p in observed])
        return np.isin(ids, self._observed_ids[image_id])

    def overlap(self, first: int, second: int) -> Overlap:
        """Return the mean of what is expected and found of both images in the other one."""
        in_second = self.overlap_with(second, [first])
        in_first = self.overlap_with(first, [second])
        return Overlap(
            num_expected=(in_second.num_expected + in_first.num_expected) / 2,
            num_found=(in_second.num_found + in_first.num_found) / 2,
        )

    def regions_differ(self, image_id: int, first: set[int], second: set[int]) -> bool:
        """Tell whether an image shares points with two sets of images in different regions of it.

        Args:
            image_id: Of the image.
            first: Other images.
            second: Others.
        """
        region1 = self._shared_region(image_id, first)
        region2 = self._shared_region(image_id, second)
        num_smaller = min(len(region1), len(region2))
        num_common = len(region1 & region2)
        return num_smaller > 0 and num_common <= MAX_COMMON * num_smaller

    def _shared_region(self, image_id: int, others: Collection[int]) -> set[int]:
        """Return the cells of an image with points that any of some other images observe."""
        observed = self.sample(image_id)
        camera = self.model.cameras[self.model.images[image_id].camera_id]
        cells = grid_cells(camera, observed.points_px)
        is_shared = np.zeros(len(cells), bool)
        for other in others:
            is_shared |= self.observes(other, observed.ids)
        return set(cells[is_shared].tolist())

    def overlap_with(
        self, target: int, sources: Collection[int], cluster_size: float = 1.0
    ) -> Overlap:
        """Return what is expected in an image of all that others see, and what of it is found.

        What one pair misses, another one finds; what is beside a poster, none does.

        Args:
            target: The image.
            sources: The others.
            cluster_size: Matches that come together.
        """
        expected = [self._expected(source, target) for source in sources]
        ids = np.concatenate([points.ids for points in expected])
        cells = np.concatenate([points.cells for points in expected])
        is_found = np.concatenate([points.is_found for points in expected])
        _, first_rows = np.unique(ids, return_index=True)
        return _counted(cells[first_rows], is_found[first_rows], cluster_size)

    def _expected(self, source: int, target: int) -> _Expected:
        """Return the points of the source that are expected in the target."""
        if (source, target) not in self._expectations:
            self._expectations[source, target] = self._expectation(source, target)
        return self._expectations[source, target]

    def _expectation(self, source: int, target: int) -> _Expected:
        ids = self.sample(source).ids
        positions = self.sample(source).positions
        if not len(ids):
            return _Expected(ids, ids, ids > 0)
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
        return _Expected(ids[is_expected], cells, is_found[is_expected])

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
        known = self.sample(image_id)
        if len(known.ids) < NUM_NEIGHBORS:
            return np.zeros(len(points_px), bool)
        image = self.model.images[image_id]
        pose = image.cam_from_world().matrix()
        known_depths = known.positions @ pose[2, :3] + pose[2, 3]
        camera = self.model.cameras[image.camera_id]
        radius_px = SURFACE_RADIUS * max(camera.width, camera.height)
        across = points_px[:, :1] - known.points_px[:, 0]
        down = points_px[:, 1:] - known.points_px[:, 1]
        squares = across * across + down * down
        nearest = np.argpartition(squares, NUM_NEIGHBORS - 1, axis=1)
        nearest = nearest[:, :NUM_NEIGHBORS]
        farthest = np.take_along_axis(squares, nearest, axis=1).max(axis=1)
        is_near = farthest < radius_px * radius_px
        surfaces = np.median(known_depths[nearest], axis=1)
        return np.asarray(is_near & (depths > HIDDEN * surfaces))


def _projected(camera: pycolmap.Camera, local: Array) -> Array:
    """Return the (N, 2) px of (N, 3) points, -1 of those behind the camera."""
    points_px = np.full((len(local), 2), -1.0)
    is_in_front = local[:, 2] > 0
    if is_in_front.any():
        projected = np.asarray(camera.img_from_cam(local[is_in_front]), np.float64)
        points_px[is_in_front] = np.where(np.isfinite(projected), projected, -1.0)
    return points_px


def _counted(cells: Indices, is_found: Bools, cluster_size: float) -> Overlap:
    """Count the cells that have matches, and those that would if matches were where points are.

    Few matches are in few cells, wherever they are.

    Args:
        cells: (N,) number of the cell of each point that is expected.
        is_found: (N,) whether it is found.
        cluster_size: Matches that come together.
    """
    num_points = np.bincount(cells, minlength=GRID * GRID)
    num_found = np.bincount(cells, weights=is_found, minlength=GRID * GRID)
    counts = num_points >= MIN_POINTS
    num_clusters = float(num_found[counts].sum()) / cluster_size
    shares = num_points[counts] / max(num_points[counts].sum(), 1)
    num_expected = float((1.0 - (1.0 - shares) ** num_clusters).sum())
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
    tied: list[set[int]] = field(default_factory=list)
    """Images that pairs tie whose surroundings match: parts of places."""
    why: DoubtCode = "other_surroundings"
    """Why places are apart."""

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
    for ids, overlap in overlaps.items():
        if overlap.has_enough and overlap.log_ratio >= TIED:
            tied.append(ids)
    found = Places([])
    found.tied = connected_parts(tied, images)
    merged = _merged(
        parts=found.tied,
        pairs=overlaps,
        views=views,
        unclear=found.unclear,
    )
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
    pairs: Collection[Ids],
    views: _Views,
    unclear: dict[int, float],
) -> list[set[int]]:
    """Merge parts unless the surroundings of the pairs between them contradict that.

    Args:
        parts: Of images.
        pairs: Of images.
        views: What images observe.
        unclear: Gets the images of smaller parts of which that is not clear.
    """
    left = list(parts)
    merger = _best_merger(left, pairs, views)
    while merger:
        first = merger.first
        second = merger.second
        if merger.log_ratio < -ONE_PLACE:  # two places are more likely
            probability = 1.0 / (1.0 + math.exp(-merger.log_ratio - ONE_PLACE))
            for image_id in _not_larger(first, second):
                unclear[image_id] = min(probability, unclear.get(image_id, 1.0))
        left = [part for part in left if part not in (first, second)]
        left.append(first | second)
        merger = _best_merger(left, pairs, views)
    return left


def _not_larger(first: set[int], second: set[int]) -> set[int]:
    """Return the images of the smaller part, of both where they are equal."""
    if len(first) == len(second):
        return first | second
    return min(first, second, key=len)


def _best_merger(
    parts: Sequence[set[int]], pairs: Collection[Ids], views: _Views
) -> _Merger | None:
    """Return the two parts that are most likely of one place, if any are not contradicted."""
    best = None
    highest = CONTRADICTED
    for first, second in combinations(parts, 2):
        partners = _partners_between(first, second, pairs)
        between = list[Overlap]()
        for image_id, others in partners.items():
            between.append(views.overlap_with(image_id, others, CLUSTER_SIZE))
        log_ratio = _joint_log_ratio(between)
        is_better = log_ratio > highest or (best is None and log_ratio == highest)
        if partners and is_better:
            highest = log_ratio
            best = _Merger(log_ratio, first, second)
    return best


def _partners_between(
    first: set[int], second: set[int], pairs: Collection[Ids]
) -> dict[int, list[int]]:
    """Return the partners in the other part of each image that pairs tie to it."""
    found = defaultdict[int, list[int]](list)
    for ids in pairs:
        is_between = not first.isdisjoint(ids) and not second.isdisjoint(ids)
        if is_between:
            one, other = ids
            found[one].append(other)
            found[other].append(one)
    return dict(found)


def _joint_log_ratio(overlaps: Sequence[Overlap]) -> float:
    """Return the log-likelihood ratio of images that err together, at least in part.

    It is between their mean, as of images that all err together, and their sum, as of independent
    ones: it grows with the root of their number.
    """
    ratios = [overlap.log_ratio for overlap in overlaps if overlap.has_enough]
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


def cut_into_places(mapped: MappedModel, places: Places) -> list[MappedModel]:
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
