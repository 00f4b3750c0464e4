"""How sure a model is of each of its photographs.

A few numbers say what holds a photograph where it is; a logistic regression makes a probability of
them that it stands right, within 5 degrees (rotation, and direction to most others). Its
coefficients are fitted on photographs of known poses (``tests/benchmarks/reliability.py``).
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import num_long_tracks
from colmap_affrect.geometry.parallax import Size, mirrored_share, rotation_share
from colmap_affrect.mappers.adjustment import (
    EXIF_SIGMA,
    FINAL,
    NOISE_PX,
    Adjuster,
    FocalPrior,
    priors_of,
)
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.evidence import Evidence, cells, pair_evidence
from colmap_affrect.mappers.pair_graph import (
    MIN_SHARE,
    Ids,
    PairGraph,
    VerifiedPair,
    cameras_of,
    graph_of,
    poses_of,
)

FACTORS = 1.25, 0.8  # other focal lengths that are tried: poses are off by 5 degrees and more then
FREE_SIGMA = 1.0  # of the logarithm of a focal length that is given, where it is freed
MIN_MOVE = 0.1  # of the logarithm of a focal length that is told from another
MAX_NUM_TRIALS = 12  # more cameras than that are tried several at once
MAX_NUM_IMAGES = 100  # of models whose focal lengths are tried; larger ones have points of many
MAX_NUM_POINTS = 2_000  # of a model, for what need not be exact
NUM_TURNED = 4  # pairs of an image that are compared with a camera that only turns
MAX_ERROR = 0.003  # of a match that a rotation explains, in longer sides, as in verification
MIN_SHARE_MIRRORED = 0.5
"""Mirrored copies have nearly all keypoints in common, two thirds where the copy is smaller, other
images a tenth by chance."""
MAX_PAIRS_FOR_COPIES = 1000  # looked at, all of 45 photographs; of more some copies are missed


@dataclass(frozen=True)
class Measures:
    """What holds a photograph in a model.

    Attributes:
        evidence: of its pairs and of its features in three images, in nats.
        agreement: share of the inliers of its pairs that agrees with the model.
        second: the same of the pair of which second most does; 0 with one pair.
    """

    evidence: float
    three: float
    agreement: float
    best: float
    second: float
    num_pairs: int
    num_points: int
    num_long: int
    num_cells: int
    angle_deg: float
    nearest_deg: float
    focal_growth: float
    focal_nats: float
    focal_sigmas: float
    moved: float
    rotation: float
    rotation_min: float
    single: float
    bridged: float
    scale_error: float
    copy: float
    twin: float
    near: float
    num_images: int
    distortion: float
    focal: float


def measure(mapped: MappedModel, task: MappingTask) -> dict[str, Measures]:
    """Measure what holds each photograph of a model, by name."""
    model, graph = mapped.reconstruction, graph_of(task)
    ids = sorted(model.reg_image_ids())
    poses, cameras = poses_of(model), cameras_of(model)
    used = {camera.camera_id: camera for camera in cameras.values()}
    priors = priors_of(used.values(), task.cameras)
    priors |= priors_of((c for c in graph.cameras.values() if c.camera_id in used), task.cameras)
    evidence = Evidence(graph, priors)
    three = evidence.three_view_ratios(model)
    pairs = graph.pairs_inside(ids)
    agreement = {pair.ids: graph.agreement(pair, poses, cameras) for pair in pairs}
    of_image: dict[int, list[VerifiedPair]] = {i: [] for i in ids}
    for pair in pairs:
        for image_id in pair.ids:
            of_image[image_id].append(pair)
    turned = _rotation_shares(graph, of_image)
    single = _single(model, graph, pairs, agreement)
    long, angles = num_long_tracks(model), _angles_deg(model)
    growth, in_cells = focal_growth(model, task), cells_of(model)
    freed = freed_focals(model, task)
    mirrored = _mirrored(graph)
    support: defaultdict[int, float] = defaultdict(float)
    unclear = {i for both in mirrored for i in both}
    for pair in pairs:
        for image_id, other in (pair.ids, pair.ids[::-1]):
            support[image_id] += 0 if other in unclear else agreement[pair.ids] * len(pair.matches)
    copies = {min(both, key=lambda i: support[i]) for both in mirrored}
    bridges = {name: bridge for bridge in mapped.bridges for name in bridge.names}
    centers = {i: model.images[i].projection_center() for i in ids}
    found = {}
    for image_id in ids:
        image, camera = model.images[image_id], cameras[image_id]
        own = of_image[image_id]
        weights = [len(pair.matches) for pair in own]
        shares = [agreement[pair.ids] for pair in own]
        best = sorted(shares, reverse=True)
        prior = priors[camera.camera_id]
        bridge = bridges.get(image.name)
        rel, nats = growth.get(camera.camera_id, (np.inf, np.inf))
        depth = _median_distance(model, image)
        others = [i for i in ids if i != image_id]
        near = [
            np.linalg.norm(centers[i] - centers[image_id]) < np.tan(np.deg2rad(1.0)) * depth
            for i in others
        ]
        wide, nearest = angles.get(image_id, (0.0, 0.0))
        f = camera.mean_focal_length()
        extra = [camera.params[i] for i in camera.extra_params_idxs()]
        found[image.name] = Measures(
            evidence=sum(
                pair_evidence(agreement[p.ids] * n, n) for p in own if (n := evidence.num_cells(p))
            )
            + three.get(image_id, 0.0),
            three=three.get(image_id, 0.0),
            agreement=float(np.average(shares, weights=weights)) if shares else 1.0,
            best=best[0] if best else 0.0,
            second=best[1] if len(best) > 1 else 0.0,
            num_pairs=len(own),
            num_points=image.num_points3D,
            num_long=long[image_id],
            num_cells=in_cells[image_id],
            angle_deg=wide,
            nearest_deg=nearest,
            focal_growth=rel,
            focal_nats=nats,
            focal_sigmas=float(np.sqrt(2.0 * prior.cost(camera.mean_focal_length()))),
            moved=abs(np.log(freed.get(camera.camera_id, f) / f)),
            rotation=float(np.mean([turned[p.ids] for p in own if p.ids in turned] or [0.0])),
            rotation_min=float(min([turned[p.ids] for p in own if p.ids in turned] or [0.0])),
            single=single.get(image_id, 0.0),
            bridged=float(bridge is not None),
            scale_error=bridge.scale_error_frac if bridge else 0.0,
            copy=float(image_id in copies),
            twin=float(image_id in unclear),
            near=float(np.mean(near)) if near else 0.0,
            num_images=len(ids),
            distortion=max(map(abs, extra), default=0.0),
            focal=camera.mean_focal_length() / max(camera.width, camera.height),
        )
    return found


def _rotation_shares(
    graph: PairGraph, of_image: Mapping[int, Sequence[VerifiedPair]]
) -> dict[Ids, float]:
    """Return, of the strongest pairs of each image, how much a camera that turns explains."""
    found = {}
    for pairs in of_image.values():
        for pair in sorted(pairs, key=lambda pair: -len(pair.matches))[:NUM_TURNED]:
            if pair.ids not in found:
                sizes = _sizes(graph, pair.ids)
                error = MAX_ERROR * max(map(max, sizes))
                found[pair.ids] = rotation_share(*graph.points(pair), sizes, error)
    return found


def _sizes(graph: PairGraph, ids: Ids) -> tuple[Size, Size]:
    first, second = (graph.cameras[image_id] for image_id in ids)
    return (first.width, first.height), (second.width, second.height)


def _mirrored(graph: PairGraph) -> list[Ids]:
    found = []
    for pair in graph.pairs[:: max(1, -(-len(graph.pairs) // MAX_PAIRS_FOR_COPIES))]:
        keypoints = (graph.keypoints[image_id] for image_id in pair.ids)
        if mirrored_share(*keypoints, _sizes(graph, pair.ids)) >= MIN_SHARE_MIRRORED:
            found.append(pair.ids)
    return found


def _single(
    model: pycolmap.Reconstruction,
    graph: PairGraph,
    pairs: Sequence[VerifiedPair],
    agreement: Mapping[Ids, float],
) -> dict[int, float]:
    """Return the images that one pair alone connects with most others; how much of it disagrees."""
    frame_of = {i: model.images[i].frame_id for i in model.reg_image_ids()}
    frames = nx.Graph()
    frames.add_nodes_from(frame_of.values())
    worst: dict[frozenset[int], float] = {}
    strong = {pair.ids: pair for pair in pairs}
    for first, second in (*strong, *(p.ids for p in graph.weak)):
        if first not in frame_of or second not in frame_of or frame_of[first] == frame_of[second]:
            continue
        share = agreement.get((first, second), 1.0)
        if share >= MIN_SHARE:
            edge = frozenset((frame_of[first], frame_of[second]))
            worst[edge] = max(share, worst.get(edge, 0.0))
            frames.add_edge(*edge)
    found: dict[int, float] = {}
    for edge in list(nx.bridges(frames)):
        frames.remove_edge(*edge)
        parts = sorted((nx.node_connected_component(frames, node) for node in edge), key=len)
        smaller = parts if len(parts[0]) == len(parts[1]) else parts[:1]
        for image_id, frame_id in frame_of.items():
            if any(frame_id in part for part in smaller):
                share = 2.0 - worst[frozenset(edge)]
                found[image_id] = max(share, found.get(image_id, 0.0))
        frames.add_edge(*edge)
    parts = sorted(nx.connected_components(frames), key=len)
    for part in parts[:-1]:
        for image_id, frame_id in frame_of.items():
            if frame_id in part:
                found[image_id] = 2.0
    return found


def _median_distance(model: pycolmap.Reconstruction, image: pycolmap.Image) -> float:
    points = image.get_observation_points2D()
    if not points:
        return 0.0
    places = np.array([model.point3D(point.point3D_id).xyz for point in points])
    return float(np.median(np.linalg.norm(places - image.projection_center(), axis=1)))


def _angles_deg(model: pycolmap.Reconstruction) -> dict[int, tuple[float, float]]:
    """Return, of each image, the median angles to the farthest and to the nearest other ray."""
    ids = sorted(model.point3D_ids())
    found: dict[int, list[tuple[float, float]]] = {i: [] for i in model.reg_image_ids()}
    centers = {i: model.images[i].projection_center() for i in found}
    seen: dict[int, list[tuple[NDArray[np.float64], list[int]]]] = defaultdict(list)
    for point_id in ids[:: max(1, len(ids) // MAX_NUM_POINTS)]:
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
        for image_id, *both in zip(images, farthest, nearest, strict=True):
            found[image_id].append((both[0], both[1]))
    return {i: tuple(np.median(both, axis=0).tolist()) for i, both in found.items() if both}


def focal_growth(
    model: pycolmap.Reconstruction, task: MappingTask
) -> dict[int, tuple[float, float]]:
    """Return how much the cost of adjustment grows with another focal length, by camera.

    A copy with some of the points is adjusted, once as it is, and with a longer and with a shorter
    focal length of each camera that nobody knows, while all else may move.
    """
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    used = {image.camera_id for image in images}
    priors = priors_of((model.cameras[key] for key in sorted(used)), task.cameras)
    unknown = [key for key, p in priors.items() if p.sigma > EXIF_SIGMA and key in task.cameras]
    if not unknown or len(images) > MAX_NUM_IMAGES or model.num_points3D() == 0:
        return {}
    fixed = frozenset(key for key in used & task.cameras.keys() if task.cameras[key].is_fixed)
    is_straight = all(model.cameras[key].is_undistorted() for key in unknown)
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=not is_straight)
    sparse = _with_fewer_points(model)
    cost = Adjuster(priors, NOISE_PX, refining, fixed).adjust(sparse, FINAL)
    share = num_cells(sparse) / max(1, sparse.compute_num_observations())
    found = {}
    for keys in np.array_split(unknown, min(len(unknown), MAX_NUM_TRIALS)):
        held = Adjuster(priors, NOISE_PX, refining, fixed.union(keys.tolist()))
        least = min(held.adjust(_scaled(sparse, keys, factor), FINAL) for factor in FACTORS)
        found |= dict.fromkeys(
            keys.tolist(), (least / max(cost, 1e-9) - 1.0, share * (least - cost))
        )
    return found


def freed_focals(model: pycolmap.Reconstruction, task: MappingTask) -> dict[int, float]:
    """Return the focal lengths that fit best, by id of the cameras whose user gave another one.

    None where freeing them lowers the cost by less than free parameters are worth.
    """
    used = {model.images[image_id].camera_id for image_id in model.reg_image_ids()}
    given = {key for key in used & task.cameras.keys() if "focal" in task.cameras[key].given}
    if not given or model.num_reg_images() > MAX_NUM_IMAGES or model.num_points3D() == 0:
        return {}
    priors = priors_of(model.cameras.values(), task.cameras)
    free = priors | {key: FocalPrior(priors[key].focal_px, FREE_SIGMA) for key in given}
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=False)
    held, freed = _with_fewer_points(model), _with_fewer_points(model)
    before = Adjuster(priors, NOISE_PX, refining, frozenset(given)).adjust(held, FINAL)
    gain = before - Adjuster(free, NOISE_PX, refining).adjust(freed, FINAL)
    cells = num_cells(held)
    gain *= cells / max(1, held.compute_num_observations())
    if gain < 0.5 * len(given) * np.log(max(2, cells)):
        return {}
    return {key: freed.cameras[key].mean_focal_length() for key in given}


def num_cells(model: pycolmap.Reconstruction) -> int:
    """Return how many cells of the images of a model hold observations."""
    return sum(cells_of(model).values())


def cells_of(model: pycolmap.Reconstruction) -> dict[int, int]:
    """Return how many cells of each registered image hold observations."""
    found = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        points = np.array([p.xy for p in image.get_observation_points2D()]).reshape(-1, 2)
        found[image_id] = cells(model.cameras[image.camera_id], points)
    return found


def _with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with every n-th point, of ``MAX_NUM_POINTS`` at most."""
    fewer = pycolmap.Reconstruction(model)
    ids = sorted(fewer.point3D_ids())
    kept = set(ids[:: max(1, -(-len(ids) // MAX_NUM_POINTS))])
    for point_id in ids:
        if point_id not in kept:
            fewer.delete_point3D(point_id)
    return fewer


def _scaled(
    model: pycolmap.Reconstruction, cameras: Collection[int], factor: float
) -> pycolmap.Reconstruction:
    """Return a copy with other focal lengths of some cameras."""
    copy = pycolmap.Reconstruction(model)
    for key in cameras:
        camera = copy.cameras[key]
        for index in camera.focal_length_idxs():
            camera.params[index] *= factor
    return copy
