"""A COLMAP model for other programs: points, text, undistorted photographs, a table."""

import csv
import io
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import (
    model_folder,
    read_given_model,
    refuse_panoramas,
    write_model,
)
from colmap_affrect.colmap.native_writes import native_writes, why_not_written
from colmap_affrect.errors import ImageError, Option, OptionError, StoreError, such_as
from colmap_affrect.images.orientation import forget_orientation
from colmap_affrect.images.reading import header_size
from colmap_affrect.interop.camera_models import with_camera_model
from colmap_affrect.interop.finished_models import read_finished_model, stand_upright
from colmap_affrect.interop.printed_report import write_report
from colmap_affrect.interop.undistortion import undistort
from colmap_affrect.options import suggestion
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import leads_outside, new_results
from colmap_affrect.project.paths import PathLike, as_path, as_path_or_none, resolved
from colmap_affrect.project.workspace import Workspace

logger = logging.getLogger(__name__)

USUAL = ("ply", "text", "cameras")  # formats that need no photographs
DENSE = "dense"  # folder of undistorted photographs, as COLMAP's dense reconstruction has it

UP = np.array([0.0, 0.0, 1.0])  # of a model that was turned upright; format
# Of cameras from the middle, as instant-ngp's converter has it; format
MEAN_DISTANCE_IN_CUBES = 1.32
# From COLMAP's camera to that of OpenGL and nerfstudio; format
FLIP_Y_Z = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Source:
    """What is exported."""

    path: Path  # folder of the model
    model: pycolmap.Reconstruction  # its content
    image_path: Path | None  # folder of the photographs; None if it is not known
    is_upright: bool = False  # whether z is known to point up

    def images(self) -> list[pycolmap.Image]:
        """Return the registered images by name."""
        images = map(self.model.image, self.model.reg_image_ids())
        return sorted(images, key=lambda image: str(image.name))


@checks_arguments
def export(
    model_path: PathLike,
    output_path: PathLike,
    formats: str | Sequence[str] = (),
    *,
    image_path: PathLike | None = None,
    camera_model: str = "",
    note: Callable[[str], None] = logger.info,
) -> dict[str, Path]:
    """Write a COLMAP model in some formats.

    The output folder is made if missing; nothing in it is overwritten. Where straight lines of
    several photographs agree on what is upright, models of runs are turned so that z is up.

    Args:
        model_path: folder of a model, or the output folder of a run, whose largest model it is.
        output_path: folder for the files.
        formats: one or some of ``FORMATS``, in a text separated by commas; by default those of
            ``USUAL``, without text where COLMAP could not read it back.
        image_path: the photographs to undistort, by default those of the run.
        camera_model: of ``text`` and ``cameras``, fitted to the cameras; empty: their own.
        note: is told how well that fits, and whether the model was turned.

    Returns:
        What was written, by format.

    Raises:
        AffrectError: a format cannot hold the model, or a file exists; nothing is written then.
    """
    model_path = model_folder(as_path(model_path, "model_path"))
    output_path = as_path(output_path, "output_path")
    image_path = as_path_or_none(image_path, "image_path")
    formats = _checked_formats(formats)
    source = _source(model_path, image_path)
    upright = stand_upright(model_path, source.model)
    if upright:
        source = replace(source, is_upright=True)
        note(f"upright     {upright}: z is up")
    if not formats:
        formats = _usual(source)
    if camera_model:
        _change_cameras(source.model, camera_model, formats, note)
    return _write(source, output_path, formats)


def _source(model_path: Path, image_path: Path | None) -> Source:
    """Read what is exported; the photographs are by default those of the run."""
    if image_path is not None and not image_path.is_dir():
        raise OptionError("no such folder", where=Option("image-path", image_path))
    photographs = (
        image_path or Workspace(resolved(model_path).parent.parent).photographs()
    )
    return Source(
        path=model_path, model=read_finished_model(model_path), image_path=photographs
    )


def _write(
    source: Source, output_path: Path, formats: Sequence[str]
) -> dict[str, Path]:
    """Write formats into a folder, all or none; return what was written by format."""
    # In the order in which they are made
    chosen = [name for name in FORMATS if name in formats]
    targets = dict.fromkeys(output_path / FORMATS[name].leaves for name in chosen)
    photographs = [image.name for image in source.images()]
    written = {}
    with new_results(*targets, names=photographs) as made:
        folder = made[0].parent
        for name in chosen:
            path = FORMATS[name].write(source, folder)
            written[name] = output_path / path.relative_to(folder)
    return written


def _checked_formats(given: str | Sequence[str]) -> list[str]:
    formats = given.split(",") if isinstance(given, str) else list(given)
    for name in formats:
        if name not in FORMATS:
            raise OptionError(
                f"unknown{suggestion(str(name), FORMATS)}", where=Option("format", name)
            )
    return formats


def _change_cameras(
    model: pycolmap.Reconstruction,
    name: str,
    formats: Sequence[str],
    note: Callable[[str], None],
) -> None:
    if not {"text", "cameras"}.intersection(formats):
        raise OptionError(
            "changes 'text' and 'cameras'",
            where=Option("camera-model"),
            advice="give one of these formats",
        )
    refuse_panoramas(model, Option("camera-model"))
    before = {
        camera_id: camera.model_name for camera_id, camera in model.cameras.items()
    }
    largest_px: dict[str, float] = {}  # by the model that cameras had
    for camera_id, difference_px in with_camera_model(model, name).items():
        old = before[camera_id]
        largest_px[old] = max(difference_px, largest_px.get(old, 0.0))
    for old, difference_px in sorted(largest_px.items()):
        note(
            f"cameras: {name} in the place of {old}, at most {difference_px:.3f} px apart"
        )


def _points(source: Source, folder: Path) -> Path:
    path = folder / "points3D.ply"
    with native_writes(path):
        source.model.export_PLY(path)
    return path


def _text(source: Source, folder: Path) -> Path:
    path = folder / "text"
    _require_names_of_text(source, "text")
    with native_writes(path):
        path.mkdir()
        source.model.write_text(path)
    return path


def _require_names_of_text(source: Source, name: str) -> None:
    """Refuse a format that has the model as text where nobody could read that back."""
    why = _why_no_text(source)
    if why:
        raise OptionError(
            why,
            where=name,
            advice="rename the photographs and run again, or leave that format out and "
            "use the binary model as it is",
        )


def _usual(source: Source) -> Sequence[str]:
    """Return the formats that are written where none is asked for."""
    why = _why_no_text(source)
    if not why:
        return USUAL
    logger.warning("text: left out, %s", why)
    return [name for name in USUAL if name != "text"]


def _why_no_text(source: Source) -> str:
    """Say which names COLMAP could not read back out of files of text; empty if it can all."""
    lost = []
    for image in source.images():
        why = _not_in_text(image.name)
        if why:
            lost.append(f"{image.name!r} ({why})")
    return f"COLMAP could not read back the names {such_as(lost)}" if lost else ""


def _not_in_text(name: str) -> str:
    """Say why COLMAP could not read a name back out of a file of text; empty if it can."""
    if not name:
        return "it is empty"
    if name.startswith("#"):
        return "it begins as a comment does"
    if name.split() != [name]:
        return "it has a blank, at which names end"
    return "" if name.isprintable() else "it has characters that do not print"


def _undistorted(source: Source, folder: Path) -> Path:
    """Write undistorted photographs with their model, ready for COLMAP's patch_match_stereo."""
    path = folder / DENSE
    refuse_panoramas(source.model, "undistorted photographs")
    if source.image_path is None:
        raise OptionError(
            "give the folder of the photographs, to undistort them",
            where=Option("image-path"),
        )
    _check_photographs(source, source.image_path)
    given = folder.parent / "model"  # a run may remove that of its folder meanwhile
    if not given.exists():
        write_model(source.model, given)
    undistort(path, given, source.image_path)
    for image in source.images():
        picture = path / "images" / image.name
        if not picture.is_file():
            raise ImageError(
                "COLMAP cannot undistort it, or write it", where=picture.name
            )
        # COLMAP takes over EXIF, by which others would turn it
        forget_orientation(picture)
    return path


def _check_photographs(source: Source, image_path: Path) -> None:
    """Refuse names that lead out of the folder, and photographs that are missing, or others."""
    for image in source.images():
        if leads_outside(image.name):
            raise OptionError(
                f"the image name {image.name} leads out of the folder of the photographs",
                where=source.path,
                advice="rename it, no undistorted picture can be written for it",
            )
        if not (image_path / image.name).is_file():
            raise ImageError(
                "no such photograph",
                where=image_path / image.name,
                advice=("give ", Option("image-path")),
            )
        _require_size(image_path / image.name, source.model.cameras[image.camera_id])


def _require_size(path: Path, camera: pycolmap.Camera) -> None:
    """Refuse a photograph of another size than its camera has; ImageError."""
    size = header_size(path)
    expected = (camera.width, camera.height)
    if size not in (None, expected):
        raise ImageError(
            f"is {size[0]} x {size[1]} px, and its camera {expected[0]} x "
            f"{expected[1]}",
            where=path,
            advice=(
                "give the photographs that the model was made of as ",
                Option("image-path"),
            ),
        )


def _nerfstudio(source: Source, folder: Path) -> Path:
    """Add to undistorted photographs what nerfstudio and Gaussian splatting read."""
    path = folder / DENSE if (folder / DENSE).exists() else _undistorted(source, folder)
    flat = Source(
        path=path,
        model=_undistorted_model(path),
        image_path=None,
        is_upright=source.is_upright,
    )
    with native_writes(path):
        flat.model.export_PLY(path / "points3D.ply")
        (path / "sparse" / "0").mkdir(exist_ok=True)  # where Gaussian splatting looks
        flat.model.write(path / "sparse" / "0")
    content = {
        "camera_model": "OPENCV",
        "ply_file_path": "points3D.ply",
        **_place(flat),
        "frames": [_nerfstudio_frame(flat, image) for image in flat.images()],
    }
    replace_text(path / "transforms.json", json.dumps(content, indent=1) + "\n")
    return path / "transforms.json"


def _undistorted_model(path: Path) -> pycolmap.Reconstruction:
    """Read the model of undistorted photographs; COLMAP does not say where it wrote half of it."""
    try:
        return read_given_model(path / "sparse")
    except (OptionError, StoreError) as error:
        raise why_not_written(path / "sparse", error) from error


def _nerfstudio_frame(flat: Source, image: pycolmap.Image) -> dict[str, Any]:
    """Return the entry of an undistorted photograph: its camera, and its pose world_from_cam."""
    camera = flat.model.cameras[image.camera_id]
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    pose[:3, :3] = pose[:3, :3] @ FLIP_Y_Z
    return {
        "file_path": f"images/{image.name}",
        "transform_matrix": pose.tolist(),
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        "w": camera.width,
        "h": camera.height,
    }


def _mvsnet(source: Source, folder: Path) -> Path:
    """Add to undistorted photographs their model as text, as MVSNet's programs read it."""
    _require_names_of_text(source, "mvsnet")
    path = folder / DENSE if (folder / DENSE).exists() else _undistorted(source, folder)
    flat = _undistorted_model(path)
    with native_writes(path):
        flat.write_text(path / "sparse")
    return path


def _place(source: Source) -> dict[str, Any]:
    """Return what instant-ngp puts into its unit cube, centred on the points, and where up is.

    Cameras are then 1.32 from the middle on average, as its own converter has them.
    """
    poses = np.array(
        [image.cam_from_world().inverse().matrix() for image in source.images()]
    )
    centers = poses[:, :, 3]
    points = [point.xyz for point in source.model.points3D.values()]
    middle = np.median(points or centers, axis=0)
    mean_distance = np.linalg.norm(centers - middle, axis=1).mean()
    half = mean_distance / (2.0 * MEAN_DISTANCE_IN_CUBES) or 1.0
    box = [(middle - half).tolist(), (middle + half).tolist()]
    up = UP if source.is_upright else -poses[:, :, 1].mean(axis=0)
    return {"aabb_scale": 32, "aabb": box, "up": (up / np.linalg.norm(up)).tolist()}


def _cameras(source: Source, folder: Path) -> Path:
    """Write a table of photographs: their cameras, and poses world_from_cam (docs/formats.md)."""
    path = folder / "cameras.csv"
    rows = [_row(source, image) for image in source.images()]
    table = io.StringIO()
    writer = csv.DictWriter(table, rows[0] if rows else ["name"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_text(path, table.getvalue())
    return path


def _row(source: Source, image: pycolmap.Image) -> dict[str, Any]:
    """Return the row of a photograph by columns."""
    camera = source.model.cameras[image.camera_id]
    x, y, z = image.projection_center()
    qx, qy, qz, qw = image.cam_from_world().rotation.inverse().quat.tolist()
    return {
        "name": _no_formula(image.name),
        "x": x,
        "y": y,
        "z": z,
        "qw": qw,
        "qx": qx,
        "qy": qy,
        "qz": qz,
        "num_points": image.num_points3D,
        "camera": image.camera_id,
        "camera_model": camera.model.name,
        "width": camera.width,
        "height": camera.height,
        "focal_px": camera.mean_focal_length(),
        "params": " ".join(f"{value:.9g}" for value in camera.params),
    }


def _no_formula(text: str) -> str:
    """Put an apostrophe before a text that a spreadsheet would compute."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def _report(source: Source, folder: Path) -> Path:
    return write_report(source.path, folder / "report")


@dataclass(frozen=True)
class Format:
    """A format that models are exported to."""

    # Writes it into a folder, returns what it has written
    write: Callable[[Source, Path], Path]
    leaves: str  # what it leaves in the folder


FORMATS = {
    "ply": Format(_points, "points3D.ply"),
    "text": Format(_text, "text"),
    "undistorted": Format(_undistorted, DENSE),
    # Uses the folder of ``undistorted``, if it is there
    "nerfstudio": Format(_nerfstudio, DENSE),
    "mvsnet": Format(_mvsnet, DENSE),
    "cameras": Format(_cameras, "cameras.csv"),
    "report": Format(_report, "report"),
}

"""Formats by their names, in the order in which they are written."""
