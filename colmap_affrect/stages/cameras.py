"""Cameras: a vote of the verified pairs over those that nobody knows, into the database."""

import logging
import time
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap.camera_vote import (
    CameraVote,
    apply_records,
    contradicted_cameras,
    forget_votes,
    needs_vote,
    voting_pairs,
)
from colmap_affrect.colmap.cameras import (
    notable_lines,
    read_camera_records,
    write_camera_records,
)
from colmap_affrect.colmap.verification import ExtractedPx, VerificationOptions, verify
from colmap_affrect.pairs.base import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import StageReport
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import unmeasured_pairs
from colmap_affrect.stages.verify import extracted_px

logger = logging.getLogger(__name__)


def choose_cameras(context: Context, *, may_share: bool = True) -> StageReport:
    """Hold a vote over cameras that nobody knows, unless it was held; verify pairs again by it.

    ``may_share``: cameras of images of one size may turn out to be the same, where nothing is said
    of who shares one.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("verify")
    copied = workspace.is_copy
    size_px = None if copied else extracted_px(context)
    is_new = needs_vote(read_camera_records(workspace.cameras))
    may_share = may_share and not copied and context.inputs.cameras.mode == "auto"
    hold_vote(
        workspace.database,
        workspace.cameras,
        context.verification,
        size_px,
        may_share=may_share,
        silent=[] if copied else unmeasured_pairs(context),
        progress=context.progress,
    )
    records = read_camera_records(workspace.cameras)
    found = is_new * sum(record.source == "pairs" for record in records.values())
    return StageReport("cameras", time.perf_counter() - start, found, len(records) - found)


def hold_vote(
    database_path: Path,
    records_path: Path,
    verification: VerificationOptions,
    size_px: ExtractedPx = None,
    *,
    may_share: bool,
    silent: Collection[Pair] = (),
    progress: Progress = SILENT,
) -> None:
    """Vote on the cameras of a database whose pairs are verified, unless that was done.

    A killed one is gone on with: what was decided is written first, and putting it into the
    database may be repeated. The cameras of the database change, and pairs are verified again with
    those that the pairs know; the records are brought up to date. ``silent`` pairs do not vote.
    Focal lengths that the user gave stay, whatever pairs say; it is put on record.
    """
    records = read_camera_records(records_path)
    if needs_vote(records):
        records = forget_votes(database_path, records)
        verify(database_path, verification, size_px)
        unknown = {key for key, record in records.items() if record.source == "guess"}
        pairs = voting_pairs(database_path, unknown, size_px, silent)
        records = CameraVote(records, pairs, may_share).decide(progress)
        write_camera_records(records_path, records)
        for line in notable_lines(r for r in records.values() if r.low_px is not None):
            logger.info("cameras: %s", line)
    if any(record.low_px is not None for record in records.values()):
        apply_records(database_path, records)
        verify(database_path, verification, size_px)
    given = {
        key: record.focal_px / max(record.size)
        for key, record in records.items()
        if "focal" in record.given and record.focal_px > 0.0
    }
    if any(records[key].is_contradicted is None for key in given):
        pairs = voting_pairs(database_path, given, size_px, silent, only_straight=True)
        found = contradicted_cameras(pairs, given)
        records |= {key: replace(records[key], is_contradicted=key in found) for key in given}
        write_camera_records(records_path, records)
