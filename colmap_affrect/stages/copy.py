"""Copy: another program's database into the output folder, verified where it is not yet."""

import logging
import time
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.checks import FATAL, refuse_unusable
from colmap_affrect.colmap.database_copy import add_frames, copy_database
from colmap_affrect.colmap.initial_cameras import record_cameras
from colmap_affrect.colmap.verification import VerificationOptions, verify
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.project.contents import content_of
from colmap_affrect.project.report import StageReport
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.inputs import source_files

logger = logging.getLogger(__name__)


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
        refuse_unusable(source)
    given = {
        "database": str(source.resolve()),
        "image_path": str(image_path.resolve()) if image_path else "",
    }
    workspace.record_options("copy", given, overwrite=overwrite)
    warnings = {}
    if digest != (before := workspace.made_from("copy")):
        if before:
            warnings[str(source)] = "has changed; its copy and the models are made anew"
        workspace.rewind()
        workspace.record_made_from(copy=digest)
    if not workspace.database.exists():
        copy_database(source, workspace.database, FATAL, add_frames)
    for name, what in warnings.items():
        logger.warning("%s: %s", name, what)
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
