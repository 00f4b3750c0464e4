"""Files of COLMAP models: read when they are intact, written, and what is asked of models.

Models of ours have a digest of their files beside them.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_records import (
    OLD_RECORDS,
    RECORDS,
    mend,
    read_records,
    require_consistent,
)
from colmap_affrect.errors import (
    DAMAGE,
    AffrectError,
    OptionError,
    StoreError,
    damage,
    lacks_memory,
    reason,
)
from colmap_affrect.geometry.arrays import Bools, Indices
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.checked_json import without_checksum

SUMMARY = "summary.json"  # beside a model of ours; has the digest of its files as ``model``


def registered_names(model_path: Path) -> list[str]:
    """Return the sorted names of the images of a model; StoreError unless its files are whole."""
    records = {name: read_records(model_path / name)[1] for name in RECORDS}
    return sorted(image.name for image in records["images.bin"])


def require_intact(folder: Path) -> None:
    """Refuse a model that was damaged, or one of ours that is not as it was written.

    Models of others are followed record by record, and what one says of another must be so. Text
    files are left to pycolmap.
    """
    known, now = kept_digests(folder), file_digests(folder)
    if isinstance(known, str):  # of an older version: one for all files
        changed = [] if known == _digest_of(now) else [folder]
    else:
        changed = [folder / name for name in RECORDS if known.get(name) != now.get(name)]
    if known and not changed:
        return
    if known or all((folder / name).exists() for name in OLD_RECORDS):
        require_consistent(folder)
    if known:
        raise StoreError(
            f"{changed[0]}: is not as it was written (see {SUMMARY} in its folder); if you have "
            f"edited the model, copy it to a folder of its own without {SUMMARY} and use that; "
            f"else {mend(folder)}"
        )


def kept_digests(folder: Path) -> dict[str, str] | str:
    """Return the digests of the files of a model of ours when they were written, else nothing."""
    try:
        known = json.loads(without_checksum((folder / SUMMARY).read_bytes()))["model"]
    except (OSError, ValueError, TypeError, KeyError):
        return {}
    return known if isinstance(known, dict | str) else {}


def file_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of each file of a model that can be read."""
    found = {}
    for name in RECORDS:
        with suppress(OSError), (folder / name).open("rb") as file:
            found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def _digest_of(files: Mapping[str, str]) -> str:
    parts = [bytes.fromhex(files[name]) for name in sorted(files)]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model into a new folder; pycolmap does not say when the disk is full."""
    folder.mkdir()
    model.write(folder)
    _require_written(folder)


def read_written_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model that pycolmap has just written."""
    _require_written(folder)
    return pycolmap.Reconstruction(folder)


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model; StoreError if it is damaged, or of ours and not as it was written."""
    require_intact(folder)
    with damage(folder, mend(folder)):
        return pycolmap.Reconstruction(folder)


def read_given_model(
    folder: Path, option: str = "", error_class: type[AffrectError] = OptionError
) -> pycolmap.Reconstruction:
    """Read a model that the user gives, text or binary; an error names the option it came by."""
    wanted = "give the folder that holds cameras, images and points3D as .bin or .txt"
    if not folder.is_dir():
        raise OptionError(f"{option}{folder}: no such folder; {wanted}")
    require_intact(folder)
    try:
        return pycolmap.Reconstruction(folder)
    except DAMAGE as error:
        if lacks_memory(error):
            raise
        why = f"not a COLMAP model; {wanted} ({reason(error)})"
        raise error_class(f"{option}{folder}: {why}") from error


def _require_written(folder: Path) -> None:
    try:
        registered_names(folder)
    except StoreError as error:
        raise cannot_write(folder, error) from error


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
