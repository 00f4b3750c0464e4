"""The verified pairs of a database, and how well poses agree with them."""

import copy
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import cameras_of_images, open_database
from colmap_affrect.colmap.model_files import Pose, relative_pose
from colmap_affrect.colmap.two_views import Cameras, decomposed_homography, homography_matrix
from colmap_affrect.colmap.verification import connected_parts
from colmap_affrect.geometry.arrays import Array, Bools, Indices, Singles
from colmap_affrect.geometry.epipolar import sampson_errors
from colmap_affrect.geometry.parallax import Size
from colmap_affrect.geometry.two_views import Depths, essential_matrix, triangulated_depths
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.thinning import matches_of_best_tracks

Ids = tuple[int, int]  # of two images
PoseById = Mapping[int, Pose]
CameraById = Mapping[int, pycolmap.Camera]  # by image id

MAX_ERROR_PX, MAX_ERROR = 4.0, 0.003
"""An inlier agrees with poses up to this Sampson error, or this part of the longer side if that is
more: COLMAP's limit for observations, and what features of a shrunk photograph allow."""
MIN_ANGLE_DEG = 1.0  # rays closer to parallel tell no depth, nor which side of a camera a point is
MAX_MATCHES, MAX_TRIALS = 500, 1000
"""What agreement is measured with and relative poses estimated from: of inliers few are enough."""
MAX_PAIRS_OF_IMAGE = 15
"""An image's pairs with fewer inliers have no say, unless they are among those of the other one."""
MIN_NUM_MATCHES = 15  # pairs with fewer inliers are left out, as by COLMAP's mappers
MIN_SHARE = 0.5  # a pair speaks for poses when at least this share of its inliers agrees


@dataclass(frozen=True)
class VerifiedPair:
    """A verified pair of images."""

    ids: Ids
    matches: Indices  # (M, 2) features that are inliers
    geometry: pycolmap.TwoViewGeometry  # of the pair in the database


Pairs = tuple[VerifiedPair, ...]


@dataclass(frozen=True)
class RelativePose:
    """A relative pose of a pair that its inliers allow."""

    pose: Pose  # cam2_from_cam1, with a translation of length 1
    matches: Indices  # (M, 2) features that agree, with enough parallax to know their depth
    depths: tuple[Array, Array]  # of these in both cameras, twice (M,), all positive


@dataclass(frozen=True, eq=False)
class PairGraph:
    """The verified pairs of a database, of each image the strongest."""

    cache: pycolmap.DatabaseCache  # the same for pycolmap's mappers
    names: Mapping[int, str]  # by image id
    cameras: CameraById  # as in the database
    keypoints: Mapping[int, Singles]  # (N, 2) px by image id, of the images of pairs
    pairs: Pairs  # sorted by ids
    weak: Pairs  # that are not among the strongest, and in the cache only
    min_num_matches: int  # pairs with fewer inliers are left out
    _agreements: dict[Ids, tuple[VerifiedPair, bytes, float]] = field(
        default_factory=dict, init=False, repr=False
    )
    """The last agreement of each pair, and with which poses and cameras: models are looked at
    several times."""

    @classmethod
    def read(cls, path: Path, min_num_matches: int = MIN_NUM_MATCHES) -> Self:
        """Read the pairs with at least as many inliers, and all images."""
        with open_database(path) as database:
            names = {image.image_id: image.name for image in database.read_all_images()}
            cameras = cameras_of_images(database)
            verified = [
                VerifiedPair(
                    pycolmap.pair_id_to_image_pair(pair_id),
                    np.asarray(geometry.inlier_matches, np.int64),
                    geometry,
                )
                for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True)
                if len(geometry.inlier_matches) >= min_num_matches
            ]
            options = pycolmap.DatabaseCacheOptions(
                min_num_matches=min_num_matches, load_all_images=True
            )
            cache = pycolmap.DatabaseCache.create(database, options)
            keypoints = {
                image_id: np.array(database.read_keypoints(image_id)[:, :2], np.float32)
                for image_id in {image_id for pair in verified for image_id in pair.ids}
            }
        return cls(cache, names, cameras, keypoints, *_strongest(verified), min_num_matches)

    def without(self, ids: Collection[Ids]) -> Self:
        """Leave out some pairs; itself where there are none."""
        kept = [pair for pair in self.verified if pair.ids not in ids]
        return self._with(kept, self.cache) if ids else self

    @property
    def verified(self) -> Pairs:
        """All pairs, also those that have no say."""
        return self.pairs + self.weak

    @cached_property
    def most_connected(self) -> frozenset[int]:
        """The images that pairs connect with the most others."""
        parts = connected_parts(pair.ids for pair in self.pairs)
        return frozenset(parts[0] if parts else ())

    def with_cameras(self, records: Mapping[int, CameraRecord]) -> Self:
        """Give images the cameras that records say they have, of those of the graph."""
        camera_of = {name: key for key, record in records.items() for name in record.names}
        cache = _empty_copy(self.cache, camera_of)
        cameras = {i: cache.cameras[image.camera_id] for i, image in cache.images.items()}
        return replace(self._with(self.verified, cache), cameras={**self.cameras, **cameras})

    def thinned(self) -> Self:
        """Leave out tracks where the others tell the poses as well; itself where they are few.

        See :mod:`colmap_affrect.mappers.thinning`.
        """
        pairs = self.verified
        numbers = {i: len(points) for i, points in self.keypoints.items()}
        kept = matches_of_best_tracks([(pair.ids, pair.matches) for pair in pairs], numbers)
        if 2 * sum(map(np.sum, kept)) > sum(map(len, kept)):
            return self
        some = (replace(p, matches=p.matches[k]) for p, k in zip(pairs, kept, strict=True))
        return self._with(some, self.cache)

    def _with(self, verified: Iterable[VerifiedPair], cache: pycolmap.DatabaseCache) -> Self:
        """Return a graph of other pairs, with the cameras and images of a cache."""
        kept = [pair for pair in verified if len(pair.matches) >= self.min_num_matches]
        new = _empty_copy(cache, {})
        for pair in kept:
            geometry = copy.copy(pair.geometry)
            geometry.inlier_matches = pair.matches.astype(np.uint32)
            new.correspondence_graph.add_two_view_geometry(*pair.ids, geometry)
        new.correspondence_graph.finalize()
        used = {image_id for pair in kept for image_id in pair.ids}
        keypoints = {i: points for i, points in self.keypoints.items() if i in used}
        strong, weak = _strongest(kept)
        return replace(self, cache=new, keypoints=keypoints, pairs=strong, weak=weak)

    def points(self, pair: VerifiedPair, step: int = 1) -> tuple[Array, Array]:
        """Return the (M, 2) px in both images of the inliers, or of every so many."""
        columns = zip(pair.ids, pair.matches[::step].T, strict=True)
        first, second = (self.keypoints[i][rows].astype(np.float64) for i, rows in columns)
        return first, second

    def sizes(self, ids: Ids) -> tuple[Size, Size]:
        """Return the sizes of the images of a pair."""
        first, second = (self.cameras[image_id] for image_id in ids)
        return (first.width, first.height), (second.width, second.height)

    def _some_points(self, pair: VerifiedPair) -> tuple[Array, Array]:
        return self.points(pair, -(-len(pair.matches) // MAX_MATCHES))

    def pairs_inside(self, image_ids: Collection[int]) -> list[VerifiedPair]:
        """Return the pairs both of whose images are among some."""
        inside = set(image_ids)
        return [pair for pair in self.pairs if inside.issuperset(pair.ids)]

    def agreement(self, pair: VerifiedPair, poses: PoseById, cameras: CameraById) -> float:
        """Return the share of the inliers of a pair that agree with the poses of its images."""
        first, second = pair.ids
        both = cameras[first], cameras[second]
        asked = _bytes_of((*poses[first], *poses[second]), both)
        known = self._agreements.get(pair.ids)
        if known and known[0] is pair and known[1] == asked:
            return known[2]
        pose = relative_pose(poses[first], poses[second])
        share = float(_agrees(pose, both, self._some_points(pair))[0].mean())
        self._agreements[pair.ids] = pair, asked, share
        return share

    def unexplained_by(self, model: pycolmap.Reconstruction) -> list[VerifiedPair]:
        """Return the pairs that contradict a model, or have an image that it has not."""
        inside, against = set(model.reg_image_ids()), self.contradicted(model)
        return [p for p in self.pairs if p.ids in against or not inside.issuperset(p.ids)]

    def contradicted(self, model: pycolmap.Reconstruction) -> frozenset[Ids]:
        """Return the pairs most of whose inliers disagree with a model that has both images."""
        poses, cameras = poses_of(model), cameras_of(model)
        return frozenset(
            pair.ids
            for pair in self.pairs_inside(poses)
            if self.agreement(pair, poses, cameras) < MIN_SHARE
        )

    def relative_poses(
        self, pair: VerifiedPair, cameras: CameraById, random_seed: int
    ) -> list[RelativePose]:
        """Return the relative poses that explain a pair, the likeliest one first.

        That of its essential matrix, and the ones into which its homography can be decomposed:
        of a plane seen twice both solutions may have all points before both cameras, so that only
        other pairs can tell which one is right.
        """
        both = cameras[pair.ids[0]], cameras[pair.ids[1]]
        options = pycolmap.RANSACOptions(
            max_error=MAX_ERROR_PX, max_num_trials=MAX_TRIALS, random_seed=max(random_seed, 0)
        )
        # Not by a two-view geometry, which where a fundamental matrix has more inliers is that.
        found: Any = pycolmap.estimate_essential_matrix(*self._some_points(pair), *both, options)
        candidates = []
        if found and found.get("cam2_from_cam1") is not None:
            matrix = found["cam2_from_cam1"].matrix()
            candidates.append((matrix[:, :3], matrix[:, 3]))
        homography = homography_matrix(pair.geometry)
        if homography is not None:
            candidates += decomposed_homography(homography, both)
        allowed = []
        for pose in candidates:
            agrees, depths = _agrees(pose, both, self.points(pair))
            known = agrees & (depths.angles_deg > MIN_ANGLE_DEG)
            if agrees.mean() >= MIN_SHARE and known.any():
                kept = depths.first[known], depths.second[known]
                allowed.append(RelativePose(pose, pair.matches[known], kept))
        return allowed


@lru_cache(maxsize=1)
def graph_of(task: MappingTask, min_num_matches: int) -> PairGraph:
    """Return the graph of what is to be mapped; of one task it is read once."""
    return PairGraph.read(task.database_path, min_num_matches)


def poses_of(model: pycolmap.Reconstruction) -> dict[int, Pose]:
    """Return cam_from_world of the registered images by image id."""
    matrices = {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
    return {image_id: (matrix[:, :3], matrix[:, 3]) for image_id, matrix in matrices.items()}


def cameras_of(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Camera]:
    """Return the cameras of the registered images by image id."""
    return {i: model.cameras[model.images[i].camera_id] for i in model.reg_image_ids()}


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


def _agrees(pose: Pose, cameras: Cameras, points: tuple[Array, Array]) -> tuple[Bools, Depths]:
    """Return which matches agree with a relative pose, and their depths."""
    rays1, rays2 = (
        np.asarray(camera.cam_from_img(part), np.float64)
        for camera, part in zip(cameras, points, strict=True)
    )
    with np.errstate(all="ignore"):  # of cameras that are impossible
        depths = triangulated_depths(*pose, rays1, rays2)
        focal1, focal2 = (np.float64(camera.mean_focal_length()) for camera in cameras)
        # Sampson errors are of px when rays are scaled by the focal lengths.
        scale1, scale2 = (np.diag([1 / focal, 1 / focal, 1.0]) for focal in (focal1, focal2))
        fundamental = scale2 @ essential_matrix(*pose) @ scale1
        errors = sampson_errors(fundamental, focal1 * rays1, focal2 * rays2)
    sides = depths.in_front | (depths.angles_deg < MIN_ANGLE_DEG)
    tolerance = max(MAX_ERROR_PX, *(MAX_ERROR * max(c.width, c.height) for c in cameras))
    return (errors <= tolerance) & sides, depths


def _strongest(pairs: Iterable[VerifiedPair]) -> tuple[Pairs, Pairs]:
    """Return the pairs among the ``MAX_PAIRS_OF_IMAGE`` strongest of one image, and the others."""
    counts: Counter[int] = Counter()
    strong: list[VerifiedPair] = []
    weak: list[VerifiedPair] = []
    for pair in sorted(pairs, key=lambda pair: (-len(pair.matches), pair.ids)):
        is_strong = min(counts[image_id] for image_id in pair.ids) < MAX_PAIRS_OF_IMAGE
        (strong if is_strong else weak).append(pair)
        counts.update(pair.ids)
    return tuple(sorted(strong, key=lambda pair: pair.ids)), tuple(weak)


def _empty_copy(
    cache: pycolmap.DatabaseCache, camera_of: Mapping[str, int]
) -> pycolmap.DatabaseCache:
    """Return used cameras, rigs and images, without pairs; some images have another camera."""
    new = pycolmap.DatabaseCache()
    rigs = {rig.ref_sensor_id: rig for rig in cache.rigs.values()}
    frames, images = dict(cache.frames), []
    for image in map(copy.copy, cache.images.values()):
        key = camera_of.get(image.name, image.camera_id)
        if key != image.camera_id:
            image.camera_id, rig = key, rigs[cache.cameras[key].sensor_id]
            frames[image.frame_id] = pycolmap.Frame(frame_id=image.frame_id, rig_id=rig.rig_id)
            frames[image.frame_id].add_data_id(image.data_id)
        images.append(image)
    used = {frame.rig_id for frame in frames.values()}
    sensors = {sensor for rig_id in used for sensor in cache.rigs[rig_id].sensor_ids()}
    for camera in cache.cameras.values():
        if camera.sensor_id in sensors:
            new.add_camera(camera)
    for rig_id in sorted(used):
        new.add_rig(cache.rigs[rig_id])
    for frame in frames.values():
        new.add_frame(frame)
    for image in images:
        new.add_image(image)
    for prior in cache.pose_priors:
        new.add_pose_prior(prior)
    return new
