"""Mend: a database that other programs have changed is made again from what it was made from.

The stores, or the database that was copied, are what is true. Each command leaves a *seal*, the
text file ``database.db.seal`` beside ``database.db``. It has a digest of the rows of the database,
a line of size and times of its file, and a digest of these two: while they fit, no row is read.
A database whose rows have another digest was changed by another program. While a command works
there is no seal, so that a killed one leaves none.
"""

import hashlib
import logging
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import (
    FATAL_AS_IT_IS,
    FATAL_BEFORE_MAPPING,
    refuse_unusable,
)
from colmap_affrect.colmap.image_import import record_cameras
from colmap_affrect.colmap.tables import damage_of, rows_digest
from colmap_affrect.errors import AffrectError, Logged, Words
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import database_files
from colmap_affrect.project.record import stamp_of
from colmap_affrect.project.regular_files import read_regular_text
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context
from colmap_affrect.stages.foreign import ForeignDatabase, import_and_verify
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.verify import update_verified, verify_matches

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Loss:
    """Why a database is not what the last command left."""

    kind: Literal["missing", "changed", "unusable"]
    fault: Words = ""  # that makes it unusable

    def words(self) -> Words:
        """Return it in words."""
        if self.kind == "missing":
            return "is missing"
        if self.kind == "changed":
            return "was changed since the last run"
        return ("cannot be used (", self.fault, ")")


CHANGED = Loss("changed")


@contextmanager
def mend_and_seal(
    context: Context,
    *,
    follows: bool = True,
    maps: bool = False,
    discards: bool = False,
) -> Iterator[None]:
    """Mend the database before a command works in a folder, keep it open, and seal it in the end.

    A database of the user is refused where COLMAP could not use it.

    Args:
        context: of the folder.
        follows: bring the database up to the last stage that was run; else the command does that.
        maps: the command only maps, and takes a changed database as it is, with a warning.
        discards: the command discards all there is, so that nothing need be mended.

    Raises:
        DatabaseError: the database cannot be used, and cannot be made again.
    """
    workspace = context.workspace
    path = workspace.database
    if workspace.users_database:
        _check_users_database(path)
        yield
        return
    sealed = _sealed(workspace)
    loss = None if discards else _loss_of(workspace, sealed)
    if maps and loss == CHANGED:
        _take_as_it_is(context)
        yield  # the seal stays: other commands make the database again
        return
    if loss:
        _make_again(context, loss, follows=follows)
    elif not discards:
        _know_digest(context, sealed)
    workspace.seal.unlink(missing_ok=True)
    try:
        with context.graph.keep_open():
            yield
    except AffrectError:
        if path.exists() and not damage_of(path):  # else it is looked through next time
            context.graph.forget()  # it may have been changed in part
            _seal(context)
        raise
    _seal(context)


def _check_users_database(path: Path) -> None:
    if path.exists() and path.stat().st_size:
        refuse_unusable(path, FATAL_BEFORE_MAPPING)


def _take_as_it_is(context: Context) -> None:
    """Have a database mapped that another program has changed."""
    workspace = context.workspace
    refuse_unusable(workspace.database, FATAL_AS_IT_IS)
    logger.warning(
        "%s: %s, and is mapped as it is", workspace.database, CHANGED.words()
    )
    workspace.is_changed = True
    record_cameras(context.graph.cameras, workspace.cameras)


def _seal(context: Context) -> None:
    """Write the digest and the stamp of the database beside it."""
    workspace = context.workspace
    path = workspace.database
    if path.exists() and workspace.started_stages:
        # One that is not sealed is looked through next time.
        with suppress(AffrectError):
            # The stamp first: what another program writes meanwhile is noticed next time.
            stamp = _stamp(path)
            lines = [context.graph.digest(), stamp]
            seal = "\n".join([*lines, _digest_of_seal(lines)])
            replace_text(workspace.seal, f"{seal}\n")


def _sealed(workspace: Workspace) -> list[str]:
    """Return the lines of the seal that the last command left, none without."""
    with suppress(OSError, UnicodeDecodeError):
        return read_regular_text(workspace.seal).splitlines()
    return []


def _know_digest(context: Context, sealed: Sequence[str]) -> None:
    """Take the digest of a seal that is whole and was left beside this database."""
    path = context.workspace.database
    if sealed[1:] == [_stamp(path), _digest_of_seal(sealed[:2])]:
        context.graph.know_digest(sealed[0])


def _digest_of_seal(lines: Sequence[str]) -> str:
    """Return the last line of a seal, another one where COLMAP may migrate the database."""
    text = "\n".join([*lines, pycolmap.__version__])
    return hashlib.sha256(text.encode()).hexdigest()


def _stamp(path: Path) -> str:
    """Return size and times of a database and of its write-ahead log."""
    return stamp_of(database_files(path)[:2])


def _loss_of(workspace: Workspace, sealed: Sequence[str]) -> Loss | None:
    """Return why the database is not what the last command left, None if it is."""
    path = workspace.database
    begun = workspace.started_stages
    if not path.exists():
        return Loss("missing") if "verify" in begun else None
    if not begun or _stamp(path) in sealed:
        return None
    try:
        fault = damage_of(path)  # of an index perhaps, which rows do not show
        if fault:
            return Loss("unusable", fault)
        if sealed:
            return None if rows_digest(path) in sealed else CHANGED
        # A command was killed: is what it wrote good?
        refuse_unusable(path, FATAL_AS_IT_IS)
    except AffrectError as error:
        return CHANGED if sealed else Loss("unusable", error.what)
    return None


def _make_again(context: Context, loss: Loss, *, follows: bool) -> None:
    """Put a database aside, and make it again from what it was made from."""
    workspace = context.workspace
    begun = workspace.started_stages
    foreign = None
    source = f"{workspace.features.name} and {workspace.matches.name}"
    if workspace.is_foreign:
        foreign = ForeignDatabase.of_record(workspace.require("copy"))
        source = str(foreign.path)
    hint = ""
    kept = _put_aside(workspace.database)
    if kept:
        again = f"map --from-database {shlex.quote(str(kept))} --output-path OTHER"
        hint = f"; 'colmap-affrect {again}' maps what was there"
    logger.warning(
        "%s: %s; it is made again from %s%s",
        workspace.database,
        Logged(loss.words()),
        source,
        hint,
    )
    workspace.rewind()
    context.graph.forget()
    if not (follows and "verify" in begun):
        return
    if foreign:
        import_and_verify(context, foreign, context.verification)
        return
    verify_matches(context)
    if "escalate" in begun:
        update_verified(context, pairs=context.listed_pairs(), replaces=True)
    if "guide" in begun:
        guide(context)


def _put_aside(path: Path) -> Path | None:
    """Rename a database that others have changed, and return its new name, None if it is gone."""
    if not path.exists():
        return None
    kept = path.with_name("database.changed.db")
    numbers = count(1)
    while kept.exists():
        kept = path.with_name(f"database.changed{next(numbers)}.db")
    for file, target in zip(database_files(path), database_files(kept), strict=True):
        if file.exists():
            file.replace(target)
    return kept
