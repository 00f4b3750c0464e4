"""Models of some of the tracks, which tell poses as well as all do, with the points of all.

Mapping with a part of the tracks takes a fraction of the time: see
:mod:`colmap_affrect.mappers.thinning`.
"""

import copy
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.native_options import Plain, set_values
from colmap_affrect.mappers.adjustment import FAST_TOLERANCE
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.search import Search

SOME_TRACKS = "from some of the tracks"  # what made a model, in the words of a report

GROWTH_OF_LARGE = 1.4
"""Of images or points from one adjustment of all to the next. Each takes time in proportion to its
images, so all together take ``r / (r - 1)`` times as much as the last one: that is 3.5 times, and
eleven times with COLMAP's 1.1 (resource). In between, local adjustments keep poses where their
neighbours are."""
NEVER = 2**31 - 1  # images or points, of which so many never come; numeric
SELDOM: Mapping[str, Plain] = {
    "ba_global_frames_ratio": GROWTH_OF_LARGE,
    "ba_global_points_ratio": GROWTH_OF_LARGE,
    # COLMAP's 500 and 250,000 make the number of adjustments grow with that of images
    "ba_global_frames_freq": NEVER,
    "ba_global_points_freq": NEVER,
    # The next images adjust the same neighbours once more
    "ba_local_max_refinements": 1,
    # Where tracks were left out, all are adjusted once more with all of them
    "ba_local_function_tolerance": FAST_TOLERANCE,
    "ba_global_function_tolerance": FAST_TOLERANCE,
}
"""Options of COLMAP's pipeline for large sets, whose time then grows as their images do."""


def model_of_some_tracks(
    search: Search,
    graph: PairGraph,
    before_all_points: Callable[[pycolmap.Reconstruction], None],
) -> list[MappedModel]:
    """Return the model that some tracks of a graph make, with all points, if it is certain.

    Args:
        search: Makes and scores models.
        graph: The pairs that a model is made from.
        before_all_points: Called with the model before it gets all points.

    Returns:
        One model, or none.
    """
    thin = graph.thinned()
    if thin is graph:
        return []
    scorer = replace(search.scorer, graph=thin)
    quick = replace(search, scorer=scorer, builds_bridges=False, tries_focals=False)
    models = quick.best(thin)
    if not models:
        return []
    model = models[0].reconstruction
    has_all = model.num_reg_images() == len(search.graph.keypoints)
    if not has_all or not quick.is_certain(model, search.graph):
        return []
    before_all_points(model)
    return [_with_all_points(search, graph, models[0])]


def adjust_seldom(
    native: pycolmap.IncrementalPipelineOptions, given: Mapping[str, Plain]
) -> None:
    """Have COLMAP's pipeline adjust as seldom as large sets allow.

    Args:
        native: Changed in place.
        given: What the user gives, which stays.
    """
    set_values(native, {key: SELDOM[key] for key in SELDOM if key not in given})


def large_models(
    task: MappingTask,
    search: Search,
    thin: PairGraph,
    folder: Path,
    map_task: Callable[[MappingTask], list[MappedModel]],
) -> list[MappedModel]:
    """Return the models that another mapper makes, with the points of all tracks.

    Args:
        task: What to map.
        search: Has the graph of all tracks, and adjusts models with them.
        thin: That graph with some of its tracks, or itself.
        folder: Where files may be while the mapper runs.
        map_task: Maps a task by the other mapper.
    """
    if thin is search.graph:
        return map_task(task)
    with _with_thin_database(task, thin, folder) as some:
        models = map_task(some)
    if not models:
        return map_task(task)
    return [_with_all_points(search, search.graph, mapped) for mapped in models]


def _with_all_points(
    search: Search, graph: PairGraph, mapped: MappedModel
) -> MappedModel:
    """Give a model made from some tracks of a graph the points of all of them; it is changed."""
    search.grower(graph).triangulate_all(mapped.reconstruction)  # its poses are right
    return replace(mapped, hypotheses=(SOME_TRACKS,))


@contextmanager
def _with_thin_database(
    task: MappingTask, thin: PairGraph, folder: Path
) -> Iterator[MappingTask]:
    """Give a task a database that has the inliers of a thinned graph alone, and no photographs.

    Args:
        task: What to map.
        thin: The graph.
        folder: Where the database is while it is mapped.
    """

    def write_inliers(database: pycolmap.Database) -> None:
        database.clear_matches()
        database.clear_two_view_geometries()
        for pair in thin.verified:
            geometry = copy.copy(pair.geometry)
            geometry.inlier_matches = pair.matches.astype(np.uint32)
            database.write_two_view_geometry(*pair.ids, geometry)

    with tempfile.TemporaryDirectory(dir=folder) as name:
        path = Path(name) / "database.db"
        copy_database(task.database_path, path, change=write_inliers)
        yield replace(task, database_path=path, image_path=None)
