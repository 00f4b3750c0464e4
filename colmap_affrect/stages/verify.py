"""Verify: two-view geometries of the matched pairs, into the database."""

import logging
import time
from collections.abc import Callable

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.verification import (
    ExtractedPx,
    VerificationOptions,
    inlier_matches,
    verified_pairs,
    verify,
)
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.report import StageReport
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.match import write_matches
from colmap_affrect.stages.pairs import listed_pairs

logger = logging.getLogger(__name__)


def verify_matches(
    context: Context, options: VerificationOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Estimate the two-view geometries of all matched pairs."""
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("match")
    pairs = listed_pairs(context)
    options = options or context.verification
    workspace.record_options("verify", options.to_mapping(), overwrite=overwrite)
    write_matches(context, pairs)
    todo = len(colmap_database.unverified_pairs(workspace.database))
    with context.progress.stage("verify", todo, "pairs") as advance:
        verify_new(context, advance)
    return StageReport("verify", time.perf_counter() - start, todo, len(pairs) - todo)


def num_verified_inliers(context: Context) -> dict[Pair, int]:
    """Return the number of inliers of each verified pair; of its images the lower id is first.

    Another program had its own threshold.
    """
    path = context.workspace.database
    names = {number: name for name, number in colmap_database.image_ids(path).items()}
    least = 1 if context.workspace.is_foreign else context.verification.min_num_inliers
    pairs = verified_pairs(path, least)
    return {(names[one], names[two]): count for (one, two), count in pairs.items()}


def verified_inliers(context: Context) -> dict[Pair, Indices]:
    """Return the (M, 2) features of each verified pair that are inliers."""
    path = context.workspace.database
    names = {number: name for name, number in colmap_database.image_ids(path).items()}
    found = inlier_matches(path, context.verification.min_num_inliers)
    return {(names[one], names[two]): indices for (one, two), indices in found.items()}


def extracted_px(context: Context) -> ExtractedPx:
    """Return the longest side that photographs were shrunk to; by pair, where levels differ."""
    sizes = [level.max_image_size_px for level in context.extraction.levels]
    if len(set(sizes)) == 1:
        return sizes[0]
    ids = colmap_database.image_ids(context.workspace.database)
    pairs = [pair for pair in listed_pairs(context) if ids.keys() >= set(pair)]
    found: dict[tuple[int, int], int] = {}
    for (first, second), level in context.matches.levels(pairs).items():
        low, high = sorted((ids[first], ids[second]))
        found[low, high] = sizes[level]
    return found


def verify_new(context: Context, advance: Callable[[int], None] | None = None) -> None:
    """Verify the pairs of the database that have matches and no two-view geometry, good or bad."""
    path, options = context.workspace.database, context.verification
    verify(path, options, extracted_px(context), advance)
