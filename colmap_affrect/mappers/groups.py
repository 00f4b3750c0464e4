"""Models of groups of photographs: of those that no model has, and of each place of several.

A search ends once first pairs bring nothing that scores higher than its best model, which a second
group of photographs never does.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace

from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.search import Search
from colmap_affrect.mappers.surroundings import MIN_PLACE, Places, places_of
from colmap_affrect.project.reasons import Doubt, DoubtCode

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
    mapped_groups = set[int]()
    group = _largest_group(search.graph, found, mapped_groups)
    while group:
        mapped_groups |= group
        models_of_group = search.best(_inside(search.graph, group))
        for mapped in models_of_group:
            if _num_images(mapped) >= MIN_GROUP:
                found.append(mapped)
        group = _largest_group(search.graph, found, mapped_groups)
    return found


def with_places_mapped_again(
    models: Sequence[MappedModel],
    graph: PairGraph,
    map_again: Callable[[PairGraph], list[MappedModel]],
) -> list[MappedModel]:
    """Return models of one place each: a model of several bends all to fit what is false.

    Args:
        models: The models so far.
        graph: Their pairs.
        map_again: Makes models of some of the pairs.

    Returns:
        The models. Where one holds several places, its largest place is mapped again alone, without
        collages, and then all photographs that are in no model so far; it stays as it is where that
        place makes no model.
    """
    found = list[MappedModel]()
    inside = set[int]()
    why_apart = dict[str, Doubt]()
    todo = list(models)
    while todo:
        mapped = todo.pop(0)
        places = places_of(mapped.reconstruction, graph)
        if places.is_clearly_one:
            mapped = replace(mapped, one_place_by=graph)
        made = _largest_place_alone(places, graph, map_again)
        found.append(made or mapped)
        inside.update(found[-1].reconstruction.reg_image_ids())
        if made:
            why_apart.update(_why_apart(places, graph))
            inside |= places.collages
            todo = map_again(_inside(graph, graph.names.keys() - inside))
    return [_with_why_apart(mapped, why_apart) for mapped in found]


def _largest_place_alone(
    places: Places,
    graph: PairGraph,
    map_again: Callable[[PairGraph], list[MappedModel]],
) -> MappedModel | None:
    """Return a model of the largest of several places, without collages.

    Args:
        places: Of a model.
        graph: The pairs.
        map_again: Makes models of some of the pairs.

    Returns:
        The model; None where there is one place alone, or most of its photographs are in no model.
    """
    largest = places.images[0] - places.collages
    if len(places.images) < 2 or len(largest) < MIN_PLACE:
        return None
    made = map_again(_inside(graph, largest))
    has_most = made and 2 * _num_images(made[0]) > len(largest)
    return made[0] if has_most else None


def _inside(graph: PairGraph, image_ids: Set[int]) -> PairGraph:
    """Return the graph of the pairs of some images."""
    outside = [pair.ids for pair in graph.verified if not image_ids >= {*pair.ids}]
    return graph.without(outside)


def _why_apart(places: Places, graph: PairGraph) -> dict[str, Doubt]:
    """Return why each image of several places is not in a model of another one, by name."""
    found = dict[str, Doubt]()
    for image_id in sorted(set[int]().union(*places.images)):
        is_collage = image_id in places.collages
        code: DoubtCode = "two_places" if is_collage else "other_surroundings"
        found[graph.names[image_id]] = Doubt(code)
    return found


def _with_why_apart(mapped: MappedModel, why_apart: Mapping[str, Doubt]) -> MappedModel:
    """Return a model with the reasons of the images that it does not have."""
    model = mapped.reconstruction
    inside = {model.images[image_id].name for image_id in model.reg_image_ids()}
    others = {name: why for name, why in why_apart.items() if name not in inside}
    return replace(mapped, why_apart=others)


def _num_images(mapped: MappedModel) -> int:
    return int(mapped.reconstruction.num_reg_images())


def _largest_group(
    graph: PairGraph, models: Sequence[MappedModel], mapped_groups: set[int]
) -> set[int]:
    """Return the largest group that pairs connect, without images of models or mapped groups.

    Args:
        graph: The pairs.
        models: Their images are in no group.
        mapped_groups: Nor are these images.

    Returns:
        The images; none where no group has enough of them.
    """
    inside = set(mapped_groups)
    for mapped in models:
        inside.update(mapped.reconstruction.reg_image_ids())
    outside = [pair.ids for pair in graph.pairs if inside.isdisjoint(pair.ids)]
    parts = connected_parts(outside)
    return parts[0] if parts and len(parts[0]) >= MIN_GROUP else set()
