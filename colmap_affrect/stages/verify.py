"""Verify: two-view geometries of the matched pairs, into the database."""

from __future__ import annotations

import time
from collections.abc import Callable

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.verification import VerificationOptions, verify
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import recorded_extraction
from colmap_affrect.stages.match import write_matches
from colmap_affrect.stages.pairs import listed_pairs


def recorded_verification(workspace: Workspace) -> VerificationOptions:
    """Return the options on record of verification, done or still to be done."""
    return VerificationOptions.from_mapping(
        workspace.planned("verify") or {}, str(workspace.config)
    )


def verify_matches(
    context: Context, options: VerificationOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Estimate the two-view geometries of all matched pairs.

    Args:
        context: with raw matches.
        options: thresholds and seed; by default those on record.
        overwrite: discard the results of this and later stages first.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("match")
    pairs = listed_pairs(context)
    options = options or recorded_verification(workspace)
    workspace.record_options("verify", options.to_mapping(), overwrite=overwrite)
    write_matches(context, pairs)
    todo = len(colmap_database.unverified_pairs(workspace.database))
    with context.progress.stage("verify", todo, "pairs") as advance:
        verify_new(workspace, advance)
    return StageReport("verify", time.perf_counter() - start, todo, len(pairs) - todo)


def verify_new(workspace: Workspace, advance: Callable[[int], None] | None = None) -> None:
    """Verify the pairs of the database that have matches and no two-view geometry, good or bad."""
    extracted_px = recorded_extraction(workspace).max_image_size_px
    verify(workspace.database, recorded_verification(workspace), extracted_px, advance)
