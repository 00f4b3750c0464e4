"""Images and their cameras come into a database: what COLMAP reads, and what is on record of it."""

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import (
    CameraRecord,
    Source,
    read_camera_records,
    write_camera_records,
)
from colmap_affrect.colmap.cancellable import run_cancellable
from colmap_affrect.colmap.database import (
    cameras_of_images,
    image_ids,
    open_database,
    require_database_space,
    write_frame,
)
from colmap_affrect.colmap.initial_cameras import Group, InitialCameras, Size, focal_of
from colmap_affrect.errors import lacks_memory, such_as
from colmap_affrect.images.photographs import CameraOptions, require_folder
from colmap_affrect.images.reading import why_unusable
from colmap_affrect.project.outputs import database_files, remove_own, temporary_folder

MAX_LINES = 5  # display: lines of cameras that are logged; report.json says all

logger = logging.getLogger(__name__)


def import_images(
    path: Path, image_path: Path, names: Sequence[str], options: CameraOptions
) -> list[str]:
    """Add cameras, rigs, frames and images for the names that a database lacks.

    Sizes and GPS priors are read by COLMAP, from the files as stored, not rotated. Images that
    are added later share cameras as if all had been added at once. All of them are added, or none;
    a new database appears with them.

    Args:
        path: the database.
        image_path: folder of the images.
        names: of the images that the database should have.
        options: what the user says of their cameras.

    Returns:
        The names of the images that COLMAP cannot read, or whose size is not that of their camera.

    Raises:
        OptionError: the folder of the images is gone.
    """
    initial = InitialCameras(image_path, options)
    is_new = not path.exists()
    if is_new:
        remove_own(database_files(path))  # what is beside it, of one that was removed
    with temporary_folder(path.parent) as folder:
        new = folder / "new.db" if is_new else path
        read = folder / "read.db"
        known = set[str]() if is_new else set(image_ids(new))
        missing = list[str]()
        for name in sorted(set(names) - known):
            if not why_unusable(image_path / name):
                missing.append(name)
        if missing:
            require_database_space(new, 2 * len(missing))
            with open_database(read) as found:  # which makes it
                _read_images(read, image_path, missing)
                # The one that was read has taken its room.
                require_database_space(new, len(missing))
                with open_database(new) as database:
                    known.update(_copy_images(initial, found, database))
        if not new.exists():
            image_ids(new)  # makes an empty one
        if is_new:
            new.replace(path)
    return sorted(set(names) - known)


def _read_images(path: Path, image_path: Path, names: Sequence[str]) -> None:
    """Let COLMAP read images into a database; OptionError where their folder is gone meanwhile."""
    mode = pycolmap.CameraMode.PER_IMAGE
    try:
        run_cancellable(lambda _: pycolmap.import_images(path, image_path, mode, names))
    except (RuntimeError, ValueError) as error:
        if lacks_memory(error) or image_path.is_dir():
            raise
        require_folder(image_path)  # it is gone, as with a drive


def _copy_images(
    initial: InitialCameras, found: pycolmap.Database, database: pycolmap.Database
) -> list[str]:
    """Copy images that COLMAP has read into a database of their own: all of them, or none.

    Returns:
        The names of those that fit the cameras.
    """
    copied = list[str]()
    images = sorted(found.read_all_images(), key=lambda image: image.name)
    read = cameras_of_images(found)
    sizes = dict[str, Size]()
    for image in images:
        camera = read[image.image_id]
        sizes[image.name] = (camera.width, camera.height)
    priors = {prior.corr_data_id.id: prior for prior in found.read_all_pose_priors()}
    rigs = {rig.ref_sensor_id: rig.rig_id for rig in database.read_all_rigs()}
    with pycolmap.DatabaseTransaction(database):
        cameras = _cameras_of_groups(initial, database, sizes)
        for image in images:
            camera = cameras[initial.group(image.name)]
            if sizes[image.name] != (camera.width, camera.height):
                continue
            written = pycolmap.Image(name=image.name, camera_id=camera.camera_id)
            written.image_id = database.write_image(written)
            write_frame(database, written, rigs)
            prior = priors.get(image.image_id)
            if prior:
                prior.corr_data_id = written.data_id
                database.write_pose_prior(prior)
            copied.append(image.name)
    return copied


def _cameras_of_groups(
    initial: InitialCameras, database: pycolmap.Database, sizes: Mapping[str, Size]
) -> dict[Group, pycolmap.Camera]:
    """Return the camera of each group of images, which is written if the database lacks it."""
    cameras = _known_cameras(initial, database)
    for group, names in initial.groups(list(sizes)).items():
        if group not in cameras:
            size = sizes[names[0]]
            same_size = [name for name in names if sizes[name] == size]
            camera, _ = initial.camera(same_size, size)
            camera.camera_id = database.write_camera(camera)
            cameras[group] = camera
    return cameras


def _known_cameras(
    initial: InitialCameras, database: pycolmap.Database
) -> dict[Group, pycolmap.Camera]:
    """Return the cameras of the database that new images of a group get."""
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    used: dict[Group, set[int]] = defaultdict(set)
    for image in database.read_all_images():
        used[initial.group(image.name)].add(image.camera_id)
    return {group: cameras[min(ids)] for group, ids in used.items() if len(ids) == 1}


def record_cameras(
    cameras_of: Mapping[str, pycolmap.Camera],
    records_path: Path,
    initial: InitialCameras | None = None,
    known: Mapping[int, CameraRecord] | None = None,
) -> None:
    """Put the cameras that are not on record yet on record, and log what is worth knowing of them.

    Args:
        cameras_of: the cameras of the database by image name.
        records_path: the file of the records.
        initial: what they were made from; None for cameras of another database.
        known: the records of that one, if there are any.
    """
    before = read_camera_records(records_path)
    known = before or known or {}
    names: dict[int, list[str]] = defaultdict(list)
    cameras = dict[int, pycolmap.Camera]()
    for name, camera in cameras_of.items():
        names[camera.camera_id].append(name)
        cameras[camera.camera_id] = camera
    records = dict[int, CameraRecord]()
    for camera_id, of_camera in names.items():
        record = known.get(camera_id)
        same = tuple(sorted(of_camera))
        if record and set(record.names) <= set(same):
            records[camera_id] = replace(record, names=same)
        else:
            records[camera_id] = _record(cameras[camera_id], same, initial)
    if records != before:
        write_camera_records(records_path, records)
        _log_reasons(before, records)


def _log_reasons(
    before: Mapping[int, CameraRecord], records: Mapping[int, CameraRecord]
) -> None:
    """Log what was decided of cameras that are new or have changed."""
    names: defaultdict[str, list[str]] = defaultdict(list)
    for camera_id, record in records.items():
        if record.why and record != before.get(camera_id):
            names[record.why] += record.names
    for why, concerned in list(names.items())[:MAX_LINES]:
        logger.info("cameras: %s: %s", such_as(concerned), why)


def _record(
    camera: pycolmap.Camera, names: tuple[str, ...], initial: InitialCameras | None
) -> CameraRecord:
    """Say what is known of a camera: as it was made here, or only by COLMAP's flag."""
    size = (camera.width, camera.height)
    if initial:
        made, record = initial.camera(names, size)
        if _values(made) == _values(camera):
            return record
    source: Source = "given" if camera.has_prior_focal_length else "guess"
    return CameraRecord(
        names=names, source=source, focal_px=focal_of(camera), size=size
    )


def _values(camera: pycolmap.Camera) -> tuple[object, ...]:
    return camera.model_name, camera.params.tolist(), camera.has_prior_focal_length
