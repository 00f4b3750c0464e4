"""COLMAP models: files walked through, compared with their digests, read, written; their poses.

pycolmap's reader never ends, takes all memory or ends the process where a count in a file is wrong.
So every record is followed to its end first. Models of ours have digests of files beside them.
"""

import json
import math
import os
import posixpath
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from colmap_affrect import errors
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.native_writes import native_writes, why_not_written
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.project.record import file_sha256
from colmap_affrect.project.regular_files import (
    open_regular,
    read_regular_text,
    require_regular,
)

Pose = tuple[Array, Array]  # cam_from_world: rotation matrix and translation
Poses = dict[str, Pose]  # poses by image name

# Of a photograph; the largest panoramas have a tenth of it; damage
MAX_SIDE_PX = 1 << 24
# Coordinates beyond it are no positions: nothing can be computed with them; damage
FAR = 1e12
MAX_TEXT_BYTES = 1 << 14  # of the name of an image: no system has longer paths; format
# Of keypoints: where they are, and which point they see; format
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
ROWS_AT_ONCE = 1 << 16  # of keypoints that are in memory; resource
QUATERNION_ERROR = 1e-3  # of the length of one, which text rounds; numeric
# File beside a model of ours, which has the digests of its files as ``model``
SUMMARY = "summary.json"


class _Reader:
    """Follows the records of a file; EOFError where one goes beyond its end.

    Memory has a small part of it, whatever the size of the file.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.size = file.seek(0, os.SEEK_END)
        self.position = 0

    def skip(self, num_bytes: int) -> int:
        """Go on, and return where that was."""
        start = self.position
        self.position += num_bytes
        if self.position > self.size:
            raise EOFError
        return start

    def take(self, codes: str) -> tuple[Any, ...]:
        """Read values by their codes of :mod:`struct`."""
        layout = f"<{codes}"
        start = self.skip(struct.calcsize(layout))
        self.file.seek(start)
        return struct.unpack(layout, self.file.read(struct.calcsize(layout)))

    def rows(self, count: int, layout: np.dtype[np.void]) -> Iterator[NDArray[np.void]]:
        """Yield the rows of an array, some at a time.

        Args:
            count: number of them all.
            layout: of one.
        """
        start = self.skip(layout.itemsize * count)
        self.file.seek(start)
        for first in range(0, count, ROWS_AT_ONCE):
            num_rows = min(ROWS_AT_ONCE, count - first)
            data = self.file.read(layout.itemsize * num_rows)
            yield np.frombuffer(data, layout)

    def text(self) -> str:
        """Read a text that ends with a 0."""
        self.file.seek(self.position)
        text, end, _ = self.file.read(MAX_TEXT_BYTES).partition(b"\0")
        if not end:
            raise EOFError
        self.skip(len(text) + 1)
        return text.decode("utf-8")


@cache
def camera_like(model: int) -> pycolmap.Camera | None:
    """Return a camera of a model of COLMAP by its number, None if there is no such model."""
    try:
        return pycolmap.Camera.create_from_model_id(
            1, pycolmap.CameraModelId(model), 1.0, 1, 1
        )
    except (ValueError, RuntimeError, TypeError):
        return None


def _camera(reader: _Reader) -> None:
    _, model, *_ = reader.take("IiQQ")
    like = camera_like(model)
    if like is None:
        raise ValueError("a camera is of no model of COLMAP")
    reader.take(f"{len(like.params)}d")


def _rig(reader: _Reader) -> None:
    _, num_sensors = reader.take("II")
    for number in range(num_sensors):
        reader.take("iI")
        is_reference = number == 0  # which has no pose
        if not is_reference and reader.take("B")[0]:
            reader.take("7d")


def _frame(reader: _Reader) -> None:
    reader.take("II7d")
    (num_data,) = reader.take("I")
    for _ in range(num_data):
        reader.take("iIQ")


def _image(reader: _Reader) -> str:
    reader.take("I7dI")
    name = reader.text()
    (num_keypoints,) = reader.take("Q")
    for rows in reader.rows(num_keypoints, KEYPOINT):
        if not (np.abs(rows["xy"]) < FAR).all():
            raise ValueError(f"a keypoint of {name} is at no finite place")
    return name


def _point(reader: _Reader) -> None:
    # Id, position, colour, error, length of the track
    *_, length = reader.take("Q3d3BdQ")
    reader.skip(8 * length)


# Functions that read one record, by file of a model
RECORDS: dict[str, Callable[[_Reader], Any]] = {
    "cameras.bin": _camera,
    "rigs.bin": _rig,
    "frames.bin": _frame,
    "images.bin": _image,
    "points3D.bin": _point,
}
# Of COLMAP before it knew rigs
OLD_RECORDS = ("cameras.bin", "images.bin", "points3D.bin")


def _read_records(path: Path) -> list[Any]:
    """Read all records of a file; StoreError unless they end where it ends."""
    with errors.damage(path, _mend(path.parent)):
        read_record = RECORDS[path.name]
        with open_regular(path) as file:
            reader = _Reader(file)
            try:
                (num_records,) = reader.take("Q")
                records = [read_record(reader) for _ in range(num_records)]
            except EOFError:
                raise ValueError("it ends within a record") from None
            if reader.position < reader.size:
                raise ValueError("something follows its last record")
    return records


def _mend(folder: Path) -> errors.Words:
    """Say how a model is made again."""
    if (folder.parent.parent / "config.toml").exists():
        return errors.how_to_make_again("map", folder.parent.parent)
    return "make the model again"


def registered_names(model_path: Path) -> list[str]:
    """Return the sorted names of the images of a model; StoreError unless its files are whole."""
    records = {name: _read_records(model_path / name) for name in RECORDS}
    return sorted(records["images.bin"])


def require_intact(folder: Path) -> None:
    """Refuse a model of ours that is not as it was written, or a binary one that is damaged."""
    known = kept_digests(folder)
    if known:
        _require_digests(folder, known)
    elif _is_binary(folder):
        for name in RECORDS:
            if name in OLD_RECORDS or (folder / name).exists():
                _read_records(folder / name)


def _require_digests(folder: Path, known: Mapping[str, str]) -> None:
    """Refuse a model whose files have not the digests of when they were written."""
    now = file_digests(folder)
    for name in RECORDS:
        if known.get(name) != now.get(name):
            raise errors.StoreError(
                f"is not as it was written (see {SUMMARY} in its folder)",
                where=folder / name,
                advice=(
                    "if you have edited the model, copy it to a folder of its own without "
                    f"{SUMMARY} and use that; else ",
                    _mend(folder),
                ),
            )


def _is_binary(folder: Path) -> bool:
    return all((folder / name).exists() for name in OLD_RECORDS)


def kept_digests(folder: Path) -> dict[str, str]:
    """Return the digests of the files of a model of ours when they were written, else nothing."""
    try:
        known = json.loads(read_regular_text(folder / SUMMARY))["model"]
    except errors.DAMAGE:
        return {}
    return known if isinstance(known, dict) else {}


def file_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of each file of a model that can be read."""
    found = {}
    for name in RECORDS:
        with suppress(OSError):
            found[name] = file_sha256(folder / name)
    return found


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model into a new folder; pycolmap does not say when the disk is full."""
    with native_writes(folder):
        folder.mkdir()
        model.write(folder)
    require_written(folder)


def require_written(folder: Path) -> None:
    """Refuse a model that pycolmap has not written to its end; WorkspaceError.

    To read one would take for ever.
    """
    try:
        registered_names(folder)
    except errors.StoreError as error:
        raise why_not_written(folder, error) from error


def model_folder(folder: Path) -> Path:
    """Return the folder of the largest model of a run, if its output folder is given.

    A folder with a model is itself; so is one where there is none.
    """
    for found in (folder, folder / "sparse" / "0", folder / "sparse", folder / "0"):
        if has_model(found):
            return found
    return folder


def has_model(folder: Path) -> bool:
    """Return whether a folder holds files of a model."""
    return (folder / "images.bin").exists() or (folder / "images.txt").exists()


def read_given_model(
    folder: Path, option: str = "", *, needs_poses: bool = True
) -> pycolmap.Reconstruction:
    """Read a model, text or binary, of a folder or of that of a run.

    Args:
        folder: of the model, or the output folder of a run, whose largest model is read.
        option: that it came by, for errors, as :class:`errors.Option` names it; empty for none.
        needs_poses: whether its poses are to be used; else only its cameras and names.

    Raises:
        OptionError: there is no such folder, or no model in it.
        StoreError: the model is damaged, of ours and not as it was written, or nothing could be
            computed with it: it has no registered image, two images of one name, or poses,
            points or cameras that are not finite.
    """
    wanted = "give the folder that holds cameras, images and points3D as .bin or .txt"
    where: errors.Words = errors.Option(option, folder) if option else folder
    if not folder.is_dir():
        raise errors.OptionError("no such folder", where=where, advice=wanted)
    folder = model_folder(folder)
    where = errors.Option(option, folder) if option else folder
    for path in sorted(folder.glob("*.[bt][ix][nt]")):
        with errors.damage(path, wanted):
            require_regular(path)
    is_ours = bool(kept_digests(folder))
    if _is_binary(folder) or is_ours:
        require_intact(folder)
        with errors.damage(folder, _mend(folder)):
            model = pycolmap.Reconstruction(folder)
    else:
        model = _read_text(folder, where, wanted)
    fault = _mixed_up(model)
    if not fault and not is_ours:
        fault = why_unusable(model, needs_poses=needs_poses)
    if fault:
        raise errors.StoreError(fault, where=where, advice=_mend(folder))
    return model


def _mixed_up(model: pycolmap.Reconstruction) -> str:
    """Say that images and points do not belong together; empty where they do."""
    num_seen = sum(image.num_points3D for image in model.images.values())
    num_seeing = sum(point.track.length() for point in model.points3D.values())
    if num_seen == num_seeing:
        return ""
    return "damaged (its images and points are not of one model)"


def _read_text(
    folder: Path, where: errors.Words, wanted: str
) -> pycolmap.Reconstruction:
    try:
        model = pycolmap.Reconstruction(folder)
    except errors.DAMAGE as error:
        if errors.lacks_memory(error):
            raise
        advice = f"{wanted} ({errors.reason(error)})"
        fault = "not a COLMAP model"
        raise errors.OptionError(fault, where=where, advice=advice) from error
    for image in model.images.values():  # binary ones are walked through
        for keypoint in image.points2D:
            if not (abs(keypoint.x()) < FAR and abs(keypoint.y()) < FAR):
                fault = f"a keypoint of {image.name} is at no finite place"
                raise errors.StoreError(fault, where=where, advice=_mend(folder))
    return model


def why_unusable(model: pycolmap.Reconstruction, *, needs_poses: bool = True) -> str:
    """Return why nothing can be computed with a model, empty where there is no reason."""
    fault = _faulty_images(model) or _faulty_cameras(model)
    if not fault and needs_poses:
        fault = _faulty_poses(model) or _faulty_points(model)
    return fault


def _faulty_images(model: pycolmap.Reconstruction) -> str:
    names = Counter(posixpath.normpath(image.name) for image in model.images.values())
    for name, count in sorted(names.items()):
        if count > 1:
            return (
                f"two of its images are called {name} (text models cannot hold names with blanks: "
                "use a binary one, or rename the photographs)"
            )
    return ""


def _faulty_cameras(model: pycolmap.Reconstruction) -> str:
    for camera_id, camera in sorted(model.cameras.items()):
        if not _is_usable(camera):
            return f"camera {camera_id} has no size, or no finite and positive focal length"
    return ""


def _faulty_poses(model: pycolmap.Reconstruction) -> str:
    registered = model.reg_image_ids()
    if not registered:
        return "the model has no images with poses"
    for image_id in registered:
        image = model.image(image_id)
        if not _is_pose(image.cam_from_world()):
            return f"the pose of {image.name} is not finite, or no rotation"
    return ""


def _faulty_points(model: pycolmap.Reconstruction) -> str:
    for point_id, point in model.points3D.items():
        if not (np.abs(point.xyz) < FAR).all():
            return f"point {point_id} is at no finite place"
        if math.isnan(point.error):
            return f"the error of point {point_id} is no number"
    return ""


def refuse_panoramas(model: pycolmap.Reconstruction, what: errors.Words) -> None:
    """Refuse a model with cameras that look all around, which have no focal length.

    Args:
        model: any model.
        what: cannot be done with it, to begin the line of the OptionError.
    """
    for camera_id, camera in sorted(model.cameras.items()):
        if not len(camera.focal_length_idxs()):
            raise errors.OptionError(
                f"camera {camera_id} looks all around ({camera.model_name}) and has no "
                "focal length",
                where=what,
                advice="use the model of perspective views of the panoramas",
            )


def _is_usable(camera: pycolmap.Camera) -> bool:
    """Return whether a camera has a size, finite parameters and a focal length, if it has one."""
    shorter = min(camera.width, camera.height)
    longer = max(camera.width, camera.height)
    if shorter <= 0 or longer > MAX_SIDE_PX:
        return False
    params = np.asarray(camera.params, np.float64)
    focals = params[list(camera.focal_length_idxs())]
    return bool((np.abs(params) < FAR).all() and (focals > 0.0).all())


def _is_pose(pose: pycolmap.Rigid3d) -> bool:
    """Return whether a pose has a quaternion of length 1 and a finite translation."""
    length = float(np.linalg.norm(pose.rotation.quat))
    return abs(length - 1.0) < QUATERNION_ERROR and bool(
        (np.abs(pose.translation) < FAR).all()
    )


def num_long_tracks(
    model: pycolmap.Reconstruction, viewpoint_of: Mapping[int, int]
) -> Counter[int]:
    """Return how many points of three views or more each image sees, by its id.

    ``viewpoint_of``: of images from the same viewpoint, which count as one, a common number by
    image id; others have none.
    """
    found = Counter[int]()
    for image_ids in _long_tracks(model):
        views = {viewpoint_of.get(image_id, image_id) for image_id in image_ids}
        if len(views) > 2:
            found.update(image_ids)
    return found


def all_see_long_tracks(
    model: pycolmap.Reconstruction, image_ids: Iterable[int], least: int
) -> bool:
    """Return whether each of some images sees enough points of three images or more.

    Args:
        model: any model.
        image_ids: of the images.
        least: number of such points that each of them must see.
    """
    missing = dict.fromkeys(image_ids, least)
    for image_id in missing:
        # As often in hard sets: it is known without going through all points.
        if model.images[image_id].num_points3D < least:
            return False
    for track in _long_tracks(model):
        for image_id in track & missing.keys():
            missing[image_id] -= 1
            if missing[image_id] <= 0:
                del missing[image_id]
        if not missing:
            return True
    return not missing


def _long_tracks(model: pycolmap.Reconstruction) -> Iterator[set[int]]:
    """Return the ids of the images of each point that three or more see."""
    for point in model.points3D.values():
        if point.track.length() <= 2:
            continue
        images = {element.image_id for element in point.track.elements}
        if len(images) > 2:
            yield images


def seen_points(image: pycolmap.Image) -> Indices:
    """Return the id of the point that each keypoint sees, -1 for none, (N,)."""
    seen = np.full(image.num_points2D(), -1, np.int64)
    keypoints = image.points2D
    for index in image.get_observation_point2D_idxs():
        seen[index] = keypoints[index].point3D_id
    return seen


def read_poses(model_path: Path) -> Poses:
    """Read the poses of a COLMAP model, text or binary; AffrectError when it has none."""
    return model_poses(read_given_model(model_path))


def model_poses(model: pycolmap.Reconstruction) -> Poses:
    """Return the poses of the registered images of a model."""
    poses: Poses = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        matrix = image.cam_from_world().matrix()
        poses[image.name] = (matrix[:, :3], matrix[:, 3])
    return poses


def relative_pose(pose1: Pose, pose2: Pose) -> Pose:
    """Compute cam2_from_cam1 from two cam_from_world poses."""
    rotation = pose2[0] @ pose1[0].T
    return rotation, pose2[1] - rotation @ pose1[1]


def pose_errors(estimated: Pose, truth: Pose) -> tuple[float, float]:
    """Return the angles between two relative poses, degrees: rotation, translation direction."""
    rotation, translation = estimated
    true_rotation, true_translation = truth
    difference = rotation @ true_rotation.T
    skew = difference - difference.T
    sine = np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]])
    rotation_error = np.degrees(np.arctan2(sine, np.trace(difference) - 1.0))
    cross = np.linalg.norm(np.cross(translation, true_translation))
    direction_error = np.degrees(np.arctan2(cross, translation @ true_translation))
    return float(rotation_error), float(direction_error)
