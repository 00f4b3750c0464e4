"""How the images of a model came in."""

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import num_long_tracks, seen_points
from colmap_affrect.colmap.verification import inlier_matches, num_in_tracks
from colmap_affrect.geometry.arrays import rows_in
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.project.report import Arrival

MIN_THREE_VIEW_POINTS = 12
"""So many points tie an image to two others, as the sparse preset asks for."""


def arrivals(model: MappedModel, task: MappingTask) -> dict[str, Arrival]:
    """Tell for each registered image how it came in."""
    reconstruction = model.reconstruction
    bridged = {
        name: Arrival(
            "bridged",
            bridge.pair[0],
            bridge.num_agreeing,
            bridge.num_ratios,
            bridge.scale_error_frac,
        )
        for bridge in model.bridges
        for name in bridge.names
    }
    guided = _tied_by_guided_matches(reconstruction, task) if task.guided else set()
    names = {i: reconstruction.images[i].name for i in reconstruction.reg_image_ids()}
    return {
        name: bridged.get(name, Arrival("guided" if image_id in guided else "tracks"))
        for image_id, name in sorted(names.items(), key=lambda item: item[1])
    }


def _tied_by_guided_matches(model: pycolmap.Reconstruction, task: MappingTask) -> set[int]:
    """Return the images that too few three-view tracks would tie without guided matches."""
    points = {i: seen_points(model.images[i]) for i in model.reg_image_ids()}
    exact = {}
    for ids, matches in inlier_matches(task.database_path, 1).items():
        if points.keys() >= set(ids):
            first, second = (points[i][matches[:, side]] for side, i in enumerate(ids))
            seen_by_both = matches[(first == second) & (first >= 0)]
            guided = task.guided.get(ids, seen_by_both[:0])
            exact[ids] = seen_by_both[~rows_in(seen_by_both, guided)]
    seen, tied = num_long_tracks(model), num_in_tracks(exact)
    return {i for i in points if tied.get(i, 0) < MIN_THREE_VIEW_POINTS <= seen[i]}
