"""Mend: what others have changed in the database of a folder since a command last worked there.

A database that does not hold what the stores do is made again. What was meant is kept: pairs that
were deleted, which do not come back then, pose priors, intrinsics, rigs, and pairs of other
programs.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.cameras import read_camera_records, write_camera_records
from colmap_affrect.colmap.checks import FATAL, refuse_unusable
from colmap_affrect.colmap.seal import (
    Change,
    begin_work,
    changes,
    end_work,
    has_seal,
    is_untouched,
    keep_seal,
    remove_seal,
)
from colmap_affrect.colmap.tables import Tables, open_read_only, pair_images, read_tables
from colmap_affrect.errors import AffrectError, DatabaseError, such_as
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.outputs import database_files
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.copy import copy_verified
from colmap_affrect.stages.escalate import escalate
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.pairs import delete_pairs
from colmap_affrect.stages.verify import verify_matches

logger = logging.getLogger(__name__)

UNUSABLE = FATAL | {"no-frame"}
RIGS = ("rigs", "rig_sensors", "frames", "frame_data")


@dataclass(frozen=True)
class Edits:
    """What others have changed in a database.

    Attributes:
        lost: why it must be made again, empty if it need not be.
        changed_pairs: what of matches and geometries was changed, empty if nothing was.
        deleted: ids and names of pairs that were deleted.
        cameras: ids of cameras whose intrinsics were changed.
        others: what else was changed and is kept.
    """

    lost: tuple[str, ...] = ()
    changed_pairs: tuple[str, ...] = ()
    deleted: dict[int, Pair] = field(default_factory=dict)
    cameras: tuple[int, ...] = ()
    others: tuple[str, ...] = ()

    @property
    def kept(self) -> str:
        """What is kept."""
        texts = list(self.others)
        if self.deleted:
            names = such_as(" - ".join(pair) for pair in self.deleted.values())
            texts.append(f"{_counted_pairs(len(self.deleted))} deleted ({names}), for good")
        if self.cameras:
            texts.append(f"intrinsics of cameras {such_as(map(str, self.cameras))}")
        return ", ".join(texts)

    def __str__(self) -> str:
        """Say what was changed."""
        return "; ".join(filter(None, self.lost or [*self.changed_pairs, self.kept]))


def edits_of(path: Path) -> Edits | None:
    """Return what others have changed in a database of ours; None if nobody touched it."""
    if not path.exists():
        return Edits(("it is missing",))
    if is_untouched(path):
        return None
    try:
        found = changes(path)
        with open_read_only(path) as connection:
            edits = _edits(found, read_tables(connection))
        if not edits.lost:
            refuse_unusable(path, UNUSABLE)
        return edits
    except AffrectError as error:
        text = str(error).removeprefix(f"{path}: ").partition(";")[0]
        return Edits((text,))
    except (TypeError, ValueError, OverflowError) as error:
        return Edits((f"damaged ({error})",))


def _edits(found: dict[str, Change], tables: Tables) -> Edits:
    lost = ["its tables are others"] * ("tables" in found)
    for part, names in (("images", tables.names), ("cameras", {}), ("keypoints", tables.names)):
        if part in found:
            lost.append(_changed_rows(part, found[part], names))
    pairs = {part: found[part] for part in ("matches", "geometries") if part in found}
    if any(0 < change.num_before == len(change.gone) for change in pairs.values()):
        lost.append("all pairs are gone")
    rigs = any(part in found for part in RIGS)
    if rigs and not tables.names.keys() <= tables.frame_images:
        lost.append("images have no frames any more")
    gone = sorted({int(key) for change in pairs.values() for key in change.gone})
    more = len({int(key) for change in pairs.values() for key in change.added})
    others = ["rigs and frames"] * rigs + ["pose priors"] * ("priors" in found)
    others += [f"{_counted_pairs(more)} more"] * bool(more)
    changed = {part: len(set(change.changed) - set(gone)) for part, change in pairs.items()}
    return Edits(
        tuple(lost),
        tuple(f"{part}: {number} changed" for part, number in changed.items() if number),
        {} if lost else {key: tables.pair_names(key) for key in gone},
        tuple(found["intrinsics"].changed.tolist() if "intrinsics" in found else ()),
        tuple(others),
    )


def _counted_pairs(number: int) -> str:
    return f"{number} pair{'s' * (number != 1)}"


def _changed_rows(part: str, change: Change, names: dict[int, str]) -> str:
    parts = [(change.changed, "changed"), (change.added, "added"), (change.gone, "gone")]
    texts = [
        f"{len(keys)} {what}"
        + (f" ({such_as(names[key] for key in keys.tolist())})" if keys[0] in names else "")
        for keys, what in parts
        if len(keys)
    ]
    return f"{part}: {', '.join(texts)}"


@contextmanager
def watched(context: Context, *, follows: bool = True, discards: bool = False) -> Iterator[None]:
    """Mend the database before a command works in a folder, and seal it in the end.

    ``follows``: bring it up to the last stage that was run; else the command does that. One that
    ``discards`` all there is needs nothing mended. A database of the user is never mended, but
    refused where COLMAP could not use it.
    """
    workspace, path = context.workspace, context.workspace.database
    if workspace.users_database:
        if path.exists() and path.stat().st_size:
            refuse_unusable(path)
        yield
        return
    if not discards:
        mend(context, follows=follows)
    begin_work(path)
    try:
        yield
    except BaseException:
        with suppress(AffrectError):
            end_work(path, reads=False)
        raise
    with suppress(AffrectError):  # one that is not sealed is looked at next time
        end_work(path)


def mend(context: Context, *, follows: bool) -> None:
    """Make again, or keep, what others have changed in the database; a warning says what."""
    workspace, path = context.workspace, context.workspace.database
    begun, is_copied = workspace.begun, workspace.is_copy
    if not begun or not (path.exists() or "verify" in begun):
        return
    edits, is_sealed = edits_of(path), has_seal(path)
    if edits and not str(edits) and not (is_copied or is_sealed):
        edits = Edits(_unlike_features(context))
    if not edits or not str(edits):
        if edits and is_sealed:
            keep_seal(path)
        return
    if not is_copied:
        delete_pairs(workspace, edits.deleted.values())
    # Before pairs are matched here those in the database are of other programs.
    lost = edits.lost or (edits.changed_pairs if is_copied or "match" in begun else ())
    if lost:
        _make_again(context, "; ".join(lost), begun, follows=follows)
        return
    logger.warning("%s: was changed since the last run, which is kept: %s", path, edits)
    remove_seal(path)  # what is deleted now was not by others
    with colmap_database.open_database(path) as database:
        for images in map(pair_images, edits.deleted):
            database.delete_matches(*images)
            database.delete_two_view_geometry(*images)
    _keep_cameras(workspace, edits.cameras)


def _unlike_features(context: Context) -> tuple[str, ...]:
    """Return which images are not those of the features, where a killed run has left no seal."""
    with open_read_only(context.workspace.database) as connection:
        tables = read_tables(connection)
    sizes, found = context.features.image_sizes(), list[str]()
    for image_id, name in tables.names.items():
        camera = tables.cameras[tables.camera_ids[image_id]]
        if name not in sizes and not context.workspace.require("extract")["from_database"]:
            found.append(f"images: {name} has no features")
        elif sizes.get(name, (camera.width, camera.height)) != (camera.width, camera.height):
            found.append(f"cameras: that of {name} has another size")
    return tuple(found[:1])


def _make_again(context: Context, why: str, begun: Sequence[str], *, follows: bool) -> None:
    workspace = context.workspace
    original = Path(workspace.require("copy")["database"]) if workspace.is_copy else None
    if original and not original.exists():
        raise DatabaseError(
            f"{workspace.database}: was changed since the last run ({why}), and {original} is "
            "gone, of which it is a copy; put that back, or give another by --from-database"
        )
    kept = _put_aside(workspace)
    logger.warning(
        "%s: was changed since the last run (%s); it is made again from %s%s",
        workspace.database,
        why,
        original or f"{workspace.features.name} and {workspace.matches.name}",
        f", what was there is {kept.name}" if kept else "",
    )
    workspace.rewind()
    if not (follows and "verify" in begun):
        return
    if original:
        copy_verified(context, original, workspace.photographs(), context.verification)
        return
    verify_matches(context)
    if "escalate" in begun:
        escalate(context)
    if "guide" in begun:
        guide(context)


def _put_aside(workspace: Workspace) -> Path | None:
    """Rename a database that others have changed, and return its new name, None if it is gone."""
    if not workspace.database.exists():
        return None
    names = (f"database.changed{number or ''}.db" for number in count())
    kept = next(path for name in names if not (path := workspace.path / name).exists())
    for file, target in zip(database_files(workspace.database), database_files(kept), strict=True):
        if file.exists():
            file.replace(target)
    return kept


def _keep_cameras(workspace: Workspace, changed: Sequence[int]) -> None:
    """Count intrinsics that were changed in the database as known: mapping keeps them."""
    if not changed:
        return
    records = read_camera_records(workspace.cameras)
    for camera in colmap_database.all_cameras(workspace.database):
        if camera.camera_id in changed and camera.camera_id in records:
            records[camera.camera_id] = replace(
                records[camera.camera_id],
                source="given",
                focal_px=float(camera.mean_focal_length()),
                why="changed in the database",
            )
    write_camera_records(workspace.cameras, records)
