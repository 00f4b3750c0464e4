"""The vote of verified pairs over cameras that nobody knows, and what it changes in a database."""

import sqlite3
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import cameras_of_images, open_database, working_seal
from colmap_affrect.colmap.two_views import PLANAR
from colmap_affrect.colmap.verification import NUM_CACHED_IMAGES, ExtractedPx, of_pair
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.focal_evidence import MatchedPair, log_evidence
from colmap_affrect.geometry.focal_vote import (
    FOCALS,
    Ballot,
    FocalEstimate,
    ballot,
    count,
    evidence_for_one,
)
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import SILENT, Advance, Progress

MIN_NUM_INLIERS = 20  # of a pair that votes: few more than a fundamental matrix needs say nothing
MATCH_ERROR_PX = 0.5  # least error of matches, px of the photograph as features were extracted
MAX_PAIRS_OF_IMAGE = 4  # the strongest pairs of each image vote
MAX_PAIRS_OF_DECISION = 24  # pairs that are asked whether images of one size share a camera
MIN_LOG_EVIDENCE = 3.0  # for one camera against many, or against a focal length: twenty to one
MAX_BEND = 0.05  # longer sides; votes allow for as much distortion (DISTORTION_SIGMA)
MIN_NUM_PAIRS = 5  # that are asked whether they contradict what is known
FOCAL_STEP = 4  # every 4th candidate is tried then
UNDECIDED = "pairs do not tell whether images of this size share a camera"
MAX_SPREAD = 1.4  # ratio of the ends of an interval that counts as knowledge


@dataclass(frozen=True)
class VotingPair:
    """A verified pair that votes: ids of its cameras and images, and its inliers."""

    cameras: tuple[int, int]
    images: tuple[int, int]
    matched: MatchedPair


@dataclass
class CameraVote:
    """Decides on cameras by the votes of pairs."""

    records: Mapping[int, CameraRecord]  # of all cameras by id
    pairs: Sequence[VotingPair]  # that vote
    may_share: bool  # whether cameras of images of one size may turn out to be the same
    tied: dict[int, int] = field(default_factory=dict)  # of one focal length, by their first
    decisions: dict[int, str] = field(default_factory=dict)  # about cameras of one size

    def decide(self, progress: Progress = SILENT) -> dict[int, CameraRecord]:
        """Return the records as they are after the vote; progress counts the pairs.

        Cameras that turn out to be the same are one record, of the first of them.
        """
        unknown = [key for key, record in self.records.items() if record.source == "guess"]
        self.tied = {key: key for key in unknown}
        if self.may_share:
            sizes: dict[tuple[int, ...], list[int]] = defaultdict(list)
            for key in unknown:
                if "principal-point" not in self.records[key].given:
                    # some may have been turned by 90 degrees
                    sizes[tuple(sorted(self.records[key].size))].append(key)
            for same_size in sizes.values():
                if len(same_size) > 1:
                    self._decide_sharing(same_size)
        known = {
            key: record.focal_px / max(record.size)
            for key, record in self.records.items()
            if key not in self.tied
        }
        with progress.stage("cameras", len(self.pairs), "pairs") as advance:
            ballots = _ballots(self.pairs, self.tied, known, advance)
        num_votes = Counter(camera for item in ballots for camera in set(item.cameras))
        outcome = count(ballots, sorted(set(self.tied.values())))
        records = {key: record for key, record in self.records.items() if key in known}
        same: dict[tuple[tuple[int, int], int], list[int]] = defaultdict(list)
        for key in unknown:
            same[self.records[key].size, self.tied[key]].append(key)
        for (_, first), keys in sorted(same.items()):
            records[keys[0]] = self._record(keys, outcome.estimates[first], num_votes[first])
        return records

    def _decide_sharing(self, same_size: Sequence[int]) -> None:
        difference = log_evidence_for_sharing(self.pairs, same_size) or 0.0
        if difference >= MIN_LOG_EVIDENCE:
            self.tied |= dict.fromkeys(same_size, min(same_size))
            text = f"one camera for {len(same_size)} images of one size, by the votes of pairs"
        elif -difference >= MIN_LOG_EVIDENCE:
            text = "a camera for each of these images of one size, by the votes of pairs"
        else:
            text = UNDECIDED
        self.decisions |= dict.fromkeys(same_size, text)

    def _record(self, keys: Sequence[int], estimate: FocalEstimate, num_votes: int) -> CameraRecord:
        """Return the record of cameras of one size that turned out to be the same."""
        first = self.records[keys[0]]
        longer = max(first.size)
        is_known = num_votes > 0 and estimate.spread <= MAX_SPREAD
        texts = [self.decisions.get(keys[0], ""), first.why if not is_known else ""]
        if not num_votes:
            texts.append("no pair can tell its focal length")
        elif not is_known:
            texts.append("its pairs do not tell the focal length well")
        return replace(
            first,
            names=tuple(sorted(name for key in keys for name in self.records[key].names)),
            source="pairs" if is_known else "guess",
            focal_px=estimate.focal * longer,
            low_px=estimate.low * longer,
            high_px=estimate.high * longer,
            why="; ".join(text for text in texts if text),
            may_be_shared=UNDECIDED in texts,
        )


def log_evidence_for_sharing(pairs: Sequence[VotingPair], cameras: Collection[int]) -> float | None:
    """Return how much more likely one camera is than many, as a logarithm; None without pairs.

    Those come strongest first; pairs of other cameras than these ids are left out.
    """
    inside = [pair for pair in pairs if set(pair.cameras) <= set(cameras)]
    ballots = _ballots(inside[:MAX_PAIRS_OF_DECISION], {}, {})
    if not ballots:
        return None
    asked = sorted({camera for item in ballots for camera in item.cameras})
    return evidence_for_one(ballots) - count(ballots, asked, resample=False).log_evidence


def _ballots(
    pairs: Sequence[VotingPair],
    tied: Mapping[int, int],
    known: Mapping[int, float],
    advance: Advance | None = None,
) -> list[Ballot]:
    def ask(pair: VotingPair) -> Ballot | None:
        first, second = (tied.get(camera, camera) for camera in pair.cameras)
        return ballot(pair.matched, (first, second), known)

    ballots = []
    for found in map_ordered(ask, pairs, available_cores()):
        ballots += [found] if found else []
        if advance:
            advance(1)
    return ballots


def contradicted_cameras(
    pairs: Sequence[VotingPair], focals: Mapping[int, float]
) -> frozenset[int]:
    """Return the cameras whose focal length (longer sides) half of their pairs or more contradict.

    None unless most of the strongest pairs do, and there are some: single pairs may be wrong
    themselves.
    """

    def ask(some: Sequence[VotingPair]) -> list[bool]:
        return list(map_ordered(lambda pair: _contradicts(pair, focals), some, available_cores()))

    asked = [pair for pair in pairs if focals.keys() >= set(pair.cameras)]
    verdicts = ask(asked[:MAX_PAIRS_OF_DECISION])
    if len(asked) < MIN_NUM_PAIRS or 2 * sum(verdicts) <= len(verdicts):
        return frozenset()
    of_camera: dict[int, list[bool]] = defaultdict(list)
    for pair, verdict in zip(asked, verdicts + ask(asked[MAX_PAIRS_OF_DECISION:]), strict=True):
        for camera in set(pair.cameras):
            of_camera[camera].append(verdict)
    return frozenset(key for key, own in of_camera.items() if 2 * sum(own) >= len(own))


def _contradicts(pair: VotingPair, focals: Mapping[int, float]) -> bool:
    """Tell whether some focal lengths are twenty times as likely as those that are known."""
    firsts = seconds = FOCALS[::FOCAL_STEP]
    if pair.cameras[0] != pair.cameras[1]:
        firsts, seconds = (side.ravel() for side in np.meshgrid(firsts, seconds))
    known = [focals[camera] for camera in pair.cameras]
    evidence = log_evidence(pair.matched, np.append(known[0], firsts), np.append(known[1], seconds))
    return bool(evidence.max() - evidence[0] >= MIN_LOG_EVIDENCE)


def needs_vote(records: Mapping[int, CameraRecord]) -> bool:
    """Tell whether there are cameras that nobody knows and no vote was held for."""
    return any(item.source == "guess" and item.low_px is None for item in records.values())


def forget_votes(path: Path, records: Mapping[int, CameraRecord]) -> dict[int, CameraRecord]:
    """Return records as before a vote, and let pairs of cameras that one decided go unverified."""
    voted = {key for key, record in records.items() if record.source == "pairs"}
    if voted:
        with open_database(path) as database, pycolmap.DatabaseTransaction(database):
            for camera in database.read_all_cameras():
                if camera.camera_id in voted:
                    camera.has_prior_focal_length = False
                    database.update_camera(camera)
            _delete_geometries(database, voted)
    return {
        key: replace(record, source="guess", low_px=None, high_px=None, why="", may_be_shared=False)
        if record.low_px is not None
        else record
        for key, record in records.items()
    }


def voting_pairs(
    path: Path,
    unknown: Collection[int],
    extracted_px: ExtractedPx,
    silent: Collection[tuple[str, str]] = (),
    *,
    only_straight: bool = False,
) -> list[VotingPair]:
    """Read the verified pairs that can say something about cameras, strongest first.

    ``unknown`` are the ids of the cameras that are asked for, ``silent`` pairs of image names that
    are not asked. With ``only_straight`` pairs of lenses that bend lines much are left out.
    """
    with open_database(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        left_out = set(map(frozenset, silent))
        cameras = cameras_of_images(database)
        pair_ids, geometries = database.read_two_view_geometries()
        ids = map(pycolmap.pair_id_to_image_pair, pair_ids)
        useful = [
            (pair, geometry)
            for pair, geometry in zip(ids, geometries, strict=True)
            if len(geometry.inlier_matches) >= MIN_NUM_INLIERS
            and geometry.F is not None
            and geometry.config not in PLANAR
            and any(cameras[image_id].camera_id in unknown for image_id in pair)
            and frozenset(names[image_id] for image_id in pair) not in left_out
            and not (only_straight and any(bends_much(cameras[image_id]) for image_id in pair))
        ]
        useful.sort(key=lambda item: (-len(item[1].inlier_matches), item[0]))
        chosen, num = [], Counter[int]()
        for pair, geometry in useful:
            if min(num[image_id] for image_id in pair) < MAX_PAIRS_OF_IMAGE:
                chosen.append((pair, geometry))
                num.update(pair)

        @lru_cache(NUM_CACHED_IMAGES)
        def keypoints(image_id: int) -> Array:
            return np.asarray(database.read_keypoints(image_id), np.float64)[:, :2]

        return [
            _voting_pair(
                pair,
                tuple(cameras[image_id] for image_id in pair),
                tuple(keypoints(image_id) for image_id in pair),
                geometry,
                of_pair(extracted_px, pair),
            )
            for pair, geometry in chosen
        ]


def bends_much(camera: pycolmap.Camera) -> bool:
    """Tell whether a corner is much off where a lens without distortion has it."""
    corner = np.array([camera.width, camera.height], np.float64)
    center = [camera.principal_point_x, camera.principal_point_y]
    ray, focal = camera.cam_from_img(corner), camera.mean_focal_length()
    if ray is None:
        return True
    return bool(np.linalg.norm(ray * focal - (corner - center)) > MAX_BEND * corner.max())


def _voting_pair(
    images: tuple[int, int],
    cameras: Sequence[pycolmap.Camera],
    keypoints: Sequence[Array],
    geometry: pycolmap.TwoViewGeometry,
    extracted_px: int | None,
) -> VotingPair:
    matches = np.asarray(geometry.inlier_matches, np.int64)
    to_px, points, errors = [], [], []
    for side, camera in enumerate(cameras):
        longer = max(camera.width, camera.height)
        x, y = camera.principal_point_x, camera.principal_point_y
        points.append((keypoints[side][matches[:, side]] - [x, y]) / longer)
        to_px.append(np.array([[longer, 0.0, x], [0.0, longer, y], [0.0, 0.0, 1.0]]))
        errors.append(MATCH_ERROR_PX / min(longer, extracted_px or longer))
    fundamental = to_px[1].T @ np.asarray(geometry.F, np.float64) @ to_px[0]
    matched = MatchedPair.of(
        points[0], points[1], fundamental / np.linalg.norm(fundamental), float(np.mean(errors))
    )
    return VotingPair((cameras[0].camera_id, cameras[1].camera_id), images, matched)


def apply_records(path: Path, records: Mapping[int, CameraRecord]) -> None:
    """Make the cameras of a database what the records say, and let pairs go unverified by that.

    There is a record for each camera that stays; of its images some may have had another one.
    """
    camera_of = {name: key for key, record in records.items() for name in record.names}
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        new_priors = set()
        for camera in database.read_all_cameras():
            record = records.get(camera.camera_id)
            if record and record.low_px is not None:
                for index in camera.focal_length_idxs():
                    camera.params[index] = record.focal_px
                if record.source == "pairs" and not camera.has_prior_focal_length:
                    camera.has_prior_focal_length = True
                    new_priors.add(camera.camera_id)
                database.update_camera(camera)
        _move_images(database, camera_of)
        _delete_geometries(database, new_priors)
    _delete_unused_cameras(path)


def _move_images(database: pycolmap.Database, camera_of: Mapping[str, int]) -> None:
    """Give images, by name, another camera that is there."""
    rigs = {rig.ref_sensor_id: rig.rig_id for rig in database.read_all_rigs()}
    frames = {frame.frame_id: frame for frame in database.read_all_frames()}
    for image in database.read_all_images():
        key = camera_of.get(image.name, image.camera_id)
        if key != image.camera_id:
            _move(database, image, key, frames[image.frame_id], rigs)


def _move(
    database: pycolmap.Database,
    image: pycolmap.Image,
    camera_id: int,
    frame: pycolmap.Frame,
    rigs: Mapping[pycolmap.sensor_t, int],
) -> None:
    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
    moved = pycolmap.Frame(frame_id=frame.frame_id, rig_id=rigs[sensor])
    moved.add_data_id(pycolmap.data_t(sensor, image.image_id))
    database.update_frame(moved)
    image.camera_id = camera_id
    database.update_image(image)


def _delete_geometries(database: pycolmap.Database, cameras: Collection[int]) -> None:
    images = {image.image_id: image.camera_id for image in database.read_all_images()}
    for pair_id in database.read_two_view_geometry_num_inliers()[0]:
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        if any(images[image_id] in cameras for image_id in pair):
            database.delete_two_view_geometry(*pair)


def _delete_unused_cameras(path: Path) -> None:
    """Delete cameras and rigs without images, which pycolmap cannot; models would have them all.

    A rig with images keeps the cameras that have none.
    """
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM rigs WHERE rig_id NOT IN (SELECT rig_id FROM frames)")
        connection.execute("DELETE FROM rig_sensors WHERE rig_id NOT IN (SELECT rig_id FROM rigs)")
        connection.execute(
            "DELETE FROM cameras WHERE camera_id NOT IN (SELECT camera_id FROM images UNION "
            "SELECT ref_sensor_id FROM rigs WHERE ref_sensor_type = :camera UNION "
            "SELECT sensor_id FROM rig_sensors WHERE sensor_type = :camera)",
            {"camera": int(pycolmap.SensorType.CAMERA)},
        )
        if connection.total_changes:
            working_seal(path).unlink(missing_ok=True)
