"""The verified pairs of a database, and how well poses agree with them."""

import copy
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.colmap.database import (
    cameras_of_images,
    names_of_images,
    open_database,
)
from colmap_affrect.colmap.model_files import Pose, relative_pose
from colmap_affrect.colmap.two_views import (
    Cameras,
    decomposed_homography,
    homography_matrix,
)
from colmap_affrect.geometry.arrays import Array, Bools, Indices, Singles, sampling_step
from colmap_affrect.geometry.epipolar import sampson_errors
from colmap_affrect.geometry.parallax import Size
from colmap_affrect.geometry.two_views import (
    Depths,
    essential_matrix,
    triangulated_depths,
)
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.caches import empty_copy
from colmap_affrect.mappers.few_matches import (
    MIN_FEW,
    FewMatches,
    sure_few_matches,
)
from colmap_affrect.mappers.thinning import (
    OF_SMALL_SETS,
    Thinning,
    matches_of_best_tracks,
)

Ids = tuple[int, int]  # of two images
PoseById = Mapping[int, Pose]
CameraById = Mapping[int, pycolmap.Camera]  # by image id

# An inlier agrees with poses up to this Sampson error, the larger of the two.
MAX_ERROR_PX = 4.0  # COLMAP's limit for observations (filter_max_reproj_error)
MAX_ERROR = 0.003
"""Of the longer side, of a match that a pose explains: 3 px in a photograph of 1000 (judged)."""
MIN_ANGLE_DEG = 1.0
"""Rays closer to parallel tell no depth, nor which side of a camera a point is on (judged)."""
# Inliers of a pair that are sampled for agreement and relative poses; resource
MAX_MATCHES = 500
MAX_RANSAC_TRIALS = 1000  # of RANSAC, for a relative pose; resource
# The strongest of each image that models are scored by (resource)
MAX_PAIRS_OF_IMAGE = 15
MIN_NUM_MATCHES = 15  # inliers of a pair; COLMAP's min_num_matches
MIN_SHARE = 0.5  # of the inliers of a pair: fewer that agree contradict poses; theory


@dataclass(frozen=True)
class VerifiedPair:
    """A verified pair of images."""

    ids: Ids
    matches: Indices  # (M, 2) features that are inliers
    geometry: pycolmap.TwoViewGeometry  # of the pair in the database
    has_few_matches: bool = False  # it has few matches, which are sure all the same


Pairs = tuple[VerifiedPair, ...]


@dataclass(frozen=True)
class RelativePose:
    """A relative pose of a pair that its inliers allow."""

    pose: Pose  # cam2_from_cam1, with a translation of length 1
    matches: Indices
    """(M, 2) features that agree, with enough parallax to know their depth."""
    depths: tuple[Array, Array]  # of these in both cameras, twice (M,), all positive


@dataclass(frozen=True)
class Agreement:
    """How well matches agree with a relative pose."""

    errors_px: Array
    """(M,) Sampson errors, infinite where no point in front explains a match."""
    tolerance_px: float  # largest error of a match that agrees
    depths: Depths  # of all matches

    @property
    def agrees(self) -> Bools:
        """Tell which matches agree."""
        return self.errors_px <= self.tolerance_px


@dataclass(frozen=True, eq=False)
class _KnownAgreement:
    """The agreement of a pair, and what it was computed of."""

    pair: VerifiedPair
    asked: bytes  # its poses and cameras, see _bytes_of
    share: float  # of its inliers


@dataclass(frozen=True, eq=False)
class PairGraph:
    """The verified pairs of a database, of each image the strongest."""

    cache: pycolmap.DatabaseCache  # the same for pycolmap's mappers
    names: Mapping[int, str]  # by image id
    cameras: CameraById  # as in the database
    keypoints: Mapping[int, Singles]  # (N, 2) px by image id, of the images of pairs
    pairs: Pairs  # sorted by ids
    unscored: Pairs  # not among the strongest: points are made of them as well
    min_num_matches: int  # pairs with fewer inliers are left out
    raw_matches: dict[Ids, Indices] = field(default_factory=dict)
    """Raw (M, 2) matches of the strongest pairs, where a database was read."""
    shaped_keypoints: dict[int, Singles] = field(default_factory=dict)
    """(N, 2, 4 or 6) by image id, of the same pairs, as the database has them."""
    _agreements: dict[Ids, _KnownAgreement] = field(
        default_factory=dict, init=False, repr=False
    )
    """The last agreement of each pair: models are looked at several times."""

    @classmethod
    def read(cls, path: Path, min_num_matches: int = MIN_NUM_MATCHES) -> Self:
        """Read the verified pairs and all images of a database.

        Args:
            path: The database.
            min_num_matches: Pairs with fewer inliers are left out, but for those that are sure all
                the same (:mod:`colmap_affrect.mappers.few_matches`).
        """
        with open_database(path) as database:
            graph = cls.of(database, min_num_matches)
            for pair in graph.pairs:
                raw = np.asarray(database.read_matches(*pair.ids), np.int64)
                graph.raw_matches[pair.ids] = raw.reshape(-1, 2)
            for image_id in graph.keypoints:
                rows = database.read_keypoints(image_id)
                graph.shaped_keypoints[image_id] = np.asarray(rows, np.float32)
            known = {pair.ids: pair.matches for pair in graph.verified}
            found = sure_few_matches(database, known)
            return graph._with_few_matches(found, database) if found else graph

    @classmethod
    def of(
        cls, database: pycolmap.Database, min_num_matches: int = MIN_NUM_MATCHES
    ) -> Self:
        """Read a database that is open: its verified pairs, without raw matches and shapes."""
        options = pycolmap.DatabaseCacheOptions(
            min_num_matches=min_num_matches, load_all_images=True
        )
        verified = _read_pairs(database, min_num_matches)
        keypoints = {}
        for image_id in _images_of(verified):
            keypoints[image_id] = _read_positions(database, image_id)
        scored, unscored = _split_by_strength(verified)
        return cls(
            cache=pycolmap.DatabaseCache.create(database, options),
            names=names_of_images(database),
            cameras=cameras_of_images(database),
            keypoints=keypoints,
            pairs=scored,
            unscored=unscored,
            min_num_matches=min_num_matches,
        )

    def without(self, ids: Collection[Ids]) -> Self:
        """Return a graph without some pairs; the same one where there are none."""
        if not ids:
            return self
        kept = [pair for pair in self.verified if pair.ids not in ids]
        return self._with_pairs(kept, self.cache)

    def _with_few_matches(
        self, pairs: Iterable[FewMatches], database: pycolmap.Database
    ) -> Self:
        """Return a graph with more pairs, of few matches, whose keypoints a database has."""
        verified = [*self.verified]
        keypoints = {**self.keypoints}
        for pair in pairs:
            for image_id in pair.ids:
                if image_id not in keypoints:
                    keypoints[image_id] = _read_positions(database, image_id)
            verified.append(
                VerifiedPair(
                    pair.ids, pair.matches, pair.geometry, has_few_matches=True
                )
            )
        with_keypoints = replace(self, keypoints=keypoints)
        return with_keypoints._with_pairs(verified, self.cache)

    @cached_property
    def images_with_few_matches_only(self) -> frozenset[int]:
        """The images none of whose pairs has many matches."""
        with_many = _images_of(
            pair for pair in self.verified if not pair.has_few_matches
        )
        return frozenset(_images_of(self.verified) - with_many)

    @property
    def verified(self) -> Pairs:
        """All pairs, also those that are not among the strongest."""
        return self.pairs + self.unscored

    @property
    def has_rigs(self) -> bool:
        """Whether several sensors belong to one rig."""
        return any(rig.num_sensors() > 1 for rig in self.cache.rigs.values())

    @cached_property
    def largest_component(self) -> frozenset[int]:
        """The images of the largest connected component."""
        components = connected_parts(pair.ids for pair in self.pairs)
        return frozenset(components[0] if components else ())

    def with_cameras(self, records: Mapping[int, CameraRecord]) -> Self:
        """Give images the cameras that records say they have, of those of the graph."""
        camera_of = {}
        for key, record in records.items():
            for name in record.names:
                camera_of[name] = key
        cache = empty_copy(self.cache, camera_of)
        cameras = {**self.cameras}
        for image_id, image in cache.images.items():
            cameras[image_id] = cache.cameras[image.camera_id]
        return replace(self._with_pairs(self.verified, cache), cameras=cameras)

    def thinned(self, thinning: Thinning = OF_SMALL_SETS) -> Self:
        """Leave out tracks where the others tell the poses as well; itself where they are few.

        See :mod:`colmap_affrect.mappers.thinning`, which says how many are kept.
        """
        matches = [(pair.ids, pair.matches) for pair in self.verified]
        num_keypoints = {i: len(points) for i, points in self.keypoints.items()}
        best = matches_of_best_tracks(matches, num_keypoints, thinning)
        if best.share_of_features > thinning.max_share:
            return self
        thin = list[VerifiedPair]()
        for pair, is_kept in zip(self.verified, best.is_kept, strict=True):
            thin.append(replace(pair, matches=pair.matches[is_kept]))
        return self._with_pairs(thin, self.cache)

    def _with_pairs(
        self, verified: Iterable[VerifiedPair], cache: pycolmap.DatabaseCache
    ) -> Self:
        """Return a graph of other pairs, with the cameras and images of a cache."""
        kept = list[VerifiedPair]()
        for pair in verified:
            least = MIN_FEW if pair.has_few_matches else self.min_num_matches
            if len(pair.matches) >= least:
                kept.append(pair)
        new = empty_copy(cache, {})
        for pair in kept:
            geometry = copy.copy(pair.geometry)
            geometry.inlier_matches = pair.matches.astype(np.uint32)
            new.correspondence_graph.add_two_view_geometry(*pair.ids, geometry)
        new.correspondence_graph.finalize()
        used = _images_of(kept)
        keypoints = {i: points for i, points in self.keypoints.items() if i in used}
        best, rest = _split_by_strength(kept)
        return replace(self, cache=new, keypoints=keypoints, pairs=best, unscored=rest)

    def points(self, pair: VerifiedPair) -> tuple[Array, Array]:
        """Return the (M, 2) px of the inliers in both images."""
        return self._points(pair, pair.matches)

    def _sampled_points(self, pair: VerifiedPair) -> tuple[Array, Array]:
        step = sampling_step(len(pair.matches), MAX_MATCHES)
        return self._points(pair, pair.matches[::step])

    def _points(self, pair: VerifiedPair, matches: Indices) -> tuple[Array, Array]:
        first, second = pair.ids
        points1 = self.keypoints[first][matches[:, 0]]
        points2 = self.keypoints[second][matches[:, 1]]
        return points1.astype(np.float64), points2.astype(np.float64)

    def sizes(self, ids: Ids) -> tuple[Size, Size]:
        """Return the sizes of the images of a pair."""
        first = self.cameras[ids[0]]
        second = self.cameras[ids[1]]
        return (first.width, first.height), (second.width, second.height)

    def pairs_inside(self, image_ids: Collection[int]) -> list[VerifiedPair]:
        """Return the pairs both of whose images are among some."""
        return _pairs_among(self.pairs, image_ids)

    def agreement(
        self, pair: VerifiedPair, poses: PoseById, cameras: CameraById
    ) -> float:
        """Return the share of the inliers of a pair that agree with poses, from a sample of them.

        Args:
            pair: A pair of the graph.
            poses: cam_from_world of both images, by image id.
            cameras: Cameras of both images, by image id.
        """
        first, second = pair.ids
        both = cameras[first], cameras[second]
        asked = _bytes_of((*poses[first], *poses[second]), both)
        known = self._agreements.get(pair.ids)
        if known and known.pair is pair and known.asked == asked:
            return known.share
        pose = relative_pose(poses[first], poses[second])
        compared = compared_with_pose(pose, both, self._sampled_points(pair))
        share = float(compared.agrees.mean())
        self._agreements[pair.ids] = _KnownAgreement(pair, asked, share)
        return share

    def unexplained_by(self, model: pycolmap.Reconstruction) -> list[VerifiedPair]:
        """Return the pairs that contradict a model, or have an image that it has not."""
        inside = set(model.reg_image_ids())
        contradicted = self.contradicted(model)
        found = list[VerifiedPair]()
        for pair in self.pairs:
            is_inside = inside.issuperset(pair.ids)
            if not is_inside or pair.ids in contradicted:
                found.append(pair)
        return found

    def contradicted(self, model: pycolmap.Reconstruction) -> frozenset[Ids]:
        """Return the pairs most of whose inliers disagree with a model that has both images."""
        return self._contradicted(self.pairs, model)

    def contradicted_verified(self, model: pycolmap.Reconstruction) -> frozenset[Ids]:
        """Return the same of all verified pairs, also those not among the strongest."""
        return self._contradicted(self.verified, model)

    def _contradicted(
        self, pairs: Pairs, model: pycolmap.Reconstruction
    ) -> frozenset[Ids]:
        poses = poses_of(model)
        cameras = cameras_of(model)
        found = set[Ids]()
        for pair in _pairs_among(pairs, poses):
            if self.agreement(pair, poses, cameras) < MIN_SHARE:
                found.add(pair.ids)
        return frozenset(found)

    def relative_poses(
        self, pair: VerifiedPair, cameras: CameraById, random_seed: int
    ) -> list[RelativePose]:
        """Return the relative poses that explain a pair, the likeliest one first.

        The first one is of its essential matrix, the others are those into which its homography
        can be decomposed: of a plane seen twice both solutions may have all points in front of both
        cameras, so that only other pairs can tell which one is right.

        Args:
            pair: A pair of the graph.
            cameras: Cameras of both images, by image id.
            random_seed: For RANSAC.
        """
        both = cameras[pair.ids[0]], cameras[pair.ids[1]]
        allowed = list[RelativePose]()
        for pose in self._candidate_poses(pair, both, random_seed):
            compared = compared_with_pose(pose, both, self.points(pair))
            depths = compared.depths
            has_depth = compared.agrees & (depths.angles_deg > MIN_ANGLE_DEG)
            if compared.agrees.mean() >= MIN_SHARE and has_depth.any():
                matches = pair.matches[has_depth]
                of_both = depths.first[has_depth], depths.second[has_depth]
                allowed.append(RelativePose(pose, matches, depths=of_both))
        return allowed

    def _candidate_poses(
        self, pair: VerifiedPair, cameras: Cameras, random_seed: int
    ) -> list[Pose]:
        options = pycolmap.RANSACOptions(
            max_error=MAX_ERROR_PX,
            max_num_trials=MAX_RANSAC_TRIALS,
            random_seed=max(random_seed, 0),
        )
        candidates = list[Pose]()
        # Not by a two-view geometry, which where a fundamental matrix has more inliers is that.
        points = self._sampled_points(pair)
        found: Any = pycolmap.estimate_essential_matrix(*points, *cameras, options)
        if found and found.get("cam2_from_cam1") is not None:
            matrix = found["cam2_from_cam1"].matrix()
            candidates.append((matrix[:, :3], matrix[:, 3]))
        homography = homography_matrix(pair.geometry)
        if homography is not None:
            candidates += decomposed_homography(homography, cameras)
        return candidates


def graph_of(task: MappingTask, min_num_matches: int) -> PairGraph:
    """Return the graph of what is to be mapped; it is read once for a task.

    Args:
        task: Names the database. Tasks that ``replace`` makes of it have the same graph.
        min_num_matches: Pairs with fewer inliers are left out.
    """
    key = task.database_path, min_num_matches
    if key not in task.graphs:
        task.graphs[key] = PairGraph.read(*key)
    return task.graphs[key]


def poses_of(model: pycolmap.Reconstruction) -> dict[int, Pose]:
    """Return cam_from_world of the registered images by image id."""
    poses = {}
    for image_id in model.reg_image_ids():
        matrix = model.image(image_id).cam_from_world().matrix()
        poses[image_id] = matrix[:, :3], matrix[:, 3]
    return poses


def cameras_of(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Camera]:
    """Return the cameras of the registered images by image id."""
    return {i: model.cameras[model.images[i].camera_id] for i in model.reg_image_ids()}


def used_cameras(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Camera]:
    """Return the cameras of the registered images by camera id."""
    return {camera.camera_id: camera for camera in cameras_of(model).values()}


def num_matched_images(
    num_keypoints: Mapping[int, int],
    pairs: Iterable[VerifiedPair],
    viewpoint_of: Mapping[int, int] | None = None,
) -> dict[int, Indices]:
    """Return in how many other images each feature is matched, by image id.

    Args:
        num_keypoints: Of each image.
        pairs: Pairs of these images.
        viewpoint_of: Of images from the same viewpoint, which count as one, a common number by
            image id; others have none.
    """
    viewpoint_of = viewpoint_of or {}
    matched = defaultdict[tuple[int, int], list[Indices]](list)
    for pair in pairs:
        first, second = pair.ids
        viewpoint1 = viewpoint_of.get(first, first)
        viewpoint2 = viewpoint_of.get(second, second)
        if viewpoint1 != viewpoint2:
            matched[first, viewpoint2].append(pair.matches[:, 0])
            matched[second, viewpoint1].append(pair.matches[:, 1])
    found = {}
    for image_id, number in num_keypoints.items():
        found[image_id] = np.zeros(number, np.int64)
    for (image_id, _), features in matched.items():
        found[image_id][np.unique(np.concatenate(features))] += 1
    return found


def has_rigs(model: pycolmap.Reconstruction) -> bool:
    """Tell whether a model has a rig of several sensors."""
    return any(rig.num_sensors() > 1 for rig in model.rigs.values())


def _bytes_of(arrays: Iterable[Array], cameras: Cameras) -> bytes:
    """Return what tells poses and cameras from others, to the bit."""
    parts = [np.asarray(values).tobytes() for values in arrays]
    for camera in cameras:
        numbers = [camera.model.value, camera.width, camera.height, *camera.params]
        parts.append(np.array(numbers, np.float64).tobytes())
    return b"".join(parts)


def compared_with_pose(
    pose: Pose, cameras: Cameras, points: tuple[Array, Array]
) -> Agreement:
    """Compare matches with a relative pose.

    Args:
        pose: cam2_from_cam1.
        cameras: Of both images.
        points: Px in both images, twice (M, 2).
    """
    first, second = cameras
    rays1 = np.asarray(first.cam_from_img(points[0]), np.float64)
    rays2 = np.asarray(second.cam_from_img(points[1]), np.float64)
    with np.errstate(all="ignore"):  # of cameras that are impossible
        depths = triangulated_depths(*pose, rays1, rays2)
        focal1 = np.float64(first.mean_focal_length())
        focal2 = np.float64(second.mean_focal_length())
        # Sampson errors are of px when rays are scaled by the focal lengths.
        scale1 = np.diag([1 / focal1, 1 / focal1, 1.0])
        scale2 = np.diag([1 / focal2, 1 / focal2, 1.0])
        fundamental = scale2 @ essential_matrix(*pose) @ scale1
        errors = sampson_errors(fundamental, focal1 * rays1, focal2 * rays2)
    longer_sides = [max(camera.width, camera.height) for camera in cameras]
    tolerance = max(MAX_ERROR_PX, *(MAX_ERROR * side for side in longer_sides))
    is_possible = depths.in_front | (depths.angles_deg < MIN_ANGLE_DEG)
    errors = np.where(is_possible, errors, np.inf)
    return Agreement(errors, tolerance, depths)


def _read_pairs(
    database: pycolmap.Database, min_num_matches: int
) -> list[VerifiedPair]:
    verified = list[VerifiedPair]()
    for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
        matches = np.asarray(geometry.inlier_matches, np.int64)
        if len(matches) >= min_num_matches:
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            verified.append(VerifiedPair(ids, matches, geometry))
    return verified


def _pairs_among(
    pairs: Iterable[VerifiedPair], image_ids: Collection[int]
) -> list[VerifiedPair]:
    inside = set(image_ids)
    return [pair for pair in pairs if inside.issuperset(pair.ids)]


def _images_of(pairs: Iterable[VerifiedPair]) -> set[int]:
    return {image_id for pair in pairs for image_id in pair.ids}


def _by_strength(pairs: Iterable[VerifiedPair]) -> list[VerifiedPair]:
    """Return pairs, those with most inliers first."""
    return sorted(pairs, key=lambda pair: (-len(pair.matches), pair.ids))


def strongest_of_images(
    pairs: Iterable[VerifiedPair], max_num: int
) -> list[VerifiedPair]:
    """Return the pairs that are among so many strongest of one of their images, strongest first."""
    num_stronger = Counter[int]()
    found = list[VerifiedPair]()
    for pair in _by_strength(pairs):
        if min(num_stronger[image_id] for image_id in pair.ids) < max_num:
            found.append(pair)
        num_stronger.update(pair.ids)
    return found


def _split_by_strength(pairs: Collection[VerifiedPair]) -> tuple[Pairs, Pairs]:
    """Return the ``MAX_PAIRS_OF_IMAGE`` strongest pairs of each image, by ids, and the others."""
    scored = strongest_of_images(pairs, MAX_PAIRS_OF_IMAGE)
    scored.sort(key=lambda pair: pair.ids)
    scored_ids = {pair.ids for pair in scored}
    unscored = [pair for pair in _by_strength(pairs) if pair.ids not in scored_ids]
    return tuple(scored), tuple(unscored)


def _read_positions(database: pycolmap.Database, image_id: int) -> Singles:
    """Return the (N, 2) positions of the keypoints of an image."""
    rows = database.read_keypoints(image_id)
    return np.array(rows[:, :2], np.float32)
