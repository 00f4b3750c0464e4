"""The binary files of a COLMAP model, walked through without building the model.

pycolmap's reader never ends, or takes all memory, on some damaged files. Here every record is
followed to the end of its file, which damage seldom leaves in its place.
"""

import struct
from collections import Counter
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError, OptionError, StoreError
from colmap_affrect.geometry.arrays import Bools, Indices
from colmap_affrect.project.atomic_files import cannot_write

SENSOR_BYTES = 8  # type and id of a sensor
POSE_BYTES = 7 * 8  # quaternion and translation


class _Reader:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0

    def skip(self, num_bytes: int) -> None:
        self.position += num_bytes
        if self.position > len(self.data):
            raise EOFError

    def number(self, code: str) -> int:
        """Read an unsigned number: B, I or Q of :mod:`struct`."""
        start = self.position
        self.skip(struct.calcsize(code))
        (value,) = struct.unpack_from(f"<{code}", self.data, start)
        return int(value)

    def text(self) -> str:
        """Read a text that ends with a 0."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise EOFError
        text = self.data[self.position : end].decode("utf-8", "replace")
        self.position = end + 1
        return text


def registered_names(model_path: Path) -> list[str]:
    """Return the sorted names of the images of a model; StoreError unless its files are intact."""
    names: list[str] = []
    for file_name, walk in RECORDS.items():
        path = model_path / file_name
        try:
            reader = _Reader(path.read_bytes())
        except OSError as error:
            raise StoreError(f"{path}: cannot be read ({error.strerror})") from error
        try:
            for _ in range(reader.number("Q")):
                name = walk(reader)
                if name:
                    names.append(name)
        except EOFError as error:
            raise StoreError(f"{path}: damaged, it ends within a record") from error
        if reader.position != len(reader.data):
            raise StoreError(f"{path}: damaged, something follows its last record")
    return sorted(names)


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model into a new folder; pycolmap does not say when the disk is full."""
    folder.mkdir()
    model.write(folder)
    _require_written(folder)


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model that pycolmap has just written."""
    _require_written(folder)
    return pycolmap.Reconstruction(folder)


def read_given_model(
    folder: Path, option: str = "", error_class: type[AffrectError] = OptionError
) -> pycolmap.Reconstruction:
    """Read a model that the user gives, text or binary; an error names the option it came by."""
    wanted = "give the folder that holds cameras, images and points3D as .bin or .txt"
    if not folder.is_dir():
        raise OptionError(f"{option}{folder}: no such folder; {wanted}")
    if all((folder / name).exists() for name in RECORDS):
        registered_names(folder)  # pycolmap's reader may never end on a damaged file
    try:
        return pycolmap.Reconstruction(folder)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise error_class(f"{option}{folder}: not a COLMAP model; {wanted} ({reason})") from error


def _require_written(folder: Path) -> None:
    try:
        registered_names(folder)
    except StoreError as error:
        raise cannot_write(folder, error) from error


def _walk_camera(reader: _Reader) -> None:
    reader.skip(4)
    model = reader.number("I")
    like = camera_like(model)
    reader.skip(16 + 8 * (len(like.params) if like else 0))


@cache
def camera_like(model: int) -> pycolmap.Camera | None:
    """Return a camera of a model of COLMAP by its number, None if there is no such model."""
    try:
        return pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    except (ValueError, RuntimeError, TypeError):
        return None


def _walk_rig(reader: _Reader) -> None:
    reader.skip(4)
    num_sensors = reader.number("I")
    if num_sensors:
        reader.skip(SENSOR_BYTES)  # the reference sensor, which has no pose
    for _ in range(num_sensors - 1):
        reader.skip(SENSOR_BYTES)
        if reader.number("B"):
            reader.skip(POSE_BYTES)


def _walk_frame(reader: _Reader) -> None:
    reader.skip(8 + POSE_BYTES)
    reader.skip(reader.number("I") * (SENSOR_BYTES + 8))


def _walk_image(reader: _Reader) -> str:
    reader.skip(4 + POSE_BYTES + 4)
    name = reader.text()
    reader.skip(reader.number("Q") * 24)
    return name


def _walk_point(reader: _Reader) -> None:
    reader.skip(8 + 3 * 8 + 3 + 8)
    reader.skip(reader.number("Q") * 8)


RECORDS: dict[str, Callable[[_Reader], str | None]] = {
    "cameras.bin": _walk_camera,
    "rigs.bin": _walk_rig,
    "frames.bin": _walk_frame,
    "images.bin": _walk_image,
    "points3D.bin": _walk_point,
}
"""The files of a model, and what steps over one record of each."""


def num_long_tracks(
    model: pycolmap.Reconstruction, counted: Mapping[int, Bools] | None = None
) -> Counter[int]:
    """Return how many points that three images or more see each image sees, by its id.

    Args:
        model: any.
        counted: which keypoints count, (N,) by image id; by default all.
    """
    return Counter(
        image_id
        for point in model.points3D.values()
        if len(images := _seen_by(point, counted)) > 2
        for image_id in images
    )


def _seen_by(point: pycolmap.Point3D, counted: Mapping[int, Bools] | None) -> set[int]:
    return {
        element.image_id
        for element in point.track.elements
        if counted is None or counted[element.image_id][element.point2D_idx]
    }


def seen_points(image: pycolmap.Image) -> Indices:
    """Return the id of the point that each keypoint sees, -1 for none, (N,)."""
    seen = np.full(image.num_points2D(), -1, np.int64)
    for index in image.get_observation_point2D_idxs():
        seen[index] = image.points2D[index].point3D_id
    return seen
