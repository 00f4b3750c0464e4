"""A camera for each image in the place of shared ones: as a hypothesis, and as what stays open."""

import math
from dataclasses import dataclass, replace

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.focal_observability import num_independent
from colmap_affrect.mappers.model_score import MIN_SCORE_GAIN, ModelScorer
from colmap_affrect.mappers.other_cameras import OtherCameras, pose_turns_deg
from colmap_affrect.mappers.pair_graph import PairGraph, used_cameras
from colmap_affrect.mappers.search import Search

MAX_OPEN_IMAGES = 8
"""Of models that are looked at, which takes a quarter of the time of mapping. With more images
cameras of their own score higher where they are right: measured with 8 to 11 of enlarged parts,
while of 3 to 5 no score tells; resource."""


@dataclass(frozen=True)
class OwnCameras:
    """What a camera for each image makes of a model whose images share some."""

    whole: pycolmap.Reconstruction | None
    """The model with them; None where it scores no higher with some of the tracks."""
    other: OtherCameras | None
    """What stays open where they score no higher; None: not looked at."""
    trial: pycolmap.Reconstruction
    """The model with them, from some of the tracks; or ``whole``."""


def own_cameras(
    model: pycolmap.Reconstruction, shared: Search, per_image: Search
) -> OtherCameras:
    """Return what a camera for each image would make of a model whose images share some.

    Nothing but the scores decides between both: they have the priors of all focal lengths.

    Args:
        model: It stays as it is.
        shared: The search that made it.
        per_image: The same with a camera for each image.
    """
    graph = per_image.graph.thinned()
    other = per_image.comparing().grower(graph).remake(model)
    return _compared(model, other, shared, replace(per_image.scorer, graph=graph))


def _compared(
    model: pycolmap.Reconstruction,
    other: pycolmap.Reconstruction,
    shared: Search,
    scorer: ModelScorer,
) -> OtherCameras:
    """Return by how much another model scores higher, and how far its poses turn.

    Args:
        model: The model, whose images share cameras.
        other: The same with a camera for each image.
        shared: Scores the model.
        scorer: Scores the other one. Both are scored by the pairs and tracks of its graph.
    """
    other_score = scorer.score(other)
    score = replace(shared.scorer, graph=scorer.graph).score(model)
    return OtherCameras(other_score - score, pose_turns_deg(model, other))


def one_camera(
    model: pycolmap.Reconstruction, shared: pycolmap.Reconstruction, gain: float
) -> OtherCameras:
    """Return what one camera makes of a model whose images have their own.

    What moves before a background along with the cameras is taken up by focal lengths of single
    images: that fits a little better, by less than as many free parameters are worth (BIC).

    Args:
        model: It scores higher.
        shared: The same images, which share cameras.
        gain: By what the score is higher, in nats.
    """
    num_more = len(used_cameras(model)) - len(used_cameras(shared))
    worth = 0.5 * math.log(max(2, num_independent(model))) * num_more
    turns_deg = pose_turns_deg(model, shared)
    return OtherCameras(worth - gain, turns_deg, are_shared=True)


def trial_with_own_cameras(
    per_image: Search, thin: PairGraph, model: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """Return a model with a camera for each image, made from some of the tracks.

    Args:
        per_image: Makes the model.
        thin: A graph of these tracks.
        model: Has the poses and cameras to begin with; it stays as it is.
    """
    return per_image.comparing().grower(thin).restart_from(model)


def with_per_image_cameras(
    per_image: Search,
    graph: PairGraph,
    shared: Search,
    model: pycolmap.Reconstruction,
    known: pycolmap.Reconstruction | None = None,
) -> OwnCameras:
    """Give each image of a model a camera of its own.

    Args:
        per_image: Makes the model.
        graph: Its pairs.
        shared: Scores the model with shared cameras.
        model: The model with shared cameras; it stays as it is.
        known: What :func:`trial_with_own_cameras` made of it, perhaps before it got all points; it
            may be changed.
    """
    is_looked_at = model.num_reg_images() <= MAX_OPEN_IMAGES
    thin = graph.thinned()
    if thin is not graph:
        trial = known or trial_with_own_cameras(per_image, thin, model)
        scorer = replace(per_image.scorer, graph=thin)
        shared_score = replace(shared.scorer, graph=thin).score(model)
        if scorer.score(trial) <= shared_score + MIN_SCORE_GAIN:
            if not is_looked_at:
                return OwnCameras(None, None, trial)
            per_image.comparing().grower(thin).adjust_fully(trial)
            other = _compared(model, trial, shared, scorer)
            return OwnCameras(None, other, trial)
    whole = per_image.grower(graph).remake(model)
    if thin is not graph or not is_looked_at:
        return OwnCameras(whole, None, whole)
    scorer = replace(per_image.scorer, graph=graph)
    return OwnCameras(whole, _compared(model, whole, shared, scorer), whole)
