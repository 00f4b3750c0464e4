"""Groups of photographs that match each other, and that no model has: each becomes one of its own.

A search ends once first pairs bring nothing that scores higher than its best model, which a second
group of photographs never does.
"""

from collections.abc import Sequence

from colmap_affrect.colmap.verification import connected_parts
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.search import Search

MIN_GROUP = 3  # photographs: two alone are hardly ever sure, and COLMAP keeps three


def with_other_groups(
    search: Search, models: Sequence[MappedModel]
) -> list[MappedModel]:
    """Return models, and those of the groups whose photographs are in none of them.

    Args:
        search: Makes models.
        models: The models so far.

    Returns:
        Also models of groups of three photographs and more, each of pairs inside of its group.
    """
    found = list(models)
    tried = set[int]()
    group = _largest_group(search.graph, found, tried)
    while group:
        tried |= group
        outside = [
            pair.ids for pair in search.graph.verified if not group >= {*pair.ids}
        ]
        own = search.best(search.graph.without(outside))
        found += [mapped for mapped in own if _num_images(mapped) >= MIN_GROUP]
        group = _largest_group(search.graph, found, tried)
    return found


def _num_images(mapped: MappedModel) -> int:
    return int(mapped.reconstruction.num_reg_images())


def _largest_group(
    graph: PairGraph, models: Sequence[MappedModel], tried: set[int]
) -> set[int]:
    """Return the largest group that pairs connect, without images of models or tried ones.

    Args:
        graph: The pairs.
        models: Their images are in no group.
        tried: Nor are these.

    Returns:
        The images; none where no group has enough of them.
    """
    inside = set(tried)
    for mapped in models:
        inside.update(mapped.reconstruction.reg_image_ids())
    outside = [pair.ids for pair in graph.pairs if inside.isdisjoint(pair.ids)]
    parts = connected_parts(outside)
    return parts[0] if parts and len(parts[0]) >= MIN_GROUP else set()
