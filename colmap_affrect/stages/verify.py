"""Verify: two-view geometries of the matched pairs, into the database.

Another program's database is copied in the place of all stages before.
"""

import logging
import time
from collections.abc import Callable
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.checks import FATAL, refuse_unusable
from colmap_affrect.colmap.database_copy import add_frames, copy_database
from colmap_affrect.colmap.initial_cameras import record_cameras
from colmap_affrect.colmap.verification import (
    ExtractedPx,
    VerificationOptions,
    inlier_matches,
    verified_pairs,
    verify,
)
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.record import content_of
from colmap_affrect.project.report import StageReport
from colmap_affrect.stages.context import Context, source_files
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


def copy_verified(
    context: Context,
    source: Path,
    image_path: Path | None,
    verification: VerificationOptions,
    *,
    overwrite: bool = False,
) -> StageReport:
    """Copy a database, and verify its matched pairs that have no two-view geometry.

    The copy is made anew when the original has changed since, or with ``overwrite``. Raises
    DatabaseError when it cannot be used, or has no matches.
    """
    start = time.perf_counter()
    workspace = context.workspace
    if image_path and not image_path.is_dir():
        raise OptionError(f"--image-path {image_path}: no such folder")
    workspace.require_own(image_path)
    digest = content_of(source_files(source)).digest
    if digest != workspace.made_from("copy") or not workspace.database.exists():
        refuse_unusable(source, warns=True)
    photographs = str(image_path.resolve()) if image_path else ""
    given = {"database": str(source.resolve()), "image_path": photographs}
    workspace.record_options("copy", given, overwrite=overwrite)
    warnings = {}
    if digest != (before := workspace.made_from("copy")):
        if before:
            warnings[str(source)] = "has changed; its copy and the models are made anew"
            logger.warning("%s: %s", source, warnings[str(source)])
        workspace.rewind()
        workspace.record_made_from(copy=digest)
    if not workspace.database.exists():
        copy_database(source, workspace.database, FATAL, add_frames)
    record_cameras(workspace.database, workspace.cameras)
    workspace.record_options("verify", verification.to_mapping())
    num_pairs = colmap_database.num_matched_pairs(workspace.database)
    if not num_pairs:
        raise DatabaseError(f"{source}: has no matches; match its images first")
    todo = len(colmap_database.unverified_pairs(workspace.database))
    if todo:
        logger.warning("%s: %d pairs have matches only; they are verified now", source, todo)
    with context.progress.stage("verify", todo, "pairs") as advance:
        verify(workspace.database, verification, advance=advance)
    wall_s = time.perf_counter() - start
    return StageReport("verify", wall_s, todo, num_pairs - todo, warnings=warnings)


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
