"""Whether parts of a model are surer apart: what ties them says too little.

A few matches on one poster may tie two rooms, and leave open how these stand to each other. Then no
photograph of the model can be trusted, while each part alone is sure.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace

from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.surroundings import MIN_PLACE, Places, cut_into_places
from colmap_affrect.project.report import DOUBTFUL, expected_right_poses

Probabilities = Mapping[int, float]  # by image id
Score = Callable[[MappedModel], Probabilities]


def surer_apart(mapped: MappedModel, places: Places, score: Score) -> Places:
    """Return places, of which one that is doubtful throughout is cut where its parts are surer.

    Args:
        mapped: The model; it stays as it is.
        places: That it holds.
        score: Returns the probabilities of the images that stay in a model, which it may change.

    Returns:
        The parts that pairs tie whose surroundings match, as places, where more of their relative
        poses are expected to be right than of the whole, single images among them, which make no
        model; else the places as they are.
    """
    models = [part for part in places.tied if len(part) >= MIN_PLACE]
    if len(places.images) > 1 or len(models) < 2:
        return places
    together = dict(score(_copied(mapped)))
    for image_id, probability in places.unclear.items():
        if image_id in together:
            together[image_id] *= probability
    if max(together.values(), default=0.0) >= DOUBTFUL:
        return places
    parts = sorted(places.tied, key=lambda part: (-len(part), min(part)))
    cut = replace(places, images=parts, unclear={}, why="surer_apart")
    expected = 0.0
    for part in cut_into_places(_copied(mapped), cut):
        if part.reconstruction.num_reg_images() >= MIN_PLACE:
            expected += expected_right_poses(score(part).values())
    return cut if expected > expected_right_poses(together.values()) else places


def _copied(mapped: MappedModel) -> MappedModel:
    return replace(mapped, reconstruction=copy.deepcopy(mapped.reconstruction))
