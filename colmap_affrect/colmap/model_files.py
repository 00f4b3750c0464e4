"""Files of COLMAP models: walked through, compared with their digests, read and written.

pycolmap's reader never ends, takes all memory or ends the process where a count in a file is wrong.
So every record is followed to the end of its file first. Models of ours have a digest of their
files beside them.
"""

import hashlib
import json
import struct
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import (
    DAMAGE,
    AffrectError,
    OptionError,
    StoreError,
    damage,
    lacks_memory,
    made_again,
    reason,
)
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.checked_json import without_checksum

SUMMARY = "summary.json"  # beside a model of ours; has the digests of its files as ``model``
NO_POINT = np.uint64(2**64 - 1)  # the point of a keypoint that observes none
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


class _Image(NamedTuple):
    name: str
    id: int
    keypoints: NDArray[Any]  # (N,) KEYPOINT


def _require(is_right: bool | np.bool_, otherwise: str) -> None:
    if not is_right:
        raise ValueError(otherwise)


def _pose(reader: _Reader) -> None:
    """Step over a pose: a quaternion and a translation."""
    pose = reader.take("7d")
    _require(np.isfinite(pose).all(), "numbers that are not finite")
    _require(any(pose[:4]), "a pose without rotation")


@cache
def camera_like(model: int) -> pycolmap.Camera | None:
    """Return a camera of a model of COLMAP by its number, None if there is no such model."""
    try:
        return pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    except (ValueError, RuntimeError, TypeError):
        return None


def _camera(reader: _Reader) -> None:
    _, model, *size = reader.take("IiQQ")
    like = camera_like(model)
    if like is None:
        raise ValueError("a camera is of no model of COLMAP")
    params = reader.take(f"{len(like.params)}d")
    _require(np.isfinite(params).all(), "numbers that are not finite")
    _require(all(0 < side <= MAX_SIDE_PX for side in size), "a camera is of no size in pixels")


def _rig(reader: _Reader) -> None:
    for number in range(reader.take("II")[1]):
        reader.take("iI")  # the first sensor is the reference, which has no pose
        if number and reader.take("B")[0]:
            _pose(reader)


def _frame(reader: _Reader) -> None:
    reader.take("II")
    _pose(reader)
    for _ in range(reader.take("I")[0]):
        reader.take("iIQ")


def _image(reader: _Reader) -> _Image:
    (image_id,) = reader.take("I")
    _pose(reader)
    reader.take("I")
    name, (count,) = reader.text(), reader.take("Q")
    start = reader.skip(count * KEYPOINT.itemsize)
    keypoints = np.frombuffer(reader.data, KEYPOINT, count, start)
    _require(bool(name), "an image has no name")
    _require(np.isfinite(keypoints["xy"]).all(), "keypoints that are not finite")
    return _Image(name, image_id, keypoints)


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


def _read_records(path: Path) -> tuple[_Reader, list[Any]]:
    """Read all records of a file; StoreError unless they end where it ends."""
    with damage(path, _mend(path.parent)):
        reader, record = _Reader(path.read_bytes()), RECORDS[path.name]
        try:
            records = [record(reader) for _ in range(reader.take("Q")[0])]
        except EOFError:
            raise ValueError("it ends within a record") from None
        _require(reader.position == len(reader.data), "something follows its last record")
    return reader, records


def _mend(folder: Path) -> str:
    """Say how a model is made again."""
    if (folder.parent.parent / "config.toml").exists():
        return made_again("map", folder.parent.parent)
    return "make the model again"


def _require_tracks(reader: _Reader, records: list[tuple[int, int]], images: list[_Image]) -> None:
    """Tracks name keypoints that observe their point, each once, and no other keypoint does."""
    starts, lengths = np.array(records, np.int64).reshape(-1, 2).T
    places = [reader.at("<f8", starts + 8 * axis) for axis in (1, 2, 3)]
    _require(np.isfinite(places).all(), "points that are not finite")
    within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    elements = np.repeat(starts + POINT.size, lengths) + 8 * within
    ordered = sorted(images, key=lambda image: image.id)
    first = np.cumsum([0, *(len(image.keypoints) for image in ordered)])
    image = np.searchsorted([image.id for image in ordered], reader.at("<u4", elements))
    keypoints = first[image] + reader.at("<u4", elements + 4)
    observed = np.concatenate([np.zeros(0, np.uint64), *(i.keypoints["point"] for i in ordered)])
    same = observed[keypoints] == np.repeat(reader.at("<u8", starts), lengths)
    _require(same.all(), "a track has a keypoint that observes another point")
    _require(np.bincount(keypoints).max(initial=0) <= 1, "a track has a keypoint twice")
    is_complete = len(keypoints) == np.count_nonzero(observed != NO_POINT)
    _require(is_complete, "a keypoint observes a point that is not there")


def registered_names(model_path: Path) -> list[str]:
    """Return the sorted names of the images of a model; StoreError unless its files are whole."""
    records = {name: _read_records(model_path / name)[1] for name in RECORDS}
    return sorted(image.name for image in records["images.bin"])


def require_intact(folder: Path) -> None:
    """Refuse a model of ours that is not as it was written, or one of others that is damaged.

    Text files are left to pycolmap.
    """
    known, now = kept_digests(folder), file_digests(folder)
    if not known and _is_binary(folder):
        names = [name for name in RECORDS if name in OLD_RECORDS or (folder / name).exists()]
        records = {name: _read_records(folder / name) for name in names}
        with damage(folder / "points3D.bin", _mend(folder)):
            _require_tracks(*records["points3D.bin"], records["images.bin"][1])
    changed = [name for name in RECORDS if known and known.get(name) != now.get(name)]
    for name in changed:
        _read_records(folder / name)  # says what is wrong where it can
    if changed:
        raise StoreError(
            f"{folder / changed[0]}: is not as it was written (see {SUMMARY} in its folder); if "
            f"you have edited the model, copy it to a folder of its own without {SUMMARY} and use "
            f"that; else {_mend(folder)}"
        )


def _is_binary(folder: Path) -> bool:
    return all((folder / name).exists() for name in OLD_RECORDS)


def kept_digests(folder: Path) -> dict[str, str]:
    """Return the digests of the files of a model of ours when they were written, else nothing."""
    try:
        known = json.loads(without_checksum((folder / SUMMARY).read_bytes()))["model"]
    except (OSError, ValueError, TypeError, KeyError):
        return {}
    return known if isinstance(known, dict) else {}


def file_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of each file of a model that can be read."""
    found = {}
    for name in RECORDS:
        with suppress(OSError), (folder / name).open("rb") as file:
            found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model into a new folder; pycolmap does not say when the disk is full."""
    folder.mkdir()
    model.write(folder)
    try:
        registered_names(folder)
    except StoreError as error:
        raise cannot_write(folder, error) from error


def read_given_model(
    folder: Path, option: str = "", error_class: type[AffrectError] = OptionError
) -> pycolmap.Reconstruction:
    """Read a model, text or binary; an error names the option it came by.

    Raises StoreError if it is damaged, or of ours and not as it was written.
    """
    wanted = "give the folder that holds cameras, images and points3D as .bin or .txt"
    if not folder.is_dir():
        raise OptionError(f"{option}{folder}: no such folder; {wanted}")
    if _is_binary(folder) or kept_digests(folder):
        require_intact(folder)
        with damage(folder, _mend(folder)):
            return pycolmap.Reconstruction(folder)
    try:
        return pycolmap.Reconstruction(folder)
    except DAMAGE as error:
        if lacks_memory(error):
            raise
        why = f"not a COLMAP model; {wanted} ({reason(error)})"
        raise error_class(f"{option}{folder}: {why}") from error


def num_long_tracks(model: pycolmap.Reconstruction) -> Counter[int]:
    """Return how many points that three images or more see each image sees, by its id."""
    tracks = ({e.image_id for e in point.track.elements} for point in model.points3D.values())
    return Counter(image_id for images in tracks if len(images) > 2 for image_id in images)


def seen_points(image: pycolmap.Image) -> Indices:
    """Return the id of the point that each keypoint sees, -1 for none, (N,)."""
    seen = np.full(image.num_points2D(), -1, np.int64)
    for index in image.get_observation_point2D_idxs():
        seen[index] = image.points2D[index].point3D_id
    return seen
