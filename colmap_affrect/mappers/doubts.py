"""What in a finished model cannot be trusted, as data.

Doubts have two degrees: what is certainly wrong leaves the model, the rest is told.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.geometry.parallax import Size, mirrored_share, rotation_share
from colmap_affrect.mappers.arrivals import MIN_THREE_VIEW_POINTS
from colmap_affrect.mappers.base import Bridge, MappedModel, MappingTask
from colmap_affrect.mappers.pair_graph import (
    PairGraph,
    VerifiedPair,
    cameras_of,
    graph_of,
    poses_of,
)
from colmap_affrect.mappers.ties import hanging_images

FOCAL_LENGTHS = (0.3, 10.0)
"""Longer sides: 120 and 6 degrees, beyond all lenses of photographs that anybody reconstructs."""
IMPOSSIBLE_FOCAL_LENGTHS = (0.1, 30.0)
"""Where it is no lens at all, but an adjustment that ran away."""

MAX_DISTORTION, IMPOSSIBLE_DISTORTION = 1.0, 10.0
"""Size of distortion coefficients; COLMAP's mappers have the first limit."""

MIN_OBSERVATIONS, TOO_FEW_OBSERVATIONS = 30, 8
"""COLMAP's own defaults ask for 30 to register an image; a pose of six unknowns and a focal length
goes through hardly more than the four points that chance brings."""

MIN_AGREEMENT, NO_AGREEMENT = 0.5, 0.25
"""Share of the inliers of an image's verified pairs. Of right images of sparse sets at least three
quarters agree."""

MAX_ERROR = 0.003
"""Of a match that a rotation explains, in longer sides: 3 px of 1000, as in verification."""

MAX_SCALE_ERROR_FRAC = 0.1
"""Of a bridged image: beyond, its distance is a guess."""

MIN_SHARE_STILL = 0.85
"""Of the matches of all pairs, each counted by the root of its inliers. A rotation explains 0.87 of
those of views from one place and more, in spite of some wrong pairs, half of those of flat ground
from a kite, and 0.83 of those of a room that a camera moves past a little."""

MIN_SHARE_MIRRORED = 0.5
"""Mirrored copies have nearly all keypoints in common, two thirds where the copy is smaller, other
images a tenth by chance."""

MAX_SUPPORT_OF_COPY = 2 / 3
"""Of the matches of the photograph itself. A mirrored copy has only what is symmetric in common
with the others, half of that at most."""

MIN_WIDE_ANGLE_DEG, MIN_SHARE_WIDE = 3.0, 0.1
"""Points under smaller angles only have no depth to speak of (COLMAP drops those below 1.5)."""

MAX_ANGLE_DEG = 90.0
"""To the next image. Surfaces are then tilted by 45 degrees in one of both at least: single matches
survive that, not most of an image; repeated and symmetric structures look so."""

NUM_CONFIRMING = 2
"""Images with enough points under smaller angles. One pair always agrees with itself; two confirm
an image, whatever else it sees from the other side."""

MIN_BASELINE_DEG = 1.0
"""Between two cameras, as their points see them. Rotations are right within a tenth of a degree at
best, which moves centres by as much: the direction between nearer ones is off by 5 degrees then."""

FOCAL_CONTRADICTED = "the given focal length does not fit"
FOCAL_DOUBT = "any focal length fits, and the place of the camera depends on that"
MIRRORED_COPY = "mirrored copy of"

MAX_PAIRS_FOR_PARALLAX, MAX_POINTS_FOR_ANGLES = 100, 2000
"""Pairs looked at, and points (of fewer than twice as many all); more change no share."""

MAX_PAIRS_FOR_COPIES = 1000  # looked at, all of 45 photographs; of more some copies are missed

Points = NDArray[np.float64]
Ids = tuple[int, int]


@dataclass(frozen=True)
class Doubts:
    """What cannot be trusted.

    Attributes:
        images: name to reason.
        model: reasons to doubt the model as a whole.
        impossible: of the images those that are certainly wrong, the worst one first.
    """

    images: Mapping[str, str] = field(default_factory=dict)
    model: tuple[str, ...] = ()
    impossible: tuple[str, ...] = ()


def find_doubts(
    model: MappedModel,
    task: MappingTask,
    loose: Collection[str] = (),
    fitting_px: Mapping[str, float] = MappingProxyType({}),
) -> Doubts:
    """Look for everything that is wrong with a model or may be.

    Args:
        model: with all its images, also of bridges.
        task: what it was made from.
        loose: images whose points do not tell the focal length.
        fitting_px: focal lengths that fit, by image, where given ones do not.
    """
    graph = graph_of(task)
    agreements: dict[Ids, float] = {}
    doubts = _image_doubts(model, graph, task, agreements, loose, fitting_px)
    images = dict(doubts.images)
    for name, why in hanging_images(model.reconstruction, graph, task, agreements).items():
        images[name] = "; ".join(filter(None, [images.get(name), why]))
    return replace(
        doubts, images=dict(sorted(images.items())), model=tuple(_model_doubts(model, graph))
    )


def without_impossible(model: MappedModel, task: MappingTask) -> MappedModel | None:
    """Take out the images that are certainly wrong, the worst one first; None if two are not left.

    The reconstruction itself is changed.
    """
    reconstruction = model.reconstruction
    graph = graph_of(task)
    taken: dict[str, str] = {}
    agreements: dict[Ids, float] = {}  # of pairs; what stays keeps its pose
    while reconstruction.num_reg_images():
        doubts = _image_doubts(model, graph, task, agreements)
        if not doubts.impossible:
            break
        name = doubts.impossible[0]
        frame_id = reconstruction.find_image_with_name(name).frame_id
        for image in reconstruction.images.values():  # of a rig, all that were taken at once
            if image.frame_id == frame_id and image.has_pose:
                why = f"taken with {name}: {doubts.images[name]}"
                taken[image.name] = doubts.images.get(image.name, why)
        reconstruction.deregister_frame(frame_id)
    if reconstruction.num_reg_images() < 2:
        return None
    return replace(model, taken_out={**model.taken_out, **taken})


def _image_doubts(
    model: MappedModel,
    graph: PairGraph,
    task: MappingTask,
    agreements: dict[Ids, float],
    loose: Collection[str] = (),
    fitting_px: Mapping[str, float] = MappingProxyType({}),
) -> Doubts:
    """Judge the images one by one; ``agreements`` of pairs are taken if known, and added to."""
    reconstruction = model.reconstruction
    registered = set(reconstruction.reg_image_ids())
    bridges = {name: bridge for bridge in model.bridges for name in bridge.names}
    poses, cameras = poses_of(reconstruction), cameras_of(reconstruction)
    given = {key for key, record in task.cameras.items() if record.is_fixed}
    totals = {image_id: np.zeros(2) for image_id in registered}
    agreeing_of: dict[Ids, float] = {}
    for pair in graph.pairs_inside(registered):
        if pair.ids not in agreements:
            agreements[pair.ids] = graph.agreement(pair, poses, cameras)
        count = len(pair.matches)
        agreeing_of[pair.ids] = count * agreements[pair.ids]
        for image_id in pair.ids:
            totals[image_id] += agreeing_of[pair.ids], count
    originals = _originals(graph, agreeing_of)
    reasons: dict[str, str] = {}
    angles, near = _angles_deg(reconstruction), _images_nearby(reconstruction)
    impossible: list[tuple[float, int, str]] = []
    for image_id in registered:
        image = reconstruction.images[image_id]
        agreeing, total = totals[image_id].tolist()
        agreement = agreeing / total if total else 1.0
        found = [
            *([] if image.camera_id in given else _camera_doubts(cameras[image_id])),
            *_support_doubts(image.num_points3D, agreement),
            *_angle_doubts(reconstruction, image, [nearest for nearest, _ in angles[image_id]]),
            *_place_doubts(near[image_id], len(registered) - 1),
            *_copy_doubts(graph.names.get(originals.get(image_id, -1))),
            *_bridge_doubts(bridges.get(image.name)),
            *_focal_doubts(
                task.cameras.get(image.camera_id),
                fitting_px.get(image.name),
                is_loose=image.name in loose,
            ),
        ]
        if found:
            reasons[image.name] = "; ".join(text for text, _ in found)
        if any(wrong for _, wrong in found):
            impossible.append((agreement, image.num_points3D, image.name))
    worst = tuple(name for _, _, name in sorted(impossible))
    return Doubts(dict(sorted(reasons.items())), impossible=worst)


def _camera_doubts(camera: pycolmap.Camera) -> Iterator[tuple[str, bool]]:
    """Doubt cameras that no lens has; each reason comes with whether it is certain."""
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    if not FOCAL_LENGTHS[0] <= focal <= FOCAL_LENGTHS[1]:
        low, high = IMPOSSIBLE_FOCAL_LENGTHS
        view_deg = 2.0 * np.rad2deg(np.arctan(0.5 / focal))
        text = f"the focal length is {camera.mean_focal_length():.0f} px, a view of "
        yield f"{text}{view_deg:.3g} degrees", not low <= focal <= high
    elif camera.has_bogus_params(*IMPOSSIBLE_FOCAL_LENGTHS, MAX_DISTORTION):
        wrong = camera.has_bogus_params(*IMPOSSIBLE_FOCAL_LENGTHS, IMPOSSIBLE_DISTORTION)
        yield "the distortion of the lens is extreme", wrong


def _support_doubts(num: int, agreement: float) -> Iterator[tuple[str, bool]]:
    """Doubt what few points hold, and what pairs disagree with."""
    if num < MIN_OBSERVATIONS:
        yield f"held by only {num} points", num < TOO_FEW_OBSERVATIONS
    if agreement < MIN_AGREEMENT:
        text = f"only {agreement:.0%} of the matches of verified pairs agree with the pose"
        yield text, agreement < NO_AGREEMENT


def _angle_doubts(
    model: pycolmap.Reconstruction, image: pycolmap.Image, angles: Sequence[float]
) -> Iterator[tuple[str, bool]]:
    """Doubt images whose points other images see from the other side, unless two confirm it."""
    if len(angles) < TOO_FEW_OBSERVATIONS or np.median(angles) <= MAX_ANGLE_DEG:
        return
    if _num_confirming(model, image) < NUM_CONFIRMING:
        apart = f"{np.median(angles):.0f} degrees apart"
        yield f"most points are seen from directions {apart}", False


def _num_confirming(model: pycolmap.Reconstruction, image: pycolmap.Image) -> int:
    """Return how many images see enough points of an image from not too different directions."""
    own, counts = image.projection_center(), Counter[int]()
    for observed in image.get_observation_points2D():
        point = model.point3D(observed.point3D_id)
        ray = own - point.xyz
        for other in {element.image_id for element in point.track.elements} - {image.image_id}:
            other_ray = model.images[other].projection_center() - point.xyz
            counts[other] += bool(ray @ other_ray > 0.0)  # less than MAX_ANGLE_DEG apart
    return sum(count >= MIN_OBSERVATIONS for count in counts.values())


def _place_doubts(nearby: Sequence[str], num_others: int) -> Iterator[tuple[str, bool]]:
    """Doubt images of which most others are too near to know the direction to them."""
    if 2 * len(nearby) >= num_others > 1:
        names = ", ".join(nearby[:2]) + (", ..." if len(nearby) > 2 else "")
        place = f"taken from nearly the same place as {names}"
        yield f"{place}: the directions between them are uncertain", False


def _copy_doubts(original: str | None) -> Iterator[tuple[str, bool]]:
    if original:
        yield f"{MIRRORED_COPY} {original}", True


def _bridge_doubts(bridge: Bridge | None) -> Iterator[tuple[str, bool]]:
    if bridge and not bridge.scale_error_frac <= MAX_SCALE_ERROR_FRAC:
        error = f"{bridge.scale_error_frac:.0%}"
        yield f"bridged by {bridge.pair[0]} at a distance known to +-{error} only", False
    elif bridge and 2 * bridge.num_agreeing < bridge.num_ratios:
        some = f"{bridge.num_agreeing} of {bridge.num_ratios}"
        yield f"bridged by {bridge.pair[0]}, where only {some} depths agree on the scale", False


def _focal_doubts(
    record: CameraRecord | None, fitting_px: float | None, *, is_loose: bool
) -> Iterator[tuple[str, bool]]:
    if record and fitting_px:
        given = f"{FOCAL_CONTRADICTED}, {record.focal_px:.0f} px"
        yield f"{given}: {fitting_px:.0f} px does", False
    if is_loose:
        yield FOCAL_DOUBT, False


def _model_doubts(model: MappedModel, graph: PairGraph) -> Iterator[str]:
    """Judge the model as a whole."""
    reconstruction = model.reconstruction
    num_images, num_given = reconstruction.num_reg_images(), len(graph.names)
    if num_images < 3 <= num_given:
        yield f"only {num_images} of {num_given} photographs, which no third one confirms"
    angles = [wide for of_image in _angles_deg(reconstruction).values() for _, wide in of_image]
    registered = set(reconstruction.reg_image_ids())
    some = _some(graph.pairs_inside(registered), MAX_PAIRS_FOR_PARALLAX)
    if _are_still(some, graph):
        yield (
            "no parallax: the camera only turned or zoomed, or the photographs are copies or "
            "crops of one another"
        )
    elif np.mean(np.array(angles or [0.0]) >= MIN_WIDE_ANGLE_DEG) < MIN_SHARE_WIDE:
        yield f"hardly any parallax: rays are less than {MIN_WIDE_ANGLE_DEG:g} degrees apart"
    for first, second in _mirrored_pairs(graph):
        if {first, second} <= registered:
            names = " and ".join(sorted((graph.names[first], graph.names[second])))
            yield f"{names} are mirrored copies of one photograph"
            break
    if num_images > 2 and not model.bridges:
        num_ties = sum(p.track.length() > 2 for p in reconstruction.points3D.values())
        if num_ties < MIN_THREE_VIEW_POINTS:
            yield f"only {num_ties} points are seen by three photographs"


def _are_still(pairs: Sequence[VerifiedPair], graph: PairGraph) -> bool:
    """Tell whether a camera that only turned, or zoomed, explains nearly all matches of pairs."""
    left = (1.0 - MIN_SHARE_STILL) * sum(pair.weight for pair in pairs)
    for pair in pairs:
        sizes = _sizes(graph, pair.ids)
        share = rotation_share(*graph.points(pair), sizes, MAX_ERROR * max(map(max, sizes)))
        left -= (1.0 - share) * pair.weight
        if left < 0.0:
            return False
    return bool(pairs)


def _sizes(graph: PairGraph, ids: Ids) -> tuple[Size, Size]:
    first, second = (graph.cameras[image_id] for image_id in ids)
    return (first.width, first.height), (second.width, second.height)


def _some(pairs: Sequence[VerifiedPair], most: int) -> Sequence[VerifiedPair]:
    return pairs[:: max(1, -(-len(pairs) // most))]


@lru_cache(maxsize=1)
def _mirrored_pairs(graph: PairGraph) -> tuple[Ids, ...]:
    """Return the pairs whose images are mirrored copies of one another."""

    def share(first: int, second: int) -> float:
        keypoints = graph.keypoints[first], graph.keypoints[second]
        return mirrored_share(*keypoints, _sizes(graph, (first, second)))

    looked_at = _some(graph.pairs, MAX_PAIRS_FOR_COPIES)
    return tuple(pair.ids for pair in looked_at if share(*pair.ids) >= MIN_SHARE_MIRRORED)


def _originals(graph: PairGraph, agreeing_of: Mapping[Ids, float]) -> dict[int, int]:
    """Return the original of each mirrored copy, where the other images tell which one it is.

    No model holds both, and the photograph is the one that more of their matches agree with. Images
    that have a mirrored copy themselves do not count: they may be copies that hold each other.
    """
    mirrored = _mirrored_pairs(graph)
    unclear = {image_id for ids in mirrored for image_id in ids}
    support: defaultdict[int, float] = defaultdict(float)
    for (first, second), agreeing in agreeing_of.items():
        support[first] += 0.0 if second in unclear else agreeing
        support[second] += 0.0 if first in unclear else agreeing
    found = {}
    for ids in mirrored:
        copy, original = sorted(ids, key=lambda image_id: support[image_id])
        if ids in agreeing_of and support[copy] < MAX_SUPPORT_OF_COPY * support[original]:
            found[copy] = original
    return found


def _images_nearby(model: pycolmap.Reconstruction) -> dict[int, list[str]]:
    """Return, of each image, the others whose centres its points hardly tell from its own."""
    ids = sorted(model.reg_image_ids())
    centers = np.array([model.images[i].projection_center() for i in ids])
    found = {}
    for i, center in zip(ids, centers, strict=True):
        least = np.tan(np.deg2rad(MIN_BASELINE_DEG)) * _median_distance(model, model.images[i])
        near = np.flatnonzero(np.linalg.norm(centers - center, axis=1) < least)
        found[i] = [model.images[ids[k]].name for k in near if ids[k] != i]
    return found


def _median_distance(model: pycolmap.Reconstruction, image: pycolmap.Image) -> float:
    """Return how far the points of an image are from it; 0 without any."""
    points = image.get_observation_points2D()
    if not points:
        return 0.0
    places = np.array([model.point3D(point.point3D_id).xyz for point in points])
    return float(np.median(np.linalg.norm(places - image.projection_center(), axis=1)))


def _angles_deg(model: pycolmap.Reconstruction) -> dict[int, list[tuple[float, float]]]:
    """Return, of some points of each image, the angles to the next and to the farthest ray."""
    ids = sorted(model.point3D_ids())
    found: dict[int, list[tuple[float, float]]] = {i: [] for i in model.reg_image_ids()}
    centers = {i: model.images[i].projection_center() for i in found}
    seen: dict[int, list[tuple[Points, list[int]]]] = defaultdict(list)
    for point_id in ids[:: max(1, len(ids) // MAX_POINTS_FOR_ANGLES)]:
        point = model.point3D(point_id)
        seen_by = sorted({element.image_id for element in point.track.elements})
        seen[len(seen_by)].append((point.xyz, seen_by))
    for num, tracks in seen.items():  # those of one length at once
        rays = np.array([[centers[i] - xyz for i in seen_by] for xyz, seen_by in tracks])
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        angles = np.rad2deg(np.arccos(np.clip(rays @ np.swapaxes(rays, 1, 2), -1.0, 1.0)))
        same = np.eye(num, dtype=bool)
        nearest = np.where(same, 180.0, angles).min(axis=2).ravel().tolist()
        farthest = np.where(same, 0.0, angles).max(axis=2).ravel().tolist()
        images = [image_id for _, seen_by in tracks for image_id in seen_by]
        for image_id, *both in zip(images, nearest, farthest, strict=True):
            found[image_id].append((both[0], both[1]))
    return found
