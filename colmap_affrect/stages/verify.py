"""Verify: two-view geometries of the matched pairs, into the database."""

import time
from collections.abc import Callable, Sequence

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.database_verification import ExtractedPx, verify_pairs
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.progress import SILENT
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.session.context import Context
from colmap_affrect.session.database_export import (
    write_images_and_keypoints,
    write_matches,
)


def verify_matches(
    context: Context,
    options: VerificationOptions | None = None,
    *,
    overwrite: bool = False,
) -> StageReport:
    """Estimate the two-view geometries of all matched pairs.

    Args:
        context: of the workspace.
        options: by default those on record.
        overwrite: discard what there is.

    Returns:
        How many pairs were verified now, and how many before.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("match")
    pairs = context.listed_pairs()
    options = options or context.verification
    workspace.record_options("verify", options.to_mapping(), overwrite=overwrite)
    num_verified = update_verified(context, pairs, shows=True)
    wall_s = time.perf_counter() - start
    return StageReport("verify", wall_s, num_verified, len(pairs) - num_verified)


def update_verified(
    context: Context,
    pairs: Sequence[Pair],
    *,
    replaces: bool = False,
    shows: bool = False,
) -> int:
    """Bring the database up to what is stored, and verify the pairs that are not verified there.

    Args:
        context: of the workspace.
        pairs: of image names; those that are not stored are passed over.
        replaces: raw matches that are others in the database are replaced.
        shows: show progress.

    Returns:
        The number of pairs that were verified.
    """
    write_images_and_keypoints(context)
    write_matches(context, pairs, replaces=replaces)
    with context.graph.open_to_read() as database:
        todo = colmap_database.pairs_to_verify(database)
    progress = context.progress if shows else SILENT
    with progress.stage("verify", len(todo), "pairs") as advance:
        if len(todo):
            _verify(context, todo, advance)
    return len(todo)


def _verify(context: Context, todo: Indices, advance: Callable[[int], None]) -> None:
    """Verify pairs, which are given by the ids of their images, in the database."""
    colmap_database.require_database_space(context.workspace.database, len(todo))
    sizes_px = extracted_px(context)
    with context.graph.open_to_change(for_pairs=True) as database:
        verify_pairs(
            database,
            todo,
            context.verification,
            sizes_px,
            advance,
            context.executor,
        )


def extracted_px(context: Context) -> ExtractedPx:
    """Return the longest side that photographs were shrunk to; by pair, where levels differ."""
    sizes = [level.max_image_size_px for level in context.extraction.levels]
    if len(set(sizes)) == 1:
        return sizes[0]
    ids = context.graph.ids
    pairs = [pair for pair in context.listed_pairs() if ids.keys() >= set(pair)]
    found: dict[tuple[int, int], int] = {}
    for (first, second), level in context.matches.levels(pairs).items():
        low, high = sorted((ids[first], ids[second]))
        found[low, high] = sizes[level]
    return found
