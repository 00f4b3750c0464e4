"""What a run has stored goes into the database: images, cameras, keypoints and raw matches."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database_copy import copy_without_features
from colmap_affrect.colmap.image_import import import_images, record_cameras
from colmap_affrect.pairs.lists import Pair, PairList
from colmap_affrect.project.image_failures import ImageFailure
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.session.view_graph import ViewGraph

# In one transaction: a run that is ended writes at most as many again; resource
PAIRS_PER_WRITE = 100


def start_database(workspace: Workspace, inputs: Inputs) -> None:
    """Make the database from the one that is given, unless it is there."""
    if inputs.from_database and not workspace.database.exists():
        copy_without_features(Path(inputs.from_database), workspace.database)


def add_images(
    workspace: Workspace, graph: ViewGraph, inputs: Inputs, names: Sequence[str]
) -> dict[str, ImageFailure]:
    """Add the images that the database lacks.

    Args:
        workspace: whose database it is.
        graph: of the database; it is read anew afterwards.
        inputs: the photographs, and what is known of their cameras.
        names: of the images that the database is to have.

    Returns:
        Why COLMAP does not take images, by their names.
    """
    start_database(workspace, inputs)
    rejected = import_images(
        workspace.database,
        image_path=Path(inputs.image_path),
        names=names,
        options=inputs.cameras,
    )
    graph.forget()
    initial_cameras = None if inputs.from_database else inputs.initial_cameras
    known = None
    if inputs.from_database:
        original = Path(inputs.from_database)
        known = read_camera_records(original.with_name(workspace.cameras.name))
    record_cameras(
        graph.cameras,
        records_path=workspace.cameras,
        initial=initial_cameras,
        known=known,
    )
    mode = inputs.cameras.mode
    why = ImageFailure("refused_by_colmap", values={"camera_mode": mode})
    return dict.fromkeys(rejected, why)


def write_images_and_keypoints(context: Context) -> dict[str, ImageFailure]:
    """Bring the database up to date; return the images that COLMAP does not take, with reasons."""
    store = context.features
    graph = context.graph
    workspace = context.workspace
    counts = store.num_keypoints()
    has_files = workspace.database.exists() and workspace.cameras.exists()
    if has_files and counts == graph.num_keypoints:
        return {}
    rejected = add_images(workspace, graph, context.inputs, names=list(counts))
    ids = graph.ids
    known = graph.num_keypoints
    in_database = ids.keys() & counts.keys()
    lacking = [name for name in in_database if counts[name] != known.get(name)]
    if lacking:
        _write_keypoints(context, sorted(lacking))
    return rejected


def _write_keypoints(context: Context, names: Sequence[str]) -> None:
    """Write the keypoints of images, in the place of those that are there."""
    store = context.features
    ids = context.graph.ids
    with context.graph.open_to_change() as database:
        for name in names:
            ranges = store.level_ranges(name).values()
            colmap_database.write_keypoints(
                database,
                image_id=ids[name],
                lafs=store.read_frames(name),
                level_ends=[part.stop for part in ranges],
            )


def write_matches(
    context: Context,
    pairs: Sequence[Pair],
    *,
    replaces: bool = False,
) -> None:
    """Put the raw matches that the database lacks into it; it has images and keypoints.

    One that lacks none is only read, so that what is known of its rows stays known, unless others
    are to be replaced.

    They are written in batches: a run that is killed loses one, and writes it when it is repeated.

    Args:
        context: of the workspace.
        pairs: of image names; those that are not stored are passed over.
        replaces: also put in those that are others there, whose two-view geometry goes.
    """
    listed = PairList.of(pairs)
    ids = context.graph.ids
    known_ids = np.array([ids.get(name, 0) for name in listed.names], np.int64)
    ids_of_pairs = known_ids[listed.numbers]
    wanted = np.min(ids_of_pairs, axis=1, initial=1) > 0  # both images are there
    if not replaces:
        with context.graph.open_to_read() as database:
            wanted = colmap_database.lack_matches(database, ids_of_pairs)
    todo = listed.at(wanted)
    if not todo:
        return
    stored = context.matches.read(todo)
    with context.graph.open_to_change(for_pairs=True) as database:
        batch = list(islice(stored, PAIRS_PER_WRITE))
        while batch:
            with pycolmap.DatabaseTransaction(database):
                for found in batch:
                    first, second = found.names
                    colmap_database.write_matches(
                        database, ids[first], ids[second], found.indices
                    )
            batch = list(islice(stored, PAIRS_PER_WRITE))
