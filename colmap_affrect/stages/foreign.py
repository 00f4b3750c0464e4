"""Another program's database is copied, in the place of all stages before mapping.

What a user knows beside it goes into the copy: cameras, and matches that are in files. Images that
nobody has matched are matched by the descriptors of the database.
"""

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.checks import FATAL, refuse_unusable
from colmap_affrect.colmap.database_copy import (
    add_frames,
    copy_database,
    has_matches,
    read_names,
)
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.image_import import record_cameras
from colmap_affrect.colmap.initial_cameras import InitialCameras
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import DatabaseError, Logged, Option, OptionError
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.options import digest_of
from colmap_affrect.pairs.given_matches import MatchType, given_matches
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.project.paths import as_path_or_none, resolved
from colmap_affrect.project.record import content_of
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.session.context import Context, source_files
from colmap_affrect.stages.descriptors import (
    described_images,
    match_database,
    write_given_matches,
)

logger = logging.getLogger(__name__)

Records = dict[int, CameraRecord]


@dataclass(frozen=True)
class ForeignDatabase:
    """A database of another program, and what is known beside it."""

    path: Path
    image_path: Path | None = None  # folder of the photographs
    # For images of the database
    cameras: CameraOptions = field(default_factory=CameraOptions)
    matches_path: Path | None = None  # matches of its keypoints
    match_type: MatchType = "raw"  # what those are
    match_list_path: Path | None = None  # pairs to match by descriptors; None: all

    def to_record(self) -> dict[str, Any]:
        """Return what a run keeps of it; what is not given is not there."""
        record: dict[str, Any] = {
            "database": str(resolved(self.path)),
            "image_path": str(resolved(self.image_path)) if self.image_path else "",
        }
        if self.cameras != CameraOptions():
            record["cameras"] = self.cameras.to_mapping()
        if self.matches_path:
            record["matches"] = str(resolved(self.matches_path))
            record["match_type"] = self.match_type
        if self.match_list_path:
            record["match_list"] = str(resolved(self.match_list_path))
        return record

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> "ForeignDatabase":
        """Return it from what a run keeps of it."""
        return cls(
            path=Path(record["database"]),
            image_path=as_path_or_none(record.get("image_path")),
            cameras=CameraOptions.from_mapping(
                record.get("cameras", {}), "config.toml"
            ),
            matches_path=as_path_or_none(record.get("matches")),
            match_type=record.get("match_type", "raw"),
            match_list_path=as_path_or_none(record.get("match_list")),
        )

    def digest(self) -> str:
        """Return a digest of all files that are given."""
        paths = (
            self.path,
            self.matches_path,
            self.match_list_path,
            as_path_or_none(self.cameras.cameras_path),
        )
        digests = [content_of(source_files(path)).digest for path in paths if path]
        return digest_of(digests) if len(digests) > 1 else digests[0]

    def check(self) -> None:
        """Refuse what names no file, or cameras of other images, before anything is made."""
        if self.image_path and not self.image_path.is_dir():
            raise OptionError(
                "no such folder", where=Option("image-path", self.image_path)
            )
        if self.matches_path and self.match_list_path:
            raise OptionError(
                ("only without ", Option("matches-path"), ": it says what to match"),
                where=Option("match-list-path"),
            )
        names = read_names(self.path)
        self.initial_cameras().check_known(names, str(self.path))
        if self.match_list_path:
            read_pairs(self.match_list_path, names, self.image_path)

    def initial_cameras(self) -> InitialCameras:
        """Return the cameras that the user gives."""
        return InitialCameras(
            self.image_path or self.path.parent,
            self.cameras.changed(ignore_exif=True),
        )


def import_and_verify(
    context: Context,
    foreign: ForeignDatabase,
    verification: VerificationOptions,
    *,
    overwrite: bool = False,
) -> StageReport:
    """Copy a database, match its images if nobody has, and verify pairs without geometry.

    Args:
        context: of the workspace that the copy goes into.
        foreign: the database, and what is known beside it.
        verification: of pairs that have no two-view geometry.
        overwrite: make the copy anew, which is also done when a given file has changed.

    Returns:
        How many pairs were verified now, and how many before.

    Raises:
        DatabaseError: it cannot be used, or has neither matches nor descriptors.
    """
    start = time.perf_counter()
    workspace = context.workspace
    foreign.check()
    workspace.require_own(foreign.image_path)
    warned = _update_copy(context, foreign, overwrite=overwrite)
    workspace.record_options("verify", verification.to_mapping())
    _match(context, foreign)
    num_pairs = colmap_database.num_matched_pairs(workspace.database)
    if not num_pairs:
        raise DatabaseError(
            "has no matches", where=foreign.path, advice="match its images first"
        )
    num_verified = _verify(context, foreign, verification)
    return StageReport(
        name="verify",
        wall_s=time.perf_counter() - start,
        num_done=num_verified,
        num_kept=num_pairs - num_verified,
        warned=warned,
    )


def _update_copy(
    context: Context, foreign: ForeignDatabase, *, overwrite: bool
) -> tuple[StageWarning, ...]:
    """Make the copy, unless it is there and made from the same files; return a warning."""
    workspace = context.workspace
    source = foreign.path
    digest = foreign.digest()
    if digest != workspace.input_digest("copy") or not workspace.database.exists():
        refuse_unusable(source, warns=True)
    workspace.record_options("copy", options=foreign.to_record(), overwrite=overwrite)
    warned: tuple[StageWarning, ...] = ()
    before = workspace.input_digest("copy")
    if digest != before:
        if before:
            warning = StageWarning("database_changed", str(source))
            logger.warning("%s", Logged(warning.line))
            warned = (warning,)
        workspace.rewind()
        context.graph.forget()
        workspace.record_input_digests(copy=digest)
    if not workspace.database.exists():
        known = _copy(context, foreign)
        context.graph.forget()
        record_cameras(context.graph.cameras, workspace.cameras, known=known)
    record_cameras(context.graph.cameras, workspace.cameras)
    return warned


def _verify(
    context: Context, foreign: ForeignDatabase, verification: VerificationOptions
) -> int:
    """Verify the pairs that have matches only, and return how many they are."""
    database_path = context.workspace.database
    num_pairs = len(colmap_database.unverified_pairs(database_path))
    if num_pairs:
        logger.warning(
            "%s: %d pairs have matches only; they are verified now",
            foreign.path,
            num_pairs,
        )
    with context.progress.stage("verify", num_pairs, "pairs") as advance:
        verify(database_path, verification, advance=advance)
    context.graph.forget()
    return num_pairs


def _copy(context: Context, foreign: ForeignDatabase) -> Records:
    """Copy a database with what is given beside it; return records of given cameras."""
    records = Records()

    def change(database: pycolmap.Database) -> None:
        add_frames(database)
        records.update(foreign.initial_cameras().replace_cameras(database))
        if foreign.matches_path:
            _write_given_matches(context, foreign, database)
        elif not has_matches(foreign.path):
            database.clear_matches()  # rows of no matches

    copy_database(foreign.path, context.workspace.database, FATAL, change)
    return records


def _write_given_matches(
    context: Context, foreign: ForeignDatabase, database: pycolmap.Database
) -> None:
    """Write the matches of a file into the copy."""
    if not foreign.matches_path:
        return
    names = [
        image.name
        for image in database.read_all_images()
        if database.exists_keypoints(image.image_id)
    ]
    with (
        given_matches(foreign.matches_path, names, foreign.image_path) as found,
        context.progress.stage("matches", len(found.pairs), "pairs") as advance,
    ):
        write_given_matches(
            database, given=found, match_type=foreign.match_type, advance=advance
        )


def _match(context: Context, foreign: ForeignDatabase) -> None:
    """Match the images by their descriptors where nobody has matched any."""
    if foreign.matches_path or has_matches(foreign.path):
        if foreign.match_list_path:
            raise OptionError(
                f"{foreign.path} has matches already", where=Option("match-list-path")
            )
        return
    path = context.workspace.database
    names = described_images(path)
    if len(names) < 2:
        raise DatabaseError(
            "has no matches, nor descriptors to match by",
            where=foreign.path,
            advice=("match its images first, or give ", Option("matches-path")),
        )
    pairs = None
    if foreign.match_list_path:
        pairs = read_pairs(foreign.match_list_path, names, foreign.image_path)
    num = match_database(path, pairs, progress=context.progress)
    if num:
        logger.warning(
            "%s: has no matches; %d pairs are matched now", foreign.path, num
        )
