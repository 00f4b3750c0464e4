"""Snapshots of a long mapping, from which it goes on after it has been killed."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap.model_files import registered_names, require_intact
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.errors import StoreError
from colmap_affrect.mappers.base import MapperOptions, MappingTask
from colmap_affrect.options import digest_of
from colmap_affrect.project.outputs import remove_own

logger = logging.getLogger(__name__)

SNAPSHOT_FRAMES = 100
"""Images between two snapshots. A model of so many images is kept whatever comes after it, so that
mapping can go on from a snapshot of it; resource."""
MAX_SNAPSHOTS = 10
"""Of one mapping: writing one takes time in proportion to the images that there are. A kill
loses what came after the last complete one; resource."""
# A snapshot may be incomplete when a run is killed; the one before is complete; theory
NUM_KEPT = 2


@contextmanager
def with_snapshots(
    task: MappingTask, options: MapperOptions, folder: Path, num_images: int
) -> Iterator[MappingTask]:
    """Give a task a folder for snapshots; it is removed when mapping has ended.

    Those that an interrupted mapping of the same pairs and cameras with the same options has left
    are kept until then. Small sets and models that are extended have none.

    Args:
        task: What is mapped.
        options: Of the mapper.
        folder: Of all snapshots; there is one for each task in it.
        num_images: Of the database.
    """
    # So few images have no two snapshots; sparse.MIN_LARGE_SET says how they are mapped
    if num_images < SNAPSHOT_FRAMES or task.extend:
        yield task
        return
    given = {str(key): record.given for key, record in task.cameras.items()}
    own = folder / digest_of(
        [rows_digest(task.database_path), options.to_mapping(), given]
    )
    remove_own(path for path in folder.glob("*") if path != own)
    own.mkdir(parents=True, exist_ok=True)
    try:
        yield replace(task, snapshot_path=own)
    except BaseException:
        is_empty = not any(own.iterdir())
        if is_empty:
            remove_own([folder])
        raise
    remove_own([folder])


def frames_between_snapshots(num_images: int) -> int:
    """Return the number of images from one snapshot to the next.

    Args:
        num_images: Of all that is mapped.
    """
    return max(SNAPSHOT_FRAMES, num_images // MAX_SNAPSHOTS)


def largest_snapshot(folder: Path) -> Path | None:
    """Return the complete snapshot with most images, of several the newest."""
    found: list[tuple[int, str, Path]] = []
    for path in folder.iterdir():
        with suppress(StoreError):
            require_intact(path)
            found.append((len(registered_names(path)), path.name, path))
    if not found:
        return None
    num_images, _, path = max(found)
    logger.info("mapping goes on from a snapshot of %d images", num_images)
    return path


def drop_old_snapshots(folder: Path) -> None:
    """Remove all but the newest snapshots of the largest models."""
    older = sorted(path for path in folder.iterdir() if path.is_dir())[:-1]
    # The newest one may be incomplete.
    complete = [path for path in older if (path / "frames.bin").exists()]
    complete.sort(key=lambda path: ((path / "frames.bin").stat().st_size, path.name))
    remove_own(complete[: -(NUM_KEPT - 1)])
