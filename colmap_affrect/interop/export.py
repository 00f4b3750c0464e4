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
from colmap_affrect.errors import ImageError, OptionError, StoreError, such_as
from colmap_affrect.images.orientation import forget_orientation
from colmap_affrect.images.reading import header_size
from colmap_affrect.interop.camera_models import with_camera_model
from colmap_affrect.interop.finished_models import read_finished_model, stand_upright
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

UP = np.array([0.0, 0.0, 1.0])  # of a model that was turned upright
FLIP_Y_Z = np.diag([1.0, -1.0, -1.0])  # from COLMAP's camera to that of OpenGL and nerfstudio


@dataclass(frozen=True)
class Source:
    """What is exported."""

    path: Path  # folder of the model
    model: pycolmap.Reconstruction  # its content
    image_path: Path | None  # folder of the photographs; None if it is not known
    is_upright: bool = False  # whether z is known to point up

    def images(self) -> list[pycolmap.Image]:
        """Return the registered images by name."""
        images = (self.model.image(image_id) for image_id in self.model.reg_image_ids())
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
    if image_path is not None and not image_path.is_dir():
        raise OptionError(f"--image-path {image_path}: no such folder")
    photographs = image_path or Workspace(resolved(model_path).parent.parent).photographs()
    source = Source(model_path, read_finished_model(model_path), photographs)
    upright = stand_upright(model_path, source.model)
    if upright:
        source = replace(source, is_upright=True)
        note(f"upright     {upright}: z is up")
    if not formats:
        formats = _usual(source)
    if camera_model:
        _change_cameras(source.model, camera_model, formats, note)
    chosen = {name: FORMATS[name] for name in FORMATS if name in formats}
    names = dict.fromkeys(made for _, made in chosen.values())
    targets = [output_path / name for name in names]
    images = [image.name for image in source.images()]
    with new_results(*targets, names=images) as made:
        folder = made[0].parent
        written = {name: write(source, folder) for name, (write, _) in chosen.items()}
    return {name: output_path / path.relative_to(folder) for name, path in written.items()}


def _checked_formats(given: str | Sequence[str]) -> list[str]:
    formats = given.split(",") if isinstance(given, str) else list(given)
    for name in formats:
        if name not in FORMATS:
            raise OptionError(f"--format {name}: unknown{suggestion(str(name), FORMATS)}")
    return formats


def _change_cameras(
    model: pycolmap.Reconstruction, name: str, formats: Sequence[str], note: Callable[[str], None]
) -> None:
    if not {"text", "cameras"}.intersection(formats):
        raise OptionError("--camera-model: changes 'text' and 'cameras'; give one of these formats")
    refuse_panoramas(model, "--camera-model")
    before = {key: camera.model_name for key, camera in model.cameras.items()}
    differences_px = with_camera_model(model, name)
    for old in sorted({before[key] for key in differences_px}):
        largest = max(px for key, px in differences_px.items() if before[key] == old)
        note(f"cameras: {name} in the place of {old}, at most {largest:.3f} px apart")


def _points(source: Source, folder: Path) -> Path:
    path = folder / "points3D.ply"
    with native_writes(path):
        source.model.export_PLY(path)
    return path


def _text(source: Source, folder: Path) -> Path:
    path = folder / "text"
    if why := _why_no_text(source):
        raise OptionError(
            f"text: {why}; rename the photographs and run again, or leave that format out and use "
            "the binary model as it is"
        )
    with native_writes(path):
        path.mkdir()
        source.model.write_text(path)
    return path


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
    photographs = source.image_path
    refuse_panoramas(source.model, "undistorted photographs")
    if photographs is None:
        raise OptionError("--image-path: give the folder of the photographs, to undistort them")
    for image in source.images():
        if leads_outside(image.name):
            raise OptionError(
                f"{source.path}: the image name {image.name} leads out of the folder of the "
                "photographs; rename it, no undistorted picture can be written for it"
            )
        if not (photographs / image.name).is_file():
            raise ImageError(f"{photographs / image.name}: no such photograph; give --image-path")
        _require_size(photographs / image.name, source.model.cameras[image.camera_id])
    given = folder.parent / "model"  # a run may remove that of its folder meanwhile
    if not given.exists():
        write_model(source.model, given)
    undistort(path, given, photographs)
    for image in source.images():
        if not (picture := path / "images" / image.name).is_file():
            raise ImageError(f"{picture.name}: COLMAP cannot undistort it, or write it")
        forget_orientation(picture)  # COLMAP takes over EXIF, by which others would turn it
    return path


def _require_size(path: Path, camera: pycolmap.Camera) -> None:
    """Refuse a photograph of another size than its camera has; ImageError."""
    size = header_size(path)
    expected = (camera.width, camera.height)
    if size not in (None, expected):
        raise ImageError(
            f"{path}: is {size[0]} x {size[1]} px, and its camera {expected[0]} x {expected[1]}; "
            "give the photographs that the model was made of as --image-path"
        )


def _nerfstudio(source: Source, folder: Path) -> Path:
    """Add to undistorted photographs what nerfstudio and Gaussian splatting read."""
    path = folder / DENSE if (folder / DENSE).exists() else _undistorted(source, folder)
    try:
        flat = Source(path, read_given_model(path / "sparse"), None, source.is_upright)
    except (OptionError, StoreError) as error:  # which COLMAP does not say when it writes
        raise why_not_written(path / "sparse", error) from error
    frames = []
    for image in flat.images():
        camera = flat.model.cameras[image.camera_id]
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose[:3, :3] = pose[:3, :3] @ FLIP_Y_Z
        frames.append({
            "file_path": f"images/{image.name}",
            "transform_matrix": pose.tolist(),
            "fl_x": camera.focal_length_x, "fl_y": camera.focal_length_y,
            "cx": camera.principal_point_x, "cy": camera.principal_point_y,
            "w": camera.width, "h": camera.height,
        })  # fmt: skip
    with native_writes(path):
        flat.model.export_PLY(path / "points3D.ply")
        (path / "sparse" / "0").mkdir(exist_ok=True)  # where Gaussian splatting looks
        flat.model.write(path / "sparse" / "0")
    content = {
        "camera_model": "OPENCV", "ply_file_path": "points3D.ply", **_place(flat), "frames": frames,
    }  # fmt: skip
    replace_text(path / "transforms.json", json.dumps(content, indent=1) + "\n")
    return path / "transforms.json"


def _mvsnet(source: Source, folder: Path) -> Path:
    """Add to undistorted photographs their model as text, as MVSNet's programs read it."""
    path = folder / DENSE if (folder / DENSE).exists() else _undistorted(source, folder)
    pycolmap.Reconstruction(path / "sparse").write_text(path / "sparse")
    return path


def _place(source: Source) -> dict[str, Any]:
    """Return what instant-ngp puts into its unit cube, centred on the points, and where up is.

    Cameras are then 1.32 from the middle on average, as its own converter has them.
    """
    poses = np.array([image.cam_from_world().inverse().matrix() for image in source.images()])
    points = [point.xyz for point in source.model.points3D.values()]
    middle = np.median(points or poses[:, :, 3], axis=0)
    half = np.linalg.norm(poses[:, :, 3] - middle, axis=1).mean() / 2.64 or 1.0
    box = [(middle - half).tolist(), (middle + half).tolist()]
    up = UP if source.is_upright else -poses[:, :, 1].mean(axis=0)
    return {"aabb_scale": 32, "aabb": box, "up": (up / np.linalg.norm(up)).tolist()}


def _cameras(source: Source, folder: Path) -> Path:
    """Write a table of photographs: their cameras, and poses world_from_cam (docs/formats.md)."""
    path = folder / "cameras.csv"
    rows: list[dict[str, Any]] = []
    for image in source.images():
        camera = source.model.cameras[image.camera_id]
        center = image.projection_center()
        qx, qy, qz, qw = image.cam_from_world().rotation.inverse().quat.tolist()
        rows.append({
            "name": _no_formula(image.name), **dict(zip("xyz", center, strict=True)),
            "qw": qw, "qx": qx, "qy": qy, "qz": qz,
            "num_points": image.num_points3D, "camera": image.camera_id,
            "camera_model": camera.model.name, "width": camera.width, "height": camera.height,
            "focal_px": camera.mean_focal_length(),
            "params": " ".join(f"{value:.9g}" for value in camera.params),
        })  # fmt: skip
    table = io.StringIO()
    writer = csv.DictWriter(table, rows[0] if rows else ["name"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_text(path, table.getvalue())
    return path


def _no_formula(text: str) -> str:
    """Put an apostrophe before a text that a spreadsheet would compute."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


FORMATS: dict[str, tuple[Callable[[Source, Path], Path], str]] = {
    "ply": (_points, "points3D.ply"),
    "text": (_text, "text"),
    "undistorted": (_undistorted, DENSE),
    "nerfstudio": (_nerfstudio, DENSE),  # comes after ``undistorted``, whose folder it uses
    "mvsnet": (_mvsnet, DENSE),
    "cameras": (_cameras, "cameras.csv"),
}
"""What writes each format into a folder, and what it leaves there."""
