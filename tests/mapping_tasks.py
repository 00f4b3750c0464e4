"""Tasks of mappers whose cameras are given or not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import read_cameras
from colmap_affrect.mappers.base import MappingTask

WHOLE = CameraRecord(("a",), "given", 1300.0, size=(1024, 768), given=("focal", "distortion"))
"""All of a camera is given."""

NOTHING_KNOWN = MappingTask(Path("database.db"), None)
ALL_GIVEN = MappingTask(Path("database.db"), None, cameras={1: WHOLE})


def task_with_given_cameras(database_path: Path, **values: Any) -> MappingTask:
    """Return a task for a database whose cameras are all given."""
    cameras = {camera.camera_id: WHOLE for camera in read_cameras(database_path).values()}
    return MappingTask(database_path, database_path.parent, cameras=cameras, **values)
