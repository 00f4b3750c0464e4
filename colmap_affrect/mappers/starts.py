"""Focal lengths that mapping starts from where nobody knows them, and cameras that ran away."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.camera_vote import apply_cameras, apply_records
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import all_cameras, open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.project.report import ModelSummary

MIN_STEP = 1.15
"""Starts that are nearer to one another end in the same model."""

MIN_SHARE_OF_RIVAL = 0.97
"""Of the best attempt's agreement with the pairs; attempts that come so near are as good as it."""

USUAL_LENSES = 0.7, 2.4
"""Longer sides: 24 and 85 mm of small film. What pairs that do not tell a focal length well say of
it may leave out the truth, but they are hardly needed to leave out others."""

MAX_EXCESS = 1.5
"""How far beyond its interval a focal length may be refined; a camera that few points see goes
anywhere."""


@dataclass(frozen=True)
class Start:
    """Where an attempt starts from.

    Attributes:
        focals_px: focal lengths by camera id; others are as in the database.
        records: cameras that images share, in the place of those of the database; empty for these.
        distortion_held: few points of long lenses take any distortion for focal length.
    """

    focals_px: Mapping[int, float] = field(default_factory=dict)
    records: Mapping[int, CameraRecord] = field(default_factory=dict)
    distortion_held: bool = False


def starts(task: MappingTask) -> list[Start]:
    """Return where to start from: as the task is, and where cameras are unknown from elsewhere.

    That is: with one camera for images of one size that may share one, first of all since it is
    the simplest; without distortion; from focal lengths halfway to both ends of what the pairs
    allow, for all unknown cameras at once; and from a long lens, which mapping that starts from a
    short one hardly ever ends with. Cameras that are held stay as they are.
    """
    free = {key: record for key, record in task.cameras.items() if key not in task.held}
    unknown = unknown_cameras(replace(task, cameras=free))
    found = [Start()]
    if unknown:
        found.append(Start(distortion_held=True))
    shared = _shared(free)
    if shared:
        found.insert(0, Start(records=shared, distortion_held=True))
    ends = [_halfway(unknown, side) for side in ("low_px", "high_px")]
    for focals in [*ends, {key: _usual(record)[1] for key, record in unknown.items()}]:
        moved = {
            key: focal
            for key, focal in focals.items()
            if max(focal, unknown[key].focal_px) > MIN_STEP * min(focal, unknown[key].focal_px)
        }
        if moved:
            found.append(Start(moved, distortion_held=True))
    return found


def unknown_cameras(task: MappingTask) -> dict[int, CameraRecord]:
    """Return the cameras that nobody knows, and of which pairs tell something."""
    return {
        key: record
        for key, record in task.cameras.items()
        if record.source == "guess" and record.low_px is not None
    }


def _shared(records: Mapping[int, CameraRecord]) -> dict[int, CameraRecord]:
    """Return the records if images of one size share a camera wherever they may; empty if none."""
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for key in sorted(records):
        if records[key].may_be_shared:
            groups[records[key].size].append(key)
    merged = dict(records)
    for keys in groups.values():
        same = [merged.pop(key) for key in keys]
        merged[keys[0]] = replace(
            same[0],
            names=tuple(sorted(name for record in same for name in record.names)),
            focal_px=float(np.exp(np.mean([np.log(record.focal_px) for record in same]))),
        )
    return merged if len(merged) < len(records) else {}


def _halfway(records: Mapping[int, CameraRecord], side: str) -> dict[int, float]:
    ends = ((key, record.focal_px, getattr(record, side)) for key, record in records.items())
    return {key: float((focal * end) ** 0.5) for key, focal, end in ends if end}


def _usual(record: CameraRecord) -> tuple[float, float]:
    """Return the focal lengths in px that usual lenses have."""
    longer = max(record.size)
    return USUAL_LENSES[0] * longer, USUAL_LENSES[1] * longer


def started(task: MappingTask, start: Start, path: Path) -> MappingTask:
    """Return a task that starts from elsewhere, with a database of its own where that needs one.

    Args:
        task: as it is.
        start: from where.
        path: where the database goes; one that is there is replaced.
    """
    task = replace(task, distortion_held=start.distortion_held)
    focals = start.focals_px
    if not focals and not start.records:
        return task
    path.unlink(missing_ok=True)
    copy_database(task.database_path, path)
    if start.records:
        apply_records(path, start.records)
    with open_database(path) as database:
        for camera in database.read_all_cameras():
            for index in camera.focal_length_idxs() if camera.camera_id in focals else ():
                camera.params[index] = focals[camera.camera_id]
            database.update_camera(camera)
    return replace(task, database_path=path, snapshot_path=None)


def holding(
    task: MappingTask, model: pycolmap.Reconstruction, summary: ModelSummary, path: Path
) -> MappingTask:
    """Return a task whose images have the cameras of a model that has registered them.

    These are held; what is known of cameras that have no images any more is left out.

    Args:
        task: as it is.
        model: of the same images.
        summary: of the model.
        path: where the database of the new task goes.
    """
    copy_database(task.database_path, path)
    held = task.held | apply_cameras(path, model)
    left = {camera.camera_id for camera in all_cameras(path)}
    return replace(
        task,
        database_path=path,
        snapshot_path=None,
        cameras={key: record for key, record in task.cameras.items() if key in left},
        held=held,
        told_by=summary,
    )


def runaways(model: pycolmap.Reconstruction, task: MappingTask) -> set[int]:
    """Return the ids of cameras that were refined far beyond what their pairs allow."""
    used = {model.images[image_id].camera_id for image_id in model.reg_image_ids()}
    return {
        key
        for key, record in task.cameras.items()
        if key in used and not is_within(model.cameras[key].mean_focal_length(), record)
    }


def focals_px(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Return the focal length of the camera of each registered image."""
    images = (model.images[image_id] for image_id in model.reg_image_ids())
    return {image.name: model.cameras[image.camera_id].mean_focal_length() for image in images}


def rival_focals_px(
    attempts: Sequence[tuple[float, Mapping[str, float]]],
) -> dict[str, tuple[float, float]]:
    """Return lowest and highest focal length of images for which the best attempts differ.

    Args:
        attempts: how well each agrees with the verified pairs, and its focal lengths by image.
    """
    least = MIN_SHARE_OF_RIVAL * max(score for score, _ in attempts)
    rivals: dict[str, list[float]] = defaultdict(list)
    for score, focals in attempts:
        if score >= least:
            for name, focal in focals.items():
                rivals[name].append(focal)
    spreads = {name: (min(focals), max(focals)) for name, focals in sorted(rivals.items())}
    return {name: spread for name, spread in spreads.items() if spread[1] > MIN_STEP * spread[0]}


def is_within(focal_px: float, record: CameraRecord) -> bool:
    """Tell whether a focal length agrees with what is on record of it; so does any without."""
    if record.low_px is None or record.high_px is None:
        return True
    low, high = record.low_px, record.high_px
    if record.source == "guess":
        usual = _usual(record)
        low, high = min(low, usual[0]), max(high, usual[1])
    return low / MAX_EXCESS <= focal_px <= high * MAX_EXCESS
