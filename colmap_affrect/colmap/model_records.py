"""The binary files of a COLMAP model, walked through and compared without building the model.

pycolmap's reader never ends, takes all memory or ends the process on some damaged files. Here every
record is followed to the end of its file, which damage seldom leaves in its place, and what records
say of each other is compared.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import damage, made_again
from colmap_affrect.geometry.arrays import Indices

CAMERA = 0  # number of this type of sensors
NO_POINT = np.uint64(2**64 - 1)  # what keypoints see that see no point
MAX_SIDE_PX = 10**6  # of the images of a camera; more is taken for damage
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
POINT = struct.Struct("<Q3d3BdQ")  # id, place, colour, error, length of the track


class _Reader:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0

    def skip(self, num_bytes: int) -> int:
        """Go on, and return where that was."""
        start = self.position
        self.position += num_bytes
        if self.position > len(self.data):
            raise EOFError
        return start

    def take(self, codes: str) -> tuple[Any, ...]:
        """Read values by their codes of :mod:`struct`."""
        return struct.unpack_from(f"<{codes}", self.data, self.skip(struct.calcsize(f"<{codes}")))

    def text(self) -> str:
        """Read a text that ends with a 0."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise EOFError
        text = self.data[self.position : end].decode("utf-8")
        self.position = end + 1
        return text

    def at(self, dtype: str, starts: Indices) -> NDArray[Any]:
        """Return the values that begin at some bytes."""
        kind = np.dtype(dtype)
        every = (max(0, len(self.data) - kind.itemsize + 1),)
        return np.ndarray(every, kind, self.data, strides=(1,))[starts]


class _Camera(NamedTuple):
    id: int
    size: tuple[int, int]
    params: tuple[float, ...]


class _Rig(NamedTuple):
    id: int
    sensors: list[tuple[int, int]]  # type and id
    poses: list[tuple[float, ...]]  # of those that have one


class _Frame(NamedTuple):
    id: int
    rig_id: int
    pose: tuple[float, ...]
    data: list[tuple[int, int, int]]  # type and id of the sensor, and of the image


class _Image(NamedTuple):
    id: int
    pose: tuple[float, ...]
    camera_id: int
    name: str
    keypoints: NDArray[Any]  # (N,) KEYPOINT


def _camera(reader: _Reader) -> _Camera:
    camera_id, model, width, height = reader.take("IiQQ")
    like = camera_like(model)
    _require(like is not None, "a camera is of no model of COLMAP")
    return _Camera(camera_id, (width, height), reader.take(f"{len(like.params) if like else 0}d"))


@cache
def camera_like(model: int) -> pycolmap.Camera | None:
    """Return a camera of a model of COLMAP by its number, None if there is no such model."""
    try:
        return pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    except (ValueError, RuntimeError, TypeError):
        return None


def _rig(reader: _Reader) -> _Rig:
    rig_id, num_sensors = reader.take("II")
    sensors, poses = list[tuple[int, int]](), list[tuple[float, ...]]()
    for number in range(num_sensors):
        sensors.append(reader.take("iI"))  # the first is the reference, which has no pose
        if number and reader.take("B")[0]:
            poses.append(reader.take("7d"))
    return _Rig(rig_id, sensors, poses)


def _frame(reader: _Reader) -> _Frame:
    frame_id, rig_id, *pose, count = reader.take("II7dI")
    return _Frame(frame_id, rig_id, tuple(pose), [reader.take("iIQ") for _ in range(count)])


def _image(reader: _Reader) -> _Image:
    image_id, *pose, camera_id = reader.take("I7dI")
    name, (count,) = reader.text(), reader.take("Q")
    start = reader.skip(count * KEYPOINT.itemsize)
    keypoints = np.frombuffer(reader.data, KEYPOINT, count, start)
    return _Image(image_id, tuple(pose), camera_id, name, keypoints)


def _point(reader: _Reader) -> tuple[int, int]:
    """Step over a point; return where it begins, and the length of its track."""
    start = reader.skip(POINT.size)
    (length,) = struct.unpack_from("<Q", reader.data, reader.position - 8)
    reader.skip(8 * length)
    return start, length


RECORDS: dict[str, Callable[[_Reader], Any]] = {
    "cameras.bin": _camera,
    "rigs.bin": _rig,
    "frames.bin": _frame,
    "images.bin": _image,
    "points3D.bin": _point,
}
"""The files of a model, and what reads one record of each."""
OLD_RECORDS = ("cameras.bin", "images.bin", "points3D.bin")  # of COLMAP before it knew rigs


def read_records(path: Path) -> tuple[_Reader, list[Any]]:
    """Read all records of a file; StoreError unless they end where it ends."""
    with damage(path, mend(path.parent)):
        reader, record = _Reader(path.read_bytes()), RECORDS[path.name]
        try:
            found = [record(reader) for _ in range(reader.take("Q")[0])]
        except EOFError:
            raise ValueError("it ends within a record") from None
        _require(reader.position == len(reader.data), "something follows its last record")
    return reader, found


def mend(folder: Path) -> str:
    """Say how a model is made again."""
    if (folder.parent.parent / "config.toml").exists():
        return made_again("map", folder.parent.parent)
    return "make the model again"


def _require(is_right: bool | np.bool_, otherwise: str) -> None:
    if not is_right:
        raise ValueError(otherwise)


def require_consistent(folder: Path) -> None:
    """Refuse binary files of which one says of another what is not so; StoreError names it."""
    files = [name for name in RECORDS if name in OLD_RECORDS or (folder / name).exists()]
    records = {name: read_records(folder / name) for name in files}
    cameras, images = (records[name][1] for name in ("cameras.bin", "images.bin"))
    for name, (reader, found) in records.items():
        with damage(folder / name, mend(folder)):
            match name:
                case "cameras.bin":
                    _check_cameras(found)
                case "rigs.bin":
                    _check_rigs(found, cameras)
                case "frames.bin":
                    _check_frames(found, records["rigs.bin"][1], images)
                case "images.bin":
                    _check_images(found, cameras)
                case "points3D.bin":
                    _check_points(reader, found, images)


def _check_unique(ids: Iterable[object], what: str) -> None:
    listed = list(ids)
    _require(len(set(listed)) == len(listed), f"two {what} are the same")


def _check_finite(values: Iterable[float]) -> None:
    _require(np.isfinite(np.fromiter(values, np.float64)).all(), "numbers that are not finite")


def _check_poses(poses: Sequence[tuple[float, ...]]) -> None:
    """Poses are finite, and their quaternions rotations."""
    _check_finite(value for pose in poses for value in pose)
    _require(all(any(pose[:4]) for pose in poses), "a pose without rotation")


def _check_cameras(cameras: Sequence[_Camera]) -> None:
    _check_unique((camera.id for camera in cameras), "ids")
    _check_finite(value for camera in cameras for value in camera.params)
    sides = [side for camera in cameras for side in camera.size]
    _require(all(0 < side <= MAX_SIDE_PX for side in sides), "a camera is of no size in pixels")


def _check_rigs(rigs: Sequence[_Rig], cameras: Sequence[_Camera]) -> None:
    _check_unique((rig.id for rig in rigs), "ids")
    _check_poses([pose for rig in rigs for pose in rig.poses])
    sensors = [sensor for rig in rigs for sensor in rig.sensors]
    _check_unique(sensors, "sensors")
    known = {camera.id for camera in cameras}
    is_known = all(kind != CAMERA or number in known for kind, number in sensors)
    _require(is_known, "a rig has a camera that is not there")


def _check_frames(frames: Sequence[_Frame], rigs: Sequence[_Rig], images: Sequence[_Image]) -> None:
    _check_unique((frame.id for frame in frames), "ids")
    _check_poses([frame.pose for frame in frames])
    sensors = {rig.id: set(rig.sensors) for rig in rigs}
    cameras = {image.id: image.camera_id for image in images}
    seen = []
    for frame in frames:
        _require(frame.rig_id in sensors, "a frame has a rig that is not there")
        for kind, sensor, image_id in frame.data:
            _require((kind, sensor) in sensors[frame.rig_id], "a frame has a sensor of no rig")
            if kind == CAMERA:
                seen.append(image_id)
                _require(cameras.get(image_id) == sensor, "a frame has an image that is not there")
    _check_unique(seen, "images")
    _require(len(seen) == len(images), "an image is in no frame")


def _check_images(images: Sequence[_Image], cameras: Sequence[_Camera]) -> None:
    _check_unique((image.id for image in images), "ids")
    _check_unique((image.name for image in images), "names")
    _check_poses([image.pose for image in images])
    known = {camera.id for camera in cameras}
    for image in images:
        _require(bool(image.name), "an image has no name")
        _require(image.camera_id in known, "an image has a camera that is not there")
        _require(np.isfinite(image.keypoints["xy"]).all(), "keypoints that are not finite")


def _check_points(
    reader: _Reader, found: Sequence[tuple[int, int]], images: Sequence[_Image]
) -> None:
    """Tracks name keypoints that see their point, each once, and no other keypoint sees one."""
    starts, lengths = np.array(found, np.int64).reshape(-1, 2).T
    points = reader.at("<u8", starts)
    _require(len(np.unique(points)) == len(points), "two ids are the same")
    places = [reader.at("<f8", starts + 8 * axis) for axis in (1, 2, 3)]
    _require(np.isfinite(places).all(), "points that are not finite")
    within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    elements = np.repeat(starts + POINT.size, lengths) + 8 * within
    image_ids, keypoints = reader.at("<u4", elements), reader.at("<u4", elements + 4)
    ordered = sorted(images, key=lambda image: image.id)
    ids = np.array([image.id for image in ordered], np.uint32)
    ends = np.cumsum([0, *(len(image.keypoints) for image in ordered)])
    _require(np.isin(image_ids, ids).all(), "a track has an image that is not there")
    image = np.searchsorted(ids, image_ids)
    number = ends[image] + keypoints
    _require((number < ends[image + 1]).all(), "a track has a keypoint that is not there")
    seen = np.concatenate([np.zeros(0, np.uint64), *(i.keypoints["point"] for i in ordered)])
    same = seen[number] == np.repeat(points, lengths)
    _require(same.all(), "a track has a keypoint that sees another point")
    _require(np.bincount(number).max(initial=0) <= 1, "a track has a keypoint twice")
    _require(len(number) == (seen != NO_POINT).sum(), "a keypoint sees a point that is not there")
