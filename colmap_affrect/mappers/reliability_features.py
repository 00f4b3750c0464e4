"""What the confidence in a photograph is computed from, one function for each feature.

See :mod:`colmap_affrect.mappers.reliability`.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.connections import connected_parts, lone_ties
from colmap_affrect.colmap.model_files import num_long_tracks
from colmap_affrect.geometry.arrays import sampling_step
from colmap_affrect.geometry.parallax import Size, mirrored_share, pure_rotation_ratio
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.camera_priors import (
    MIN_FOCAL_PX,
    camera_priors,
    is_off_center,
    with_distortion_of,
)
from colmap_affrect.mappers.direction_uncertainty import direction_sigmas_deg
from colmap_affrect.mappers.focal_observability import focal_growths, freed_focals
from colmap_affrect.mappers.model_score import ModelScorer, pair_log_ratio
from colmap_affrect.mappers.other_cameras import (
    NO_OTHER_CAMERAS,
    NO_OTHER_POSE,
    OtherPose,
)
from colmap_affrect.mappers.pair_graph import (
    MAX_ERROR,
    MIN_NUM_MATCHES,
    MIN_SHARE,
    Ids,
    PairGraph,
    VerifiedPair,
    cameras_of,
    graph_of,
    poses_of,
    used_cameras,
)
from colmap_affrect.mappers.same_viewpoint import same_viewpoint_pairs, viewpoints
from colmap_affrect.mappers.tie_points import (
    TiePoints,
    tie_point_log_odds,
    tie_points_of,
)

# Of pairs, by their graph: models are scored many times
KNOWN_ROTATION_RATIOS: WeakKeyDictionary[PairGraph, dict[Ids, float]] = (
    WeakKeyDictionary()
)
# The terms of the regression are fitted to features that are measured with these numbers, which
# are judged on the benchmark scenes; after a change fit again.
MIN_TOLD = 0.03
"""Growth of the cost with another focal length, from which on a model tells the focal length: of
parts of photographs it is 0.15."""
# Strongest pairs of a frame that are compared with a pure rotation; resource
NUM_ROTATION_PAIRS = 4
# The same of a frame that several pairs tie to another one, as those of rigs; resource
NUM_RIG_ROTATION_PAIRS = 2
MAX_ROTATION_PAIRS = 300  # the same of a model, to save time; resource
MIN_MIRRORED_SHARE = 0.5
"""Mirrored copies have nearly all keypoints in common, two thirds where the copy is smaller, other
images a tenth by chance; measured."""
# Looked at, all of 45 photographs; of more some copies are missed; resource
MAX_MIRRORED_PAIRS = 1000


@dataclass(frozen=True)
class ReliabilityFeatures:
    """What speaks for and against the pose of a photograph."""

    log_likelihood_ratio: float
    """Of right against wrong poses, by its pairs, its features that two other images match, and the
    prior of its camera."""
    agreement: float  # share of the inliers of its pairs that agrees with the model
    num_three_view_points: int  # points that it and two others see
    focal_growth: float
    """Part by which the cost of adjustment grows with another focal length; 1 of a known one."""
    focal_px: float  # of its camera
    fitting_focal_px: float
    """What fits, where the focal length that the user gave does not; else 0."""
    pure_rotation_ratio: float
    """Share of the matches without parallax, of the strongest pairs of its frame with others."""
    mirrored_original: str
    """Name of the photograph that it may be a mirrored copy of, or empty."""
    focal_spread: float
    """Longest by shortest focal length of the photographs of its size, of those that only the model
    tells: parts of photographs have longer ones, and their middle is elsewhere."""
    tie_point_log_odds: float  # of a right pose, by its tie points
    cut_pair: str
    """The pair without which it and others, at most half of all, would be apart, or empty."""
    num_cut_pair_inliers: int  # of that pair
    direction_sigma_deg: float = 0.0
    """Deviation that the directions of translation to at least half of the others do not exceed."""
    axis_turn_deg: float = 0.0
    """How far its rotations to others change with free principal points, where points leave open
    whether constant ones are right."""
    with_free_focals: OtherPose = NO_OTHER_POSE
    """Its pose where given focal lengths are free."""
    with_other_cameras: OtherPose = NO_OTHER_POSE
    """Its pose where images that share a camera by assumption have their own, or the reverse."""


class _ModelContext:
    """What the features of all photographs of a model have in common."""

    def __init__(self, mapped: MappedModel, task: MappingTask) -> None:
        self.task = task
        self.model = mapped.reconstruction
        self.graph = graph_of(task, MIN_NUM_MATCHES)
        self.poses = poses_of(self.model)
        self.cameras = cameras_of(self.model)
        self.used_cameras = used_cameras(self.model)
        used = self.used_cameras.values()
        # Those of the model have moved from the focal lengths that EXIF says.
        before = {camera.camera_id: camera for camera in self.graph.cameras.values()}
        known = [before.get(camera.camera_id, camera) for camera in used]
        priors = camera_priors(known, task.cameras, task.lines)
        self.priors = with_distortion_of(priors, used)
        self.scorer = ModelScorer(self.graph, self.priors)
        self.pairs = self.graph.pairs_inside(self.poses)
        self.agreements: dict[Ids, float] = {}
        self.pairs_of: dict[int, list[VerifiedPair]] = {}
        for image_id in sorted(self.poses):
            self.pairs_of[image_id] = []
        for pair in self.pairs:
            agreement = self.graph.agreement(pair, self.poses, self.cameras)
            self.agreements[pair.ids] = agreement
            for image_id in pair.ids:
                self.pairs_of[image_id].append(pair)
        self.pairs_of_frames = self._pairs_of_frames()
        same_viewpoint = same_viewpoint_pairs(self.graph, task.image_path)
        self.viewpoint_of = viewpoints(same_viewpoint)

    def frame_of(self, image_id: int) -> int:
        """Return the frame of an image: all that a rig took at once is one."""
        return self.model.images[image_id].frame_id

    def is_of_one_viewpoint(self, pair: VerifiedPair) -> bool:
        """Tell whether both images of a pair were taken from the same viewpoint."""
        first, second = pair.ids
        viewpoint1 = self.viewpoint_of.get(first, first)
        viewpoint2 = self.viewpoint_of.get(second, second)
        return viewpoint1 == viewpoint2

    def _pairs_of_frames(self) -> dict[int, list[VerifiedPair]]:
        """Return the pairs of each frame with others: poses inside a rig determine each other."""
        found: dict[int, list[VerifiedPair]] = {}
        for image_id in self.pairs_of:
            found[self.frame_of(image_id)] = []
        for image_id, pairs in self.pairs_of.items():
            for pair in pairs:
                first, second = pair.ids
                if self.frame_of(first) != self.frame_of(second):
                    found[self.frame_of(image_id)].append(pair)
        return found


def features_of(
    mapped: MappedModel, task: MappingTask, growths: Mapping[int, float] | None = None
) -> dict[str, ReliabilityFeatures]:
    """Compute the features of each photograph of a model.

    Args:
        mapped: The model.
        task: What it was made from.
        growths: The :func:`focal_growths` of the model, or of one with a few photographs more;
            they are computed if they are not given.

    Returns:
        The features by image name.
    """
    context = _ModelContext(mapped, task)
    if growths is None:
        growths = focal_growths(context.model, task)
    track_log_ratios = context.scorer.track_log_ratios(
        context.model, context.viewpoint_of
    )
    num_three_view_points = num_long_tracks(context.model, context.viewpoint_of)
    rotation_ratios = _rotation_ratios(context)
    originals = _mirrored_originals(context)
    freed = freed_focals(context.model, task, context.priors)
    other_cameras = mapped.other_cameras or NO_OTHER_CAMERAS
    focal_spreads = _focal_spreads(context, growths)
    tie_points = tie_points_of(task, context.graph)
    log_odds = tie_point_log_odds(tie_points.residuals(context.model))
    cut_pairs = _cut_pairs(context)
    directions_deg = _direction_sigmas_deg(context, tie_points)
    names = context.graph.names
    found = {}
    for image_id in context.pairs_of:
        camera = context.cameras[image_id]
        key = camera.camera_id
        log_ratio = _pair_log_ratio(context, image_id)
        log_ratio += track_log_ratios.get(image_id, 0.0)
        cut_pair = cut_pairs.get(image_id)
        original = originals.get(image_id)
        found[names[image_id]] = ReliabilityFeatures(
            log_likelihood_ratio=log_ratio - context.priors[key].cost_of(camera),
            agreement=_agreeing_share(context, image_id),
            num_three_view_points=num_three_view_points[image_id],
            focal_growth=growths.get(key, 1.0),
            focal_px=float(camera.mean_focal_length()),
            fitting_focal_px=freed.fitting_px.get(key, 0.0),
            pure_rotation_ratio=_pure_rotation_ratio(
                context, image_id, rotation_ratios
            ),
            mirrored_original="" if original is None else names[original],
            focal_spread=focal_spreads.get((camera.width, camera.height), 1.0),
            tie_point_log_odds=log_odds.get(image_id, 0.0),
            cut_pair=" - ".join(names[i] for i in cut_pair.ids) if cut_pair else "",
            num_cut_pair_inliers=len(cut_pair.matches) if cut_pair else 0,
            direction_sigma_deg=directions_deg.get(image_id, 0.0),
            axis_turn_deg=mapped.axis_turns_deg.get(names[image_id], 0.0),
            with_free_focals=freed.other.pose_of(names[image_id]),
            with_other_cameras=other_cameras.pose_of(names[image_id]),
        )
    return found


def _pair_log_ratio(context: _ModelContext, image_id: int) -> float:
    """Return the log-likelihood ratio of an image by its pairs from other viewpoints."""
    total = 0.0
    for pair in context.pairs_of[image_id]:
        if not context.is_of_one_viewpoint(pair):
            num = context.scorer.num_cells(pair)
            total += pair_log_ratio(context.agreements[pair.ids] * num, num)
    return total


def _agreeing_share(context: _ModelContext, image_id: int) -> float:
    """Return the share of the inliers of an image's pairs that agree with the model.

    Pairs from one viewpoint say nothing of the pose; an image without others has a share of 1.
    """
    shares = list[float]()
    weights = list[int]()
    for pair in context.pairs_of[image_id]:
        if not context.is_of_one_viewpoint(pair):
            shares.append(context.agreements[pair.ids])
            weights.append(len(pair.matches))
    return float(np.average(shares, weights=weights)) if shares else 1.0


def _rotation_ratios(context: _ModelContext) -> dict[Ids, float]:
    """Return the share of matches that a rotation explains, of the strongest pairs of frames."""
    strongest = dict[Ids, VerifiedPair]()
    for pairs in context.pairs_of_frames.values():
        for pair in _strongest_to_frames(context, pairs):
            strongest[pair.ids] = pair
    found = {}
    known = KNOWN_ROTATION_RATIOS.setdefault(context.graph, {})
    step = sampling_step(len(strongest), MAX_ROTATION_PAIRS)
    for pair in list(strongest.values())[::step]:
        if pair.ids not in known:
            known[pair.ids] = _rotation_ratio(context.graph, pair)
        found[pair.ids] = known[pair.ids]
    return found


def _rotation_ratio(graph: PairGraph, pair: VerifiedPair) -> float:
    """Return the share of matches that a rotation explains, which no model changes."""
    sizes = graph.sizes(pair.ids)
    max_error_px = MAX_ERROR * max(map(max, sizes))
    points1, points2 = graph.points(pair)
    return pure_rotation_ratio(points1, points2, sizes, max_error_px)


def _strongest_to_frames(
    context: _ModelContext, pairs: Sequence[VerifiedPair]
) -> list[VerifiedPair]:
    """Return the strongest pairs of a frame with others.

    Rigs take several images at once: all pairs of two frames tell the same of how they moved.

    Args:
        context: Of the model.
        pairs: Of the frame.
    """
    found = dict[frozenset[int], VerifiedPair]()
    is_of_rig = False
    for pair in sorted(pairs, key=lambda pair: -len(pair.matches)):
        frames = frozenset(map(context.frame_of, pair.ids))
        is_of_rig = is_of_rig or frames in found
        found.setdefault(frames, pair)
    most = NUM_RIG_ROTATION_PAIRS if is_of_rig else NUM_ROTATION_PAIRS
    return list(found.values())[:most]


def _pure_rotation_ratio(
    context: _ModelContext, image_id: int, ratios: Mapping[Ids, float]
) -> float:
    """Return the mean ratio of the pairs of an image's frame, of all pairs where it has none."""
    pairs = context.pairs_of_frames[context.frame_of(image_id)]
    ratios_of_frame = [ratios[pair.ids] for pair in pairs if pair.ids in ratios]
    known = ratios_of_frame or list(ratios.values())
    return float(np.mean(known)) if known else 0.0


def _direction_sigmas_deg(
    context: _ModelContext, tie_points: TiePoints
) -> dict[int, float]:
    """Return how uncertain the directions from each image to others are, with its priors."""
    recorded = context.priors.keys() & context.task.cameras.keys()
    records = context.task.cameras
    constant = frozenset(key for key in recorded if records[key].is_all_given)
    refining = pycolmap.BundleAdjustmentOptions()
    adjuster = Adjuster(
        priors=context.priors,
        noise_px=NOISE_PX,
        refining=refining,
        constant=constant,
        tie_points=tie_points,
    )
    return direction_sigmas_deg(context.model, adjuster)


def _mirrored_originals(context: _ModelContext) -> dict[int, int]:
    """Return the original of each mirrored copy: more matches of the others agree with it.

    Those of others that have a mirrored copy themselves do not count.
    """
    mirrored = _mirrored_pairs(context)
    unclear = {image_id for ids in mirrored for image_id in ids}
    support: defaultdict[int, float] = defaultdict(float)
    for pair in context.pairs:
        first, second = pair.ids
        num_agreeing = context.agreements[pair.ids] * len(pair.matches)
        if second not in unclear:
            support[first] += num_agreeing
        if first not in unclear:
            support[second] += num_agreeing
    originals = {}
    for ids in mirrored:
        copy, original = sorted(ids, key=lambda image_id: support[image_id])
        originals[copy] = original
    return originals


def _mirrored_pairs(context: _ModelContext) -> list[Ids]:
    graph = context.graph
    found = list[Ids]()
    step = sampling_step(len(graph.pairs), MAX_MIRRORED_PAIRS)
    for pair in graph.pairs[::step]:
        first, second = pair.ids
        if _is_of_rig(graph, first) and _is_of_rig(graph, second):
            continue  # prints and scans are mirrored, what a rig takes is not
        share = mirrored_share(
            graph.keypoints[first], graph.keypoints[second], graph.sizes(pair.ids)
        )
        if share >= MIN_MIRRORED_SHARE:
            found.append(pair.ids)
    return found


def _is_of_rig(graph: PairGraph, image_id: int) -> bool:
    """Tell whether a rig of several sensors took an image."""
    frame = graph.cache.frames[graph.cache.images[image_id].frame_id]
    return bool(graph.cache.rigs[frame.rig_id].num_sensors() > 1)


def _focal_spreads(
    context: _ModelContext, growths: Mapping[int, float]
) -> dict[Size, float]:
    """Return the longest by the shortest focal length that the model tells, by image size.

    Of cameras whose principal point was freed, parts of photographs have nothing wrong.
    """
    focals_px: defaultdict[Size, list[float]] = defaultdict(list)
    for key, camera in context.used_cameras.items():
        if growths.get(key, 0.0) >= MIN_TOLD and not is_off_center(camera):
            focal_px = max(camera.mean_focal_length(), MIN_FOCAL_PX)
            focals_px[camera.width, camera.height].append(focal_px)
    return {size: max(of_size) / min(of_size) for size, of_size in focals_px.items()}


def _cut_pairs(context: _ModelContext) -> dict[int, VerifiedPair]:
    """Return the pair without which an image, with others, would be apart from half of all.

    Of several such pairs that with fewest inliers counts.
    """
    agreeing = dict[Ids, VerifiedPair]()
    for pair in context.pairs:
        if context.agreements[pair.ids] >= MIN_SHARE:
            agreeing[pair.ids] = pair
    found = dict[int, VerifiedPair]()
    ranked = sorted(
        lone_ties(agreeing), key=lambda ids: (-len(agreeing[ids].matches), ids)
    )
    for ids in ranked:
        for image_id in _smaller_sides(agreeing.keys() - {ids}, ids):
            found[image_id] = agreeing[ids]
    return found


def _smaller_sides(others: Collection[Ids], ids: Ids) -> set[int]:
    """Return the images of the smaller component beside a pair, of both if they are equal."""
    components = connected_parts(others)
    sides = [component for component in components if not component.isdisjoint(ids)]
    smallest = min(map(len, sides))
    found = set[int]()
    for side in sides:
        if len(side) == smallest:
            found |= side
    return found
