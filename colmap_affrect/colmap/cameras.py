"""Cameras: what the user gives by options, table or model, and who knows each focal length.

COLMAP's database only has a flag that somebody does; ``cameras.json`` beside it says who.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import camera_like, read_given_model
from colmap_affrect.errors import OptionError, WorkspaceError, damage, made_again, such_as
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.checked_json import with_checksum, without_checksum
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.tables import read_table

Source = Literal["given", "exif", "exif-rescaled", "pairs", "guess"]
"""By the user; by EXIF as it is, or scaled to a photograph that was shrunk; by the votes of
verified pairs (older versions); or COLMAP's usual guess."""

Given = Literal["focal", "principal-point", "distortion"]
"""Parts of intrinsics; a model without distortion counts as given once its focal length is."""

TRUSTED: tuple[Source, ...] = ("given", "exif", "exif-rescaled")
"""Sources whose focal lengths are priors before any pair has been verified."""

MAX_LINES = 5  # groups of cameras that are logged


@dataclass(frozen=True)
class CameraRecord:
    """One camera of the database."""

    names: tuple[str, ...]  # of its images, sorted
    source: Source  # of the focal length
    focal_px: float  # in px of the stored file; the mean of two
    why: str = ""  # what was decided and for what reason, one clause
    size: tuple[int, int] = (0, 0)  # (width, height) of its images in px
    given: tuple[Given, ...] = ()  # what of the intrinsics is the user's, to be left as it is

    def to_report(self, camera_id: int, model: ModelSummary | None) -> dict[str, Any]:
        """Return the entry of ``report.json``, with the focal length that a model ended with."""
        longer = max(self.size)
        used = next((name for name in self.names if model and name in model.focals_px), None)
        return {
            "id": camera_id,
            "num_images": len(self.names),
            "names": list(self.names),
            "source": self.source,
            "focal_px": self.focal_px,
            "focal_longer_sides": self.focal_px / longer if longer else None,
            "refined_px": model.focals_px[used] if model and used else None,
            "why": self.why,
        }

    @property
    def is_fixed(self) -> bool:
        """Whether nothing of the intrinsics that mapping would refine is free."""
        return {"focal", "distortion"} <= set(self.given)


_RECORDS = TypeAdapter(dict[int, CameraRecord])


def read_camera_records(path: Path) -> dict[int, CameraRecord]:
    """Return the records by camera id; none without the file, WorkspaceError if it is damaged."""
    with damage(path, made_again("verify", path.parent), WorkspaceError):
        if not path.exists():
            return {}
        return _RECORDS.validate_json(without_checksum(path.read_bytes()))


def write_camera_records(path: Path, records: Mapping[int, CameraRecord]) -> None:
    """Replace the file as a whole."""
    content = _RECORDS.dump_json(dict(sorted(records.items())), indent=1)
    replace_text(path, with_checksum(content.decode()))


def notable_lines(records: Iterable[CameraRecord]) -> list[str]:
    """Return a line for the cameras of each source and reason, at most a few."""
    groups = defaultdict(list)
    for record in records:
        if record.why:
            groups[f"{record.source}: {record.why}"].append(record)
    lines = []
    for what, same in groups.items():
        names = [name for record in same for name in record.names]
        ends = sorted({round(record.focal_px) for record in same})
        focal = " to ".join(map(str, dict.fromkeys((ends[0], ends[-1]))))
        lines.append(f"{such_as(names)}: focal length {focal} px, {what}")
    more = len(lines) - MAX_LINES
    return lines if more <= 1 else [*lines[:MAX_LINES], f"and {more} more, see report.json"]


WIDTHS = ("sensor_width_mm", "plate_width_mm")
CENTER = ("cx", "cy")
COLUMNS = ("name", "camera", "model", "params", "focal_px", "focal_mm", *WIDTHS, *CENTER)
"""Of tables of cameras; only the name is needed."""

EXCLUSIVE: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("params",), COLUMNS[4:]),
    (("focal_px",), ("focal_mm", *WIDTHS)),
    (WIDTHS[:1], WIDTHS[1:]),
)
"""Columns of which a row may fill those of one side only."""


@dataclass(frozen=True)
class GivenCamera:
    """What the user says of the camera of an image; empty where nothing is said."""

    model: str = ""  # COLMAP's name of the camera model
    params: tuple[float, ...] = ()  # all parameters of the model
    focal_px: float = 0.0  # focal length
    focal_widths: float = 0.0  # focal length in units of the width of what the whole image shows
    principal_point: tuple[float, ...] = ()  # x, y in COLMAP's px, from the corner of the image
    size: tuple[int, ...] = ()  # (width, height) in px of the images that it is of
    label: str = field(default="", compare=False)  # images with one label share a camera
    where: str = field(default="", compare=False)  # file and line


def read_given_cameras(options: CameraOptions) -> dict[str, GivenCamera]:
    """Return the cameras that the user gives by image name; ``""`` stands for all other images.

    Raises OptionError for options that are wrong or contradict each other, and for a file that
    cannot be read, naming the line.
    """
    _require_model(options.model, "--camera-model")
    others = GivenCamera(
        model=options.model,
        params=_numbers(options.params, "--camera-params"),
        focal_px=options.focal_length_px,
        principal_point=_numbers(options.principal_point, "--principal-point"),
        where="the options",
    )
    if others.params and (others.focal_px or others.principal_point):
        raise OptionError(
            "--camera-params: has focal length and principal point already; leave out "
            "--focal-length-px and --principal-point"
        )
    _require_params(others, "--camera-params")
    if len(others.principal_point) not in (0, 2):
        raise OptionError(f"--principal-point {options.principal_point}: give cx,cy, two numbers")
    if not options.cameras_path:
        return {"": others}
    path = Path(options.cameras_path)
    is_model = path.is_dir() or path.name in ("cameras.txt", "cameras.bin")
    found = _read_model(path) if is_model else _read_table(path, others)
    return {"": others, **found}


def _numbers(text: str, where: str) -> tuple[float, ...]:
    """Read finite numbers that commas, semicolons or spaces separate."""
    try:
        values = tuple(float(word) for word in text.replace(",", " ").replace(";", " ").split())
    except ValueError as error:
        raise OptionError(f"{where} {text}: not numbers separated by commas") from error
    if not all(math.isfinite(value) for value in values):
        raise OptionError(f"{where} {text}: has a number that is not finite")
    return values


def _require_model(name: str, where: str) -> None:
    models = [
        model
        for model, number in pycolmap.CameraModelId.__members__.items()
        if (like := camera_like(number.value)) and len(like.focal_length_idxs())
    ]
    if name not in models:
        raise OptionError(f"{where} {name}: not one of {', '.join(models)}")


def _require_params(given: GivenCamera, where: str) -> None:
    if not given.params:
        return
    expected = pycolmap.Camera.create_from_model_name(1, given.model, 1.0, 1, 1)
    if len(given.params) != len(expected.params):
        raise OptionError(
            f"{where}: {given.model} needs {len(expected.params)} values "
            f"({expected.params_info}), not {len(given.params)}"
        )
    if any(given.params[index] <= 0.0 for index in expected.focal_length_idxs()):
        raise OptionError(f"{where}: a focal length of {given.params[0]:g} px cannot be")


def _read_model(path: Path) -> dict[str, GivenCamera]:
    folder = path if path.is_dir() else path.parent
    model = read_given_model(folder, "--cameras-path ")
    cameras = {
        key: GivenCamera(
            camera.model_name,
            tuple(camera.params.tolist()),
            size=(camera.width, camera.height),
            label=f"model/{key}",
            where=f"--cameras-path {folder}, camera {key}",
        )
        for key, camera in model.cameras.items()
    }
    return {image.name: cameras[image.camera_id] for image in model.images.values()}


def _read_table(path: Path, others: GivenCamera) -> dict[str, GivenCamera]:
    """Read a CSV file with a header; rows may leave cells empty."""
    found: dict[str, GivenCamera] = {}
    labels: dict[str, GivenCamera] = {}
    for place, row in read_table(path, f"--cameras-path {path}", COLUMNS):
        name = row.get("name", "")
        if not name or name in found:
            raise OptionError(f"{place}: {f'{name} is there twice' if name else 'has no name'}")
        given = found[name] = _read_row(row, others, place)
        first = labels.setdefault(given.label, given)
        if given.label and given != first:
            raise OptionError(
                f"{place}: says something else of camera '{row['camera']}' than "
                f"{first.where.rpartition(', ')[2]}; give them two labels, or the same values"
            )
    return found


def _read_row(row: Mapping[str, str], others: GivenCamera, where: str) -> GivenCamera:
    """Return the camera of a row; what it says nothing of is as in the options."""
    _refuse_contradictions(row, where)
    focal_px, focal_mm, *widths = (_number(row, column, where) for column in COLUMNS[4:8])
    center = tuple(_number(row, column, where) for column in CENTER if column in row)
    model = row.get("model", others.model)
    _require_model(model, f"{where}: model")
    params = _numbers(row.get("params", ""), f"{where}: params")
    has_focal = bool(params or focal_mm or focal_px)
    says_nothing = row.keys() <= {"name", "camera"}
    given = GivenCamera(
        model,
        params or (others.params if says_nothing else ()),
        focal_px or (0.0 if has_focal else others.focal_px),
        focal_mm / max(widths) if focal_mm else 0.0,
        center or (() if params else others.principal_point),
        label=f"label/{row['camera']}" if "camera" in row else "",
        where=where,
    )
    _require_params(given, f"{where}: params")
    return given


def _refuse_contradictions(row: Mapping[str, str], where: str) -> None:
    for columns in EXCLUSIVE:
        first, second = ([name for name in names if name in row] for names in columns)
        if first and second:
            raise OptionError(
                f"{where}: {first[0]} and {second[0]} say the same twice; leave one out"
            )
    if ("focal_mm" in row) != any(name in row for name in WIDTHS):
        raise OptionError(
            f"{where}: focal_mm needs sensor_width_mm or plate_width_mm, the width of what the "
            "whole image shows, and these need focal_mm"
        )
    if ("cx" in row) != ("cy" in row):
        raise OptionError(f"{where}: give both cx and cy, or none")


def _number(row: Mapping[str, str], column: str, where: str) -> float:
    """Return a number, positive unless it is a coordinate; 0 where there is none."""
    if column not in row:
        return 0.0
    values = _numbers(row[column], f"{where}: {column}")
    if len(values) != 1 or (values[0] <= 0.0 and column not in CENTER):
        kind = "number" if column in CENTER else "positive number"
        raise OptionError(f"{where}: {column} {row[column]}: not a {kind}")
    return values[0]


def unknown_names(
    given: Mapping[str, GivenCamera], image_path: Path, names: Sequence[str]
) -> list[str]:
    """Return the names in a table that no photograph has; of a model, if it has none of them."""
    others = [name for name in given if name and not (image_path / name).is_file()]
    is_model = any(camera.label.startswith("model/") for camera in given.values())
    return [] if is_model and given.keys() & set(names) else others


def with_shared_cameras(records: Mapping[int, CameraRecord]) -> dict[int, CameraRecord]:
    """Return records in which images of one size share a camera where nothing is known of it."""
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for key, record in sorted(records.items()):
        if record.source == "guess" and not record.given:
            groups[record.size].append(key)
    shared = dict(records)
    for keys in groups.values():
        same = [shared.pop(key) for key in keys]
        names = sorted(name for record in same for name in record.names)
        shared[keys[0]] = replace(same[0], names=tuple(names))
    return shared
