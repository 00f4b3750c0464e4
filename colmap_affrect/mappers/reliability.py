"""How sure a model is of each of its photographs.

A few numbers say what holds a photograph where it is. A logistic regression makes of them the
probability that it stands right: within 5 degrees, in rotation and in direction to at least half of
the others. ``tests/benchmarks/reliability.py`` fits it on photographs whose poses are known.
"""

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import num_long_tracks
from colmap_affrect.colmap.verification import connected_parts, lone_ties
from colmap_affrect.geometry.parallax import Size, mirrored_share, rotation_share
from colmap_affrect.mappers.adjustment import (
    EXIF_SIGMA,
    FINAL,
    NOISE_PX,
    Adjuster,
    FocalPrior,
    Settled,
    priors_of,
)
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.evidence import Evidence, cells, pair_evidence
from colmap_affrect.mappers.one_view import one_views
from colmap_affrect.mappers.pair_graph import (
    MIN_NUM_MATCHES,
    MIN_SHARE,
    Ids,
    PairGraph,
    VerifiedPair,
    cameras_of,
    graph_of,
    has_rigs,
    poses_of,
)
from colmap_affrect.mappers.tie_points import tie_points_of, tied_evidence
from colmap_affrect.parallel.executor import available_cores, map_ordered

FACTORS = 1.25, 0.8  # other focal lengths that are tried: poses are off by 5 degrees and more then
FREE_SIGMA = 1.0  # of the logarithm of a focal length that is given, where it is freed
MIN_GROWTH = 0.003  # of the cost with another focal length: less is nothing
MAX_GROWTH = 1.0  # as of known focal lengths: more makes no photograph surer
MIN_TOLD = 0.03  # of it where a model tells a focal length: of parts of photographs it is 0.15
MIN_MOVE = 0.1  # of the logarithm of a given focal length that is told from another
NUM_ITERATIONS = 100  # of a trial: three times as many change growths by 4 % at most
MAX_NUM_TRIALS = 12  # more cameras than that are tried several at once
MAX_NUM_IMAGES = 100  # of models whose focal lengths are tried; larger ones have points of many
MAX_NUM_POINTS = 2_000  # of a model, for what need not be exact
MAX_NUM_OBSERVATIONS = 3_000  # of a model of rigs, whose images hold each other
NUM_TURNED, MAX_PAIRS_TURNED = 4, 300
"""Pairs of an image, and of a model, that are compared with a camera that only turns."""
USUAL_TURNED = 0.5  # share of matches that a rotation may explain of views of any two places
MAX_ERROR = 0.003  # of a match that a rotation explains, in longer sides, as in verification
MIN_SHARE_MIRRORED = 0.5
"""Mirrored copies have nearly all keypoints in common, two thirds where the copy is smaller, other
images a tenth by chance."""
MAX_PAIRS_FOR_COPIES = 1000  # looked at, all of 45 photographs; of more some copies are missed
CHANCE_INLIERS, CHANCE_SCALE = 35.0, 10.0
"""A lone pair with as many inliers between two parts is as likely of two scenes, found by chance
among all pairs of these, as of one; each ten more make the former less likely by a factor of e."""
MIN_LOSS = 0.7  # of the log odds: what takes less from the odds is no reason to doubt
NUM_REASONS = 2  # that are said of a photograph
FOCAL_CONTRADICTED = "the given focal length does not fit"
FOCAL_UNKNOWN = "any focal length fits"
CONTRADICTIONS = (
    "its matches speak against its place", "of the matches of its pairs agree with the model",
)  # fmt: skip
COEFFICIENTS = Path(__file__).with_suffix(".json")


@dataclass(frozen=True)
class Measures:
    """What holds a photograph in a model."""

    evidence: float
    """Of its pairs, its features that two other images match, and its focal length, in nats."""
    agreement: float  # share of the inliers of its pairs that agrees with the model
    num_three: int  # points that it and two others see
    focal_growth: float
    """Part by which the cost of adjustment grows with another focal length; 1 of a known one."""
    focal_px: float  # of its camera
    fitting_px: float  # what fits, where the focal length that the user gave does not; else 0
    turned: float  # share of the matches of its strongest pairs that a mere rotation explains
    original: str  # name of the photograph that it may be a mirrored copy of, or empty
    zoom: float
    """Longest by shortest focal length of the photographs of its size, of those that only the model
    tells: parts of photographs have longer ones, and their middle is elsewhere."""
    tied: float  # what its tie points by hand say for its place, in nats
    cut: str  # the pair without which it and others, at most half of all, would be apart, or empty
    num_cut: int  # inliers of that pair


@dataclass(frozen=True)
class Term:
    """A term of the regression."""

    value: Callable[[Measures], float]  # the larger the surer
    reason: Callable[[Measures], str]  # what to say where it is small


TERMS: Mapping[str, Term] = {  # by their names in the file of coefficients
    "evidence": Term(
        lambda m: math.copysign(math.log1p(abs(m.evidence) / 3.0), m.evidence),
        lambda m: CONTRADICTIONS[0] if m.evidence < 0.0 else "few matches speak for its place",
    ),
    "agreement": Term(
        lambda m: m.agreement, lambda m: f"only {m.agreement:.0%} {CONTRADICTIONS[1]}"
    ),
    "points of three": Term(
        lambda m: math.log1p(min(m.num_three, 300)),
        lambda m: f"only {m.num_three} of its points are seen by two other photographs",
    ),
    "focal length": Term(
        lambda m: math.log(min(max(m.focal_growth, MIN_GROWTH), MAX_GROWTH)),
        lambda _: f"{FOCAL_UNKNOWN}, and the place of the camera depends on that",
    ),
    "given focal length": Term(
        lambda m: -float(m.fitting_px > 0.0),
        lambda m: f"{FOCAL_CONTRADICTED}, {m.focal_px:.0f} px: {m.fitting_px:.0f} px does",
    ),
    "parallax": Term(
        lambda m: -max(m.turned, USUAL_TURNED),
        lambda m: f"a camera that only turned explains {m.turned:.0%} of the matches: no parallax",
    ),
    "original": Term(
        lambda m: -float(bool(m.original)), lambda m: f"may be a mirrored copy of {m.original}"
    ),
    "one lens": Term(
        lambda m: -min(math.log(m.zoom), 0.5),
        lambda m: (
            f"focal lengths of photographs of its size are up to {m.zoom:.2f} times apart: "
            "some may be parts of others"
        ),
    ),
}
OF_MATCHES = {"evidence", "agreement", "points of three"}  # terms that more may mend


@dataclass(frozen=True)
class Judgement:
    """How sure a model is of a photograph."""

    probability: float  # that it stands right
    reason: str  # what speaks most against that, empty if nothing does
    gain: float = 0.0  # what more matches may add to the probability


@cache
def _coefficients() -> dict[str, Any]:
    """Return the constant, and of each term the weight and what right photographs usually have."""
    content: dict[str, Any] = json.loads(COEFFICIENTS.read_text(encoding="utf-8"))
    return content


def judge(
    mapped: MappedModel, task: MappingTask, growths: Mapping[int, float] | None = None
) -> dict[str, Judgement]:
    """Say of each photograph of a model how sure it is that it stands right, by name.

    The :func:`focal_growths` of a model with a few photographs more may be given: they are slow.
    """
    return {name: judged(measures) for name, measures in measure(mapped, task, growths).items()}


def judged(measures: Measures) -> Judgement:
    """Return the probability that a photograph stands right, and what takes most from it."""
    log_odds, left = _coefficients()["constant"] + measures.tied, 0.0
    apart = math.exp((CHANCE_INLIERS - measures.num_cut) / CHANCE_SCALE) if measures.cut else 0.0
    why = f"with others it hangs on the {measures.num_cut} inliers of {measures.cut} alone"
    losses = [(-measures.tied, "its tie points disagree"), (math.log1p(apart), why)]
    for name, fitted in _coefficients()["terms"].items():
        value = TERMS[name].value(measures)
        log_odds += fitted["weight"] * value
        losses.append((fitted["weight"] * (fitted["usual"] - value), TERMS[name].reason(measures)))
        left += max(0.0, losses[-1][0]) * (name in OF_MATCHES)
    worst = sorted((loss for loss in losses if loss[0] >= MIN_LOSS), reverse=True)
    reasons = [text for _, text in (worst or [max(losses)])[:NUM_REASONS]]
    now, then = (1.0 / (1.0 + math.exp(-odds)) for odds in (log_odds, log_odds + left))
    now /= 1.0 + apart
    return Judgement(now, "; ".join(reasons), then - now)


def measure(
    mapped: MappedModel, task: MappingTask, growths: Mapping[int, float] | None = None
) -> dict[str, Measures]:
    """Measure what holds each photograph of a model, by name."""
    model, graph = mapped.reconstruction, graph_of(task, MIN_NUM_MATCHES)
    poses, cameras = poses_of(model), cameras_of(model)
    used = {camera.camera_id: camera for camera in cameras.values()}
    priors = priors_of(used.values(), task.cameras)
    evidence = Evidence(graph, priors)
    pairs = graph.pairs_inside(poses)
    agreements = {pair.ids: graph.agreement(pair, poses, cameras) for pair in pairs}
    pairs_of: dict[int, list[VerifiedPair]] = {image_id: [] for image_id in sorted(poses)}
    for pair in pairs:
        for image_id in pair.ids:
            pairs_of[image_id].append(pair)
    one_view, same_view = one_views(graph, task.image_path), dict[int, int]()
    for first, second in sorted(one_view):
        same_view[second] = same_view.get(first, first)
    three, long = evidence.three_view_ratios(model), num_long_tracks(model, same_view)
    turned, originals = _rotation_shares(graph, pairs_of), _originals(graph, pairs, agreements)
    growths = focal_growths(model, task) if growths is None else growths
    cuts = _cuts({pair.ids: pair for pair in pairs if agreements[pair.ids] >= MIN_SHARE})
    fitting_px = _fitting_focals(model, task, priors)
    tied = tied_evidence(tie_points_of(task, graph).residuals(model))
    zooms = _zooms(camera for key, camera in used.items() if growths.get(key, 0.0) >= MIN_TOLD)
    found = {}
    for image_id, own in pairs_of.items():
        shares, weights = [agreements[p.ids] for p in own], [len(p.matches) for p in own]
        cells_of = {p.ids: evidence.num_cells(p) for p in own if p.ids not in one_view}
        nats = sum(pair_evidence(agreements[ids] * n, n) for ids, n in cells_of.items())
        rotations = [turned[p.ids] for p in own if p.ids in turned] or list(turned.values())
        name, camera = graph.names[image_id], cameras[image_id]
        focal_px = float(camera.mean_focal_length())
        found[name] = Measures(
            evidence=nats + three.get(image_id, 0.0) - priors[camera.camera_id].cost(focal_px),
            agreement=float(np.average(shares, weights=weights)) if shares else 1.0,
            num_three=long[image_id],
            focal_growth=growths.get(camera.camera_id, 1.0),
            focal_px=focal_px,
            fitting_px=fitting_px.get(camera.camera_id, 0.0),
            turned=float(np.mean(rotations)) if rotations else 0.0,
            original=graph.names[originals[image_id]] if image_id in originals else "",
            zoom=zooms.get((camera.width, camera.height), 1.0),
            tied=tied.get(image_id, 0.0),
            cut=" - ".join(graph.names[i] for i in cuts[image_id].ids) if image_id in cuts else "",
            num_cut=len(cuts[image_id].matches) if image_id in cuts else 0,
        )
    return found


def _cuts(agreeing: Mapping[Ids, VerifiedPair]) -> dict[int, VerifiedPair]:
    """Return the pair without which an image, with others, would be apart from half of all."""
    found = dict[int, VerifiedPair]()
    for ids in sorted(lone_ties(agreeing), key=lambda ids: (-len(agreeing[ids].matches), ids)):
        parts = connected_parts(agreeing.keys() - {ids})
        sides = [part for part in parts if not part.isdisjoint(ids)]
        least = min(map(len, sides))  # of several pairs that with fewest inliers counts
        found |= {i: agreeing[ids] for side in sides if len(side) == least for i in side}
    return found


def _rotation_shares(
    graph: PairGraph, pairs_of: Mapping[int, Sequence[VerifiedPair]]
) -> dict[Ids, float]:
    """Return, of the strongest pairs of images, how much a camera that turns explains."""
    strongest = {
        pair.ids: pair
        for pairs in pairs_of.values()
        for pair in sorted(pairs, key=lambda pair: -len(pair.matches))[:NUM_TURNED]
    }
    found = {}
    for pair in list(strongest.values())[:: -(-len(strongest) // MAX_PAIRS_TURNED) or 1]:
        sizes = graph.sizes(pair.ids)
        error = MAX_ERROR * max(map(max, sizes))
        found[pair.ids] = rotation_share(*graph.points(pair), sizes, error)
    return found


def _originals(
    graph: PairGraph, pairs: Sequence[VerifiedPair], agreements: Mapping[Ids, float]
) -> dict[int, int]:
    """Return the original of each mirrored copy: more matches of the others agree with it.

    Those of others that have a mirrored copy themselves do not count.
    """
    mirrored = []
    for pair in graph.pairs[:: max(1, -(-len(graph.pairs) // MAX_PAIRS_FOR_COPIES))]:
        first, second = (graph.keypoints[image_id] for image_id in pair.ids)
        if mirrored_share(first, second, graph.sizes(pair.ids)) >= MIN_SHARE_MIRRORED:
            mirrored.append(pair.ids)
    unclear = {image_id for ids in mirrored for image_id in ids}
    support: defaultdict[int, float] = defaultdict(float)
    for pair in pairs:
        for image_id, other in (pair.ids, pair.ids[::-1]):
            if other not in unclear:
                support[image_id] += agreements[pair.ids] * len(pair.matches)
    copies = {}
    for ids in mirrored:
        copy, original = sorted(ids, key=lambda image_id: support[image_id])
        copies[copy] = original
    return copies


def _zooms(cameras: Iterable[pycolmap.Camera]) -> dict[Size, float]:
    """Return the longest by the shortest focal length of cameras of each size."""
    of_size: defaultdict[Size, list[float]] = defaultdict(list)
    for camera in cameras:
        of_size[camera.width, camera.height].append(max(camera.mean_focal_length(), 1e-9))
    return {size: max(focals) / min(focals) for size, focals in of_size.items()}


def focal_growths(model: pycolmap.Reconstruction, task: MappingTask) -> dict[int, float]:
    """Return by what part the cost grows with another focal length, by id of the camera.

    A copy with some of the points is adjusted, once as it is, and with a longer and with a shorter
    focal length of each camera that nobody knows, while all else may move.
    """
    priors = priors_of(cameras_of(model).values(), task.cameras)
    known = sorted(priors.keys() & task.cameras.keys())
    unknown = [key for key in known if priors[key].sigma > EXIF_SIGMA]
    if not (unknown and _is_tried(model)):
        return {}
    fixed = frozenset(key for key in known if task.cameras[key].is_fixed)
    is_straight = all(model.cameras[key].is_undistorted() for key in unknown)
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=not is_straight)
    sparse = _with_fewer_points(model)
    cost = Adjuster(priors, NOISE_PX, refining, fixed).adjust(sparse, NUM_ITERATIONS)
    groups = [keys.tolist() for keys in np.array_split(unknown, min(len(unknown), MAX_NUM_TRIALS))]

    def growth(keys: Sequence[int]) -> float:
        held = Adjuster(priors, NOISE_PX, refining, fixed.union(keys))
        least = math.inf
        for factor in FACTORS:
            trial = pycolmap.Reconstruction(sparse)
            for camera in map(trial.camera, keys):
                camera.params[list(camera.focal_length_idxs())] *= factor
            settled = Settled(max(cost, 1e-9), 1.0 + MAX_GROWTH, NUM_ITERATIONS)
            grown = held.adjust(trial, NUM_ITERATIONS, settled=settled)
            least = min(least, grown / max(cost, 1e-9))
            if least - 1.0 <= MIN_GROWTH:
                break
        return least - 1.0

    growths = zip(groups, map_ordered(growth, groups, available_cores()), strict=True)
    return {key: value for keys, value in growths for key in keys}


def _fitting_focals(
    model: pycolmap.Reconstruction, task: MappingTask, priors: Mapping[int, FocalPrior]
) -> dict[int, float]:
    """Return the focal length that fits, by id of the cameras of which the user gave another one.

    None where freeing them lowers the cost by less than free parameters are worth: half the
    logarithm of the number of observations each, of which those in one cell of an image count once.
    """
    known = priors.keys() & task.cameras.keys()
    given = {key for key in known if "focal" in task.cameras[key].given}
    if not (given and _is_tried(model)):
        return {}
    free = {**priors} | {key: FocalPrior(priors[key].focal_px, FREE_SIGMA) for key in given}
    # A wrong focal length is made up for by distortion, where that was free.
    fixed = frozenset(key for key in given if task.cameras[key].is_fixed)
    refining = pycolmap.BundleAdjustmentOptions(refine_extra_params=not fixed)
    held, freed = _with_fewer_points(model), _with_fewer_points(model)
    before = Adjuster(priors, NOISE_PX, refining, fixed).adjust(held, FINAL)
    gain = before - Adjuster(free, NOISE_PX, refining).adjust(freed, FINAL)
    num = 0  # of cells of all images that hold observations
    for image_id, camera in cameras_of(held).items():
        seen = [p.xy for p in held.images[image_id].get_observation_points2D()]
        num += cells(camera, np.array(seen).reshape(-1, 2))
    gain *= num / max(1, held.compute_num_observations())
    if gain < 0.5 * len(given) * np.log(max(2, num)):
        return {}
    found = {key: float(freed.cameras[key].mean_focal_length()) for key in sorted(given)}
    return {k: px for k, px in found.items() if abs(math.log(px / priors[k].focal_px)) > MIN_MOVE}


def _is_tried(model: pycolmap.Reconstruction) -> bool:
    return model.num_reg_images() <= MAX_NUM_IMAGES and model.num_points3D() > 0


def _with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with every n-th point, of ``MAX_NUM_POINTS`` at most.

    A model of rigs has ``MAX_NUM_OBSERVATIONS`` at most: with the poses of the sensors as unknowns
    too, each of them takes two or three times as long.
    """
    fewer = pycolmap.Reconstruction(model)
    ids = sorted(fewer.point3D_ids())
    step = math.ceil(len(ids) / MAX_NUM_POINTS)
    if has_rigs(model):
        step = max(step, math.ceil(model.compute_num_observations() / MAX_NUM_OBSERVATIONS))
    kept = set(ids[:: max(1, step)])
    for point_id in ids:
        if point_id not in kept:
            fewer.delete_point3D(point_id)
    return fewer
