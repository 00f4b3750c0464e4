"""What a run has stored goes into the database: images, cameras, keypoints and raw matches."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database_copy import copy_without_features
from colmap_affrect.colmap.image_import import import_images, record_cameras
from colmap_affrect.pairs.lists import Pair, PairList
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.session.view_graph import ViewGraph


def start_database(workspace: Workspace, inputs: Inputs) -> None:
    """Make the database from the one that is given, unless it is there."""
    if inputs.from_database and not workspace.database.exists():
        copy_without_features(Path(inputs.from_database), workspace.database)


def add_images(
    workspace: Workspace, graph: ViewGraph, inputs: Inputs, names: Sequence[str]
) -> dict[str, str]:
    """Add images that the database lacks; return those that COLMAP does not take, with reasons."""
    start_database(workspace, inputs)
    original = Path(inputs.from_database) if inputs.from_database else None
    rejected = import_images(
        workspace.database, Path(inputs.image_path), names, inputs.cameras
    )
    graph.forget()
    record_cameras(
        graph.cameras,
        workspace.cameras,
        None if original else inputs.initial_cameras,
        read_camera_records(original.with_name(workspace.cameras.name))
        if original
        else None,
    )
    reason = f"COLMAP cannot read it, or does not take it (camera mode {inputs.cameras.mode})"
    return dict.fromkeys(rejected, reason)


def write_images_and_keypoints(context: Context) -> dict[str, str]:
    """Bring the database up to date; return the images that COLMAP does not take, with reasons."""
    store = context.features
    graph = context.graph
    counts = store.num_keypoints()
    has_database = context.workspace.database.exists()
    if (
        has_database
        and context.workspace.cameras.exists()
        and counts == graph.num_keypoints
    ):
        return {}
    rejected = add_images(context.workspace, graph, context.inputs, list(counts))
    known = graph.num_keypoints
    lacking = [
        name for name in counts if name in graph.ids and counts[name] != known.get(name)
    ]
    if not lacking:
        return rejected
    ids = graph.ids
    with graph.opened() as database:
        for name in lacking:
            ends = [part.stop for part in store.level_ranges(name).values()]
            colmap_database.write_keypoints(
                database, ids[name], store.read_frames(name), ends
            )
    return rejected


def write_matches(
    context: Context,
    database: pycolmap.Database,
    pairs: Sequence[Pair],
    *,
    replaces: bool = False,
) -> None:
    """Put the raw matches that the database lacks into it; it has images and keypoints.

    Args:
        context: of the workspace.
        database: that of the workspace, open.
        pairs: of image names; those that are not stored are passed over.
        replaces: also put in those that are others there, whose two-view geometry goes.
    """
    listed = PairList.of(pairs)
    ids = {image.name: image.image_id for image in database.read_all_images()}
    known_ids = np.array([ids.get(name, 0) for name in listed.names], np.int64)
    ids_of_pairs = known_ids[listed.numbers]
    wanted = np.min(ids_of_pairs, axis=1, initial=1) > 0  # both images are there
    if not replaces:
        wanted = colmap_database.lack_matches(database, ids_of_pairs)
    todo = listed.at(wanted)
    for found in context.matches.read(todo) if todo else ():
        first, second = (ids[name] for name in found.names)
        colmap_database.write_matches(database, first, second, found.indices)
