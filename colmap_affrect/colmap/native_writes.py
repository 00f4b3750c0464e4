"""Files that pycolmap writes: its errors of many kinds become one line that names the file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from colmap_affrect.errors import lacks_memory, reason
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.outputs import SPARE_BYTES


@contextmanager
def native_writes(path: Path) -> Iterator[None]:
    """Say that a file or folder cannot be written, and why, where pycolmap fails at it.

    Raises WorkspaceError. Only what pycolmap writes belongs into the block: it does not say whether
    it failed at reading.
    """
    try:
        yield
    except (RuntimeError, ValueError, OSError) as error:
        if lacks_memory(error):
            raise
        raise why_not_written(path, error) from error


def why_not_written(path: Path, error: Exception) -> Exception:
    """Return the error for a file that pycolmap has not written: the disk is full, or its own."""
    folder = path.absolute().parent
    while not folder.is_dir():
        folder = folder.parent
    try:
        require_space(folder / "rest", SPARE_BYTES, path)
    except Exception as full:  # noqa: BLE001 - it is returned
        return full
    return cannot_write(path, RuntimeError(reason(error)))
