"""Mend: what others have changed in the database of a folder since a command last worked there.

What the stores hold is made again, as little as possible: the rows that differ, or all where images
and cameras are not the same. What was meant is kept: pairs that were deleted, which do not come
back then, pose priors, intrinsics, rigs, and pairs of other programs.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path

import numpy as np

from colmap_affrect.colmap.cameras import read_camera_records, write_camera_records
from colmap_affrect.colmap.checks import FATAL, USELESS_KEYPOINTS, refuse_unusable
from colmap_affrect.colmap.database import all_cameras
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
from colmap_affrect.colmap.tables import Tables, delete_rows, open_read_only, read_tables
from colmap_affrect.errors import AffrectError, DatabaseError, such_as
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.outputs import database_files
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.copy import copy_verified
from colmap_affrect.stages.escalate import escalate
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.match import write_matches
from colmap_affrect.stages.pairs import delete_pairs, listed_pairs
from colmap_affrect.stages.verify import verify_matches, verify_new

logger = logging.getLogger(__name__)

UNUSABLE = FATAL | {"no-frame"}
NOTHING = np.zeros(0, np.int64)
RIGS = ("rigs", "rig_sensors", "frames", "frame_data")


@dataclass(frozen=True)
class Edits:
    """What others have changed in a database.

    Attributes:
        lost: why it cannot be used and must be made again, empty if it need not be.
        keypoints: ids of images whose keypoints differ from what was written.
        pairs: ids of pairs whose matches or geometries do.
        deleted: ids and names of pairs that were deleted.
        cameras: ids of cameras whose intrinsics were changed.
        others: what else was changed and is kept.
    """

    lost: tuple[str, ...] = ()
    keypoints: Indices = field(default_factory=NOTHING.copy)
    pairs: Indices = field(default_factory=NOTHING.copy)
    deleted: dict[int, Pair] = field(default_factory=dict)
    cameras: tuple[int, ...] = ()
    others: tuple[str, ...] = ()

    @property
    def written(self) -> str:
        """What is written again."""
        parts = [(len(self.keypoints), "image", "keypoints of "), (len(self.pairs), "pair", "")]
        return " and ".join(f"{of}{_counted(count, what)}" for count, what, of in parts if count)

    @property
    def kept(self) -> str:
        """What is kept."""
        texts = list(self.others)
        if self.deleted:
            names = such_as(" - ".join(pair) for pair in self.deleted.values())
            texts.append(f"{_counted(len(self.deleted), 'pair')} deleted ({names}), for good")
        if self.cameras:
            texts.append(f"intrinsics of cameras {such_as(map(str, self.cameras))}")
        return ", ".join(texts)

    def __str__(self) -> str:
        """Say what was changed."""
        return "; ".join(self.lost or filter(None, [self.written, self.kept]))


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
            mended = USELESS_KEYPOINTS if len(edits.keypoints) else frozenset()
            refuse_unusable(path, UNUSABLE - mended)
        return edits
    except AffrectError as error:
        text = str(error).removeprefix(f"{path}: ").partition(";")[0]
        return Edits((text,))
    except (TypeError, ValueError, OverflowError) as error:
        return Edits((f"damaged ({error})",))


def _edits(found: dict[str, Change], tables: Tables) -> Edits:
    lost = ["its tables are others"] * ("tables" in found)
    for part, what in (("images", tables.names), ("cameras", {})):
        if part in found:
            lost.append(_changed_rows(part, found[part], what))
    pairs = [found[part] for part in ("matches", "geometries") if part in found]
    if any(0 < change.num_before == len(change.gone) for change in pairs):
        lost.append("all pairs are gone")
    rigs, others = any(part in found for part in RIGS), list[str]()
    if rigs and not tables.names.keys() <= tables.frame_images:
        lost.append("images have no frames any more")
    gone = sorted({int(key) for change in pairs for key in change.gone})
    changed = np.unique(np.concatenate([NOTHING, *(change.changed for change in pairs)]))
    more = len({int(key) for change in pairs for key in change.added})
    others += ["rigs and frames"] * rigs + ["pose priors"] * ("priors" in found)
    others += [f"{_counted(more, 'pair')} more"] * bool(more)
    intrinsics = found["intrinsics"].changed.tolist() if "intrinsics" in found else ()
    return Edits(
        tuple(lost),
        found["keypoints"].keys if "keypoints" in found else NOTHING,
        np.setdiff1d(changed, gone),
        {} if lost else {key: tables.pair_names(key) for key in gone},
        tuple(intrinsics),
        tuple(others),
    )


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


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
    begun = workspace.begun
    if not begun or not (path.exists() or "verify" in begun):
        return
    found, is_copied = edits_of(path), workspace.is_copy
    if found and not str(found) and not (is_copied or has_seal(path)):
        found = Edits(_unlike_features(context))
    if not (found and str(found)):
        if found and has_seal(path):
            keep_seal(path)
        return
    if not is_copied:
        delete_pairs(workspace, found.deleted.values())
        found = _without_others(context, found)
    if found.lost or (found.written and is_copied):
        _make_again(context, found, begun, follows=follows)
        return
    for what, done in (found.kept, "which is kept"), (found.written, "and is written again"):
        if what:
            logger.warning("%s: was changed since the last run, %s: %s", path, done, what)
    remove_seal(path)  # what is deleted now was not by others
    pairs = np.concatenate([found.pairs, np.array(list(found.deleted), np.int64)])
    delete_rows(
        path, {"keypoints": found.keypoints, "matches": pairs, "two_view_geometries": pairs}
    )
    _keep_cameras(workspace, found.cameras)
    if found.written and "verify" in begun:
        try:
            write_matches(context, listed_pairs(context))
            verify_new(context)
        except AffrectError:
            workspace.rewind()  # half of it must not count as verified
            raise


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


def _without_others(context: Context, found: Edits) -> Edits:
    """Leave pairs alone that the stores do not hold: another program has added them."""
    if not len(found.pairs):
        return found
    with open_read_only(context.workspace.database) as connection:
        tables = read_tables(connection)
    ours = set(map(frozenset, listed_pairs(context)))
    are_ours = [frozenset(tables.pair_names(int(key))) in ours for key in found.pairs]
    return replace(found, pairs=found.pairs[np.array(are_ours)])


def _make_again(context: Context, found: Edits, begun: Sequence[str], *, follows: bool) -> None:
    workspace = context.workspace
    original = Path(workspace.require("copy")["database"]) if workspace.is_copy else None
    if original and not original.exists():
        raise DatabaseError(
            f"{workspace.database}: was changed since the last run ({found}), and {original} is "
            "gone, of which it is a copy; put that back, or give another by --from-database"
        )
    kept = _put_aside(workspace)
    logger.warning(
        "%s: was changed since the last run (%s); it is made again from %s%s",
        workspace.database,
        found,
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
    for camera in all_cameras(workspace.database):
        if camera.camera_id in changed and camera.camera_id in records:
            records[camera.camera_id] = replace(
                records[camera.camera_id],
                source="given",
                focal_px=float(camera.mean_focal_length()),
                why="changed in the database",
            )
    write_camera_records(workspace.cameras, records)
