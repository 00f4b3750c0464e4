"""Models whose images are scored: one for each place, without images that are surely wrong."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.focal_observability import focal_growths
from colmap_affrect.mappers.given_principal_points import contradicted_principal_points
from colmap_affrect.mappers.other_motions import share_moving_as_modelled
from colmap_affrect.mappers.pair_graph import (
    MIN_NUM_MATCHES,
    MIN_SHARE,
    cameras_of,
    graph_of,
    poses_of,
)
from colmap_affrect.mappers.reliability import (
    MAX_ERROR_DEG,
    NUM_REASONS,
    Confidence,
    score_images,
    share_within_limit,
)
from colmap_affrect.mappers.small_motions import small_motion
from colmap_affrect.mappers.surer_apart import surer_apart
from colmap_affrect.mappers.surroundings import cut_into_places, known_places
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import SURE, PrincipalPointContradiction

CHANGE_SIGMA_DEG = 1.7
"""Of the angle between poses by what moves and by the rest: what poses by the rest were off in a
made-up set, the median (measured)."""
NEGLIGIBLE = 0.01  # chance of wrong poses by a small motion, which is not told; numeric
OF_WRONG_CAMERAS = {"focal_contradicted", "principal_point_contradicted"}
MIN_PROBABILITY = 0.05
"""Images leave their model below this probability: nineteen of twenty such poses are wrong
(theory)."""


@dataclass
class ScoredModel:
    """A model and the confidence in its images."""

    mapped: MappedModel
    # Of its images, by name
    confidences: dict[str, Confidence] = field(default_factory=dict)
    # Of images that it has lost
    taken_out: dict[str, Confidence] = field(default_factory=dict)
    contradictions: Sequence[PrincipalPointContradiction] = ()

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of images and points."""
        model = self.mapped.reconstruction
        return model.num_reg_images(), model.num_points3D()


def scored_places(mapped: MappedModel, task: MappingTask) -> list[ScoredModel]:
    """Return a model for each place that a model holds, the largest first, with all scored.

    A model that is extended stays whole, what a person has tied by hand, and rigs.
    """
    graph = graph_of(task, MIN_NUM_MATCHES)
    if task.extend or task.tie_points or graph.has_rigs:
        whole = _without_wrong_images(mapped, task)
        _doubt_motion(whole, task)
        return [whole]
    places = known_places(mapped, graph)
    places = surer_apart(mapped, places, lambda one: _probabilities(one, task))
    largest, *others = cut_into_places(mapped, places)
    scored = _without_wrong_images(largest, task)
    for name, doubt in mapped.why_apart.items():
        scored.taken_out[name] = Confidence(0.0, (doubt,))
    found = [scored]
    for other in others:
        names = [graph.names[i] for i in sorted(other.reconstruction.reg_image_ids())]
        for name in names:
            scored.taken_out[name] = Confidence(0.0, (Doubt(places.why),))
        if len(names) > 1:
            found.append(_without_wrong_images(other, task))
    for model in found:
        _doubt_motion(model, task)
        for image_id in places.collages:
            _doubt(model, graph.names[image_id], 0.5, Doubt("two_places"))
        for image_id, share in places.unclear.items():
            _doubt(model, graph.names[image_id], share, Doubt("other_surroundings"))
    return found


def _probabilities(mapped: MappedModel, task: MappingTask) -> dict[int, float]:
    """Return the probability of each image that stays in a model, which is changed."""
    confidences = _without_wrong_images(mapped, task).confidences
    found = dict[int, float]()
    for name, one in confidences.items():
        image_id = mapped.reconstruction.find_image_with_name(name).image_id
        found[image_id] = one.probability
    return found


def _doubt_motion(model: ScoredModel, task: MappingTask) -> None:
    """Doubt a model where something moves in another way: that may be the scene as well."""
    graph = graph_of(task, MIN_NUM_MATCHES)
    found = share_moving_as_modelled(model.mapped.reconstruction, graph)
    share = min(found, model.mapped.share_as_modelled)
    if share < 1.0:
        doubt = Doubt("something_moves", {"percent": math.floor(100.0 * share)})
        for name in list(model.confidences):
            _doubt(model, name, share, doubt)
        return
    if _has_wrong_cameras(model):
        return  # which make points fit badly, too
    small = small_motion(model.mapped.reconstruction)
    if small is None or not small.changes_deg:
        return
    # A model follows one of both as a whole: where they are farthest apart they are told best.
    farther = (max(small.changes_deg.values()) - MAX_ERROR_DEG) / CHANGE_SIGMA_DEG
    off = 0.5 * math.erfc(-farther / math.sqrt(2.0))  # where the rest is the scene
    wrong = (1.0 - small.share) * off
    if wrong > NEGLIGIBLE:
        doubt = Doubt("something_moves", {"percent": math.floor(100.0 * small.share)})
        for name in list(model.confidences):
            _doubt(model, name, 1.0 - wrong, doubt)


def _has_wrong_cameras(model: ScoredModel) -> bool:
    """Tell whether the points of a model contradict what is given of cameras."""
    for one in (*model.confidences.values(), *model.taken_out.values()):
        if any(doubt.code in OF_WRONG_CAMERAS for doubt in one.reasons):
            return True
    return bool(model.contradictions)


def _doubt_given_principal_points(scored: ScoredModel, task: MappingTask) -> None:
    """Doubt rotations that hang on given principal points which the points contradict."""
    model = scored.mapped.reconstruction
    scored.contradictions = contradicted_principal_points(model, task)
    for one in scored.contradictions:
        for name, turn_deg in one.turns_deg.items():
            values = {
                "given_x_px": one.given_px[0],
                "given_y_px": one.given_px[1],
                "fitting_x_px": one.fitting_px[0],
                "fitting_y_px": one.fitting_px[1],
                "turn_deg": turn_deg,
            }
            doubt = Doubt("principal_point_contradicted", {**values})
            _doubt(scored, name, share_within_limit(turn_deg), doubt)


def _doubt(model: ScoredModel, name: str, share: float, doubt: Doubt) -> None:
    """Multiply the probability of an image, if it is there.

    Args:
        model: Is changed.
        name: Of the image.
        share: Factor of the probability.
        doubt: The reason.
    """
    known = model.confidences.get(name)
    if known:
        others = known.reasons if known.probability < SURE else ()  # of sure ones: none
        reasons = (doubt, *others)[:NUM_REASONS]
        model.confidences[name] = replace(
            known, probability=share * known.probability, reasons=reasons
        )


def _without_wrong_images(mapped: MappedModel, task: MappingTask) -> ScoredModel:
    """Take out the images that are surely wrong, the worst one first, and score all.

    The reconstruction itself is changed; nothing is left of it with fewer than two images. Of a rig
    all images leave that were taken at once. Those of a model that is extended stay.
    """
    model = mapped.reconstruction
    scored = ScoredModel(mapped)
    growths = focal_growths(model, task)
    is_stale = False  # growths are of a model with a few images more
    confidences = dict[str, Confidence]()
    while model.num_reg_images() > 1:
        confidences = _best_of_frames(model, score_images(mapped, task, growths))
        worst = min(confidences, key=lambda name: confidences[name].of_evidence)
        is_wrong = confidences[worst].of_evidence < MIN_PROBABILITY and not task.extend
        if is_wrong:
            for name in _deregister(model, worst):
                scored.taken_out[name] = confidences[worst]
            is_stale = True
        elif is_stale:
            growths = focal_growths(model, task)
            is_stale = False
        else:
            scored.confidences = no_surer_than_ties(confidences, mapped, task)
            _doubt_given_principal_points(scored, task)
            return scored
    for name, one in confidences.items():  # one image alone has no pose
        scored.taken_out.setdefault(name, one)
    return scored


def no_surer_than_ties(
    confidences: Mapping[str, Confidence], mapped: MappedModel, task: MappingTask
) -> dict[str, Confidence]:
    """Return confidences that are at most those of what images hang on.

    An image hangs on the surest image that an agreeing pair ties it to. Where it was bridged, and
    that one, too, it hangs on what that hangs on: what counts is the way to an image that was not
    bridged whose least sure image is surest. Images that nothing ties stay as they are.

    Args:
        confidences: By image name.
        mapped: The model.
        task: What it was made from.
    """
    if task.extend and not mapped.bridges:
        return dict(confidences)  # nothing is known of pairs among the images it had
    partners = _agreeing_partners(mapped, task)
    found = _bridged_no_surer(confidences, mapped.bridges.keys(), partners)
    capped = dict(found)
    for name in found.keys() - mapped.bridges.keys():
        others = sorted(partners[name] & found.keys())
        if others:
            surest = max(others, key=lambda other: found[other].probability)
            capped[name] = _no_surer_than(found[name], surest, found[surest])
    return capped


def _bridged_no_surer(
    confidences: Mapping[str, Confidence],
    bridged: Set[str],
    partners: Mapping[str, Set[str]],
) -> dict[str, Confidence]:
    """Return confidences of which those of bridged images are at most what they hang on.

    Args:
        confidences: By image name.
        bridged: Names of the bridged images.
        partners: Names of the images that agreeing pairs tie each one to.
    """
    left = sorted(bridged & confidences.keys())
    found = {name: one for name, one in confidences.items() if name not in left}
    while left:
        best: tuple[float, str, str] | None = None
        for name in left:
            for other in sorted(partners[name] & found.keys()):
                probability = found[other].probability
                if best is None or probability > best[0]:
                    best = probability, name, other
        if best is None:
            break
        _, name, other = best
        found[name] = _no_surer_than(confidences[name], other, found[other])
        left.remove(name)
    return {name: found.get(name, one) for name, one in confidences.items()}


def _no_surer_than(one: Confidence, other_name: str, other: Confidence) -> Confidence:
    """Return the confidence in an image that hangs on another one, whose name the reason says."""
    if other.probability >= one.probability:
        return one
    percent = math.floor(100.0 * other.probability)
    doubt = Doubt("hangs_on", {"other": other_name, "percent": percent})
    reasons = (doubt, *one.reasons)[:NUM_REASONS]
    return replace(one, probability=other.probability, reasons=reasons)


def _agreeing_partners(
    mapped: MappedModel, task: MappingTask
) -> defaultdict[str, set[str]]:
    """Return the images that pairs which agree with a model tie each of its images to, by name."""
    graph = graph_of(task, MIN_NUM_MATCHES)
    poses = poses_of(mapped.reconstruction)
    cameras = cameras_of(mapped.reconstruction)
    partners = defaultdict[str, set[str]](set)
    for pair in graph.pairs_inside(poses):
        if graph.agreement(pair, poses, cameras) >= MIN_SHARE:
            first, second = (graph.names[image_id] for image_id in pair.ids)
            partners[first].add(second)
            partners[second].add(first)
    return partners


def _deregister(model: pycolmap.Reconstruction, name: str) -> list[str]:
    """Deregister an image with all that a rig took with it; return their names."""
    frame_id = model.find_image_with_name(name).frame_id
    names = list[str]()
    for image in model.images.values():
        if image.frame_id == frame_id and image.has_pose:
            names.append(image.name)
    model.deregister_frame(frame_id)
    return names


def _best_of_frames(
    model: pycolmap.Reconstruction, confidences: Mapping[str, Confidence]
) -> dict[str, Confidence]:
    """Return for each image the confidence in the surest one that a rig took with it.

    A rig is rigid: where the pose of one of its images is right, that of the others is, which may
    see next to nothing.
    """
    frames = {name: model.find_image_with_name(name).frame_id for name in confidences}
    best = dict[int, Confidence]()
    for name, confidence in confidences.items():
        known = best.get(frames[name])
        if not known or confidence.probability > known.probability:
            best[frames[name]] = confidence
    return {name: best[frame_id] for name, frame_id in frames.items()}
