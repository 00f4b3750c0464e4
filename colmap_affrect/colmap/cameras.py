"""Cameras: what the user gives by options, table or model, and the source of each focal length.

COLMAP's database only has a flag that it is known; ``cameras.json`` beside it says its source.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pydantic

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import CHECKS
from colmap_affrect.colmap.model_files import camera_like, read_given_model
from colmap_affrect.errors import (
    Option,
    OptionError,
    Row,
    WorkspaceError,
    damage,
    how_to_make_again,
)
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.options import Options
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.sealed_json import read_sealed, write_sealed
from colmap_affrect.project.tables import read_table

Source = Literal["given", "exif", "exif-rescaled", "guess", "model"]
"""By the user; by EXIF as it is, or scaled to a photograph that was shrunk; COLMAP's guess; or, in
reports only, of a model that is extended."""
Given = Literal["focal", "principal-point", "distortion"]
"""Parts of intrinsics; a model without distortion counts as given once its focal length is."""
EXIF_SOURCES: tuple[Source, ...] = ("exif", "exif-rescaled")
TRUSTED: tuple[Source, ...] = ("given", *EXIF_SOURCES)
"""Sources whose focal lengths are priors before any pair has been verified."""


@dataclass(frozen=True)
class CameraRecord:
    """One camera of the database."""

    names: tuple[str, ...]  # of its images, sorted
    source: Source  # of the focal length
    focal_px: float  # in px of the stored file; the mean of two
    why: str = ""  # what was decided and for what reason, one clause
    size: tuple[int, int] = (0, 0)  # (width, height) of its images in px
    # What of the intrinsics is the user's, to be left as it is
    given: tuple[Given, ...] = ()
    # By EXIF, where nothing tells the size of the sensor, and so the px
    lens_mm: float = 0.0
    uncropped_px: float = 0.0  # what EXIF says of a crop, if it was not scaled; else 0

    def to_report(self, camera_id: int, model: ModelSummary | None) -> dict[str, Any]:
        """Return the entry of ``report.json``.

        Args:
            camera_id: of the camera in the database.
            model: has the focal length that it ended with; None if there is no model.
        """
        longer = max(self.size)
        return {
            "id": camera_id,
            "num_images": len(self.names),
            "names": list(self.names),
            "source": self.source,
            "focal_px": self.focal_px,
            "focal_longer_sides": self.focal_px / longer if longer else None,
            "refined_px": self._refined_px(model) if model else None,
            "why": self.why,
            "lens_mm": self.lens_mm,
            **self._contradicted_principal_point(model),
        }

    def _refined_px(self, model: ModelSummary) -> float | None:
        """Return the focal length that a model ended with, None if it has no image of this one."""
        for name in self.names:
            if name in model.focals_px:
                return model.focals_px[name]
        return None

    def _contradicted_principal_point(
        self, model: ModelSummary | None
    ) -> dict[str, list[float] | None]:
        """Return the given principal point and a better one where a model contradicts it."""
        for one in model.principal_point_contradictions if model else ():
            if not one.turns_deg.keys().isdisjoint(self.names):
                return {
                    "given_principal_point_px": list(one.given_px),
                    "fitting_principal_point_px": list(one.fitting_px),
                }
        return {"given_principal_point_px": None, "fitting_principal_point_px": None}

    @property
    def is_all_given(self) -> bool:
        """Whether nothing of the intrinsics that mapping would refine is free."""
        return {"focal", "distortion"} <= set(self.given)


_RECORDS = pydantic.TypeAdapter(dict[int, CameraRecord])


def read_camera_records(path: Path) -> dict[int, CameraRecord]:
    """Return the records by camera id; none without the file, WorkspaceError if it is damaged."""
    with damage(path, how_to_make_again("verify", path.parent), WorkspaceError):
        if not path.exists():
            return {}
        return _RECORDS.validate_python(read_sealed(path))


def write_camera_records(path: Path, records: Mapping[int, CameraRecord]) -> None:
    """Replace the file as a whole."""
    ordered = dict(sorted(records.items()))
    write_sealed(path, _RECORDS.dump_json(ordered))


@cache
def known_model(name: str) -> str:
    """Refuse what is no camera model of COLMAP with a focal length."""
    if name == "EQUIRECTANGULAR":
        raise ValueError(f"{name}: {CHECKS['camera-panorama']['advice']}")
    models = []
    for model, number in pycolmap.CameraModelId.__members__.items():
        like = camera_like(number.value)
        if like and len(like.focal_length_idxs()):
            models.append(model)
    if name not in models:
        raise ValueError(f"{name} is not one of {', '.join(models)}")
    return name


def _split(text: object) -> object:
    """Separate numbers at commas, semicolons and spaces."""
    if not isinstance(text, str):
        return text
    numbers = text.replace(",", " ").replace(";", " ").split()
    if text and not numbers:
        raise ValueError("holds no numbers")
    return numbers


MOST = 1e7  # px, or mm: nothing can be computed with cameras of larger numbers; damage
LEAST = 1e-3  # px, or mm: no image of a photograph is so small; damage
Positive = Annotated[float, pydantic.Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
Finite = Annotated[float, pydantic.Field(ge=-MOST, le=MOST, allow_inf_nan=False)]


class GivenCamera(Options):
    """What the user says of the camera of an image, in a table, a model or the options."""

    model_config = pydantic.ConfigDict(strict=False)

    name: str
    """Of the image; empty for all others."""
    camera: str = ""
    """Label; images with the same one share a camera."""
    model: Annotated[str, pydantic.AfterValidator(known_model)]
    params: Annotated[tuple[Finite, ...], pydantic.BeforeValidator(_split)] = ()
    focal_px: Positive | None = None
    focal_mm: Positive | None = None
    plate_width_mm: Positive | None = None
    """Width of what the whole image shows, of a plate or a sensor."""
    cx: Finite | None = None
    cy: Finite | None = None
    """Principal point in COLMAP's px, from the corner of the image."""
    size: tuple[int, ...] = ()
    """(width, height) in px of its images; only of a model."""
    where: pydantic.InstanceOf[Row] = Row("", "")
    """File and line."""

    @cached_property
    def said(self) -> Self:
        """The same of any image: equal where the same is said."""
        return self.changed(name="", camera="", where=Row("", ""))

    @property
    def mean_focal_px(self) -> float:
        """Focal length that its parameters say, the mean of two; it has some."""
        like = pycolmap.Camera.create_from_model_name(1, self.model, 1.0, 1, 1)
        like.params = list(self.params)
        return float(like.mean_focal_length())

    @pydantic.model_validator(mode="after")
    def _says_all_once(self) -> Self:
        if self.params and (self.focal_px or self.focal_mm or self.cx is not None):
            raise ValueError(
                "params have focal length and principal point; leave these out"
            )
        if self.focal_px and self.focal_mm:
            raise ValueError("focal_px and focal_mm say the same twice; leave one out")
        if (self.focal_mm is None) != (self.plate_width_mm is None):
            raise ValueError(
                "focal_mm needs plate_width_mm, the width of what the whole image shows, and the "
                "other way round"
            )
        if (self.cx is None) != (self.cy is None):
            raise ValueError("give both cx and cy, or none")
        if self.params:
            self._check_params()
        return self

    def _check_params(self) -> None:
        """Refuse parameters that are not those of the camera model."""
        like = pycolmap.Camera.create_from_model_name(1, self.model, 1.0, 1, 1)
        if len(self.params) != len(like.params):
            raise ValueError(
                f"params: {self.model} needs {len(like.params)} values ({like.params_info}), not "
                f"{len(self.params)}"
            )
        focals_px = [self.params[index] for index in like.focal_length_idxs()]
        if min(focals_px) < LEAST:
            raise ValueError(
                f"params: a focal length of {min(focals_px):g} px cannot be"
            )


def read_given_cameras(options: CameraOptions) -> dict[str, GivenCamera]:
    """Return the cameras that the user gives by image name; ``""`` stands for all other images.

    Raises OptionError for options that are wrong or contradict each other, and for a file that
    cannot be read, naming the line.
    """
    if bool(options.focal_mm) != bool(options.film_width_mm):
        raise OptionError(
            "one without the other",
            where=(Option("focal-mm"), ", ", Option("film-width-mm")),
            advice="give both",
        )
    says = {"name": "", "model": options.model, "params": options.params}
    if options.focal_length_px:
        says["focal_px"] = str(options.focal_length_px)
    if options.principal_point:
        says["cx"], _, says["cy"] = options.principal_point.replace(",", " ").partition(
            " "
        )
    where = (
        (Option("camera-model"), ", ", Option("camera-params"), ", "),
        (Option("focal-length-px"), " or ", Option("principal-point")),
    )
    options_alone = Row("", "the options")
    others = GivenCamera.from_mapping({**says, "where": options_alone}, where)
    if not options.cameras_path:
        return {"": others}
    path = Path(options.cameras_path)
    is_model = path.is_dir() or path.name in ("cameras.txt", "cameras.bin")
    found = _read_model(path) if is_model else _read_table(path, others)
    return {"": others, **found}


def _read_model(path: Path) -> dict[str, GivenCamera]:
    folder = path if path.is_dir() else path.parent
    model = read_given_model(folder, "cameras-path", needs_poses=False)
    cameras = {}
    for key, camera in model.cameras.items():
        where = Row(Option("cameras-path", folder), f"camera {key}")
        says = {
            "name": "",
            "camera": str(key),
            "model": camera.model_name,
            "params": tuple(camera.params.tolist()),
            "size": (camera.width, camera.height),
            "where": where,
        }
        cameras[key] = GivenCamera.from_mapping(says, where)
    return {image.name: cameras[image.camera_id] for image in model.images.values()}


def _read_table(path: Path, others: GivenCamera) -> dict[str, GivenCamera]:
    """Read a CSV file with a header; rows may leave cells empty, which are as in the options."""
    found: dict[str, GivenCamera] = {}
    labels: dict[str, GivenCamera] = {}
    columns = list(GivenCamera.model_fields.keys() - {"size", "where"})
    for place, cells in read_table(path, "cameras-path", columns):
        says = {"model": others.model, **cells, "where": place}
        given = GivenCamera.from_mapping(says, place)
        if given.name in found:
            raise OptionError(f"{given.name} is there twice", where=place)
        given = _completed(given, cells, others)
        found[given.name] = given
        first = labels.setdefault(given.camera, given)
        if given.camera and given.said != first.said:
            raise OptionError(
                f"says something else of camera '{given.camera}' than "
                f"{first.where.part}",
                where=place,
                advice="give them two labels, or the same values",
            )
    return found


def _completed(
    given: GivenCamera, cells: Mapping[str, str], others: GivenCamera
) -> GivenCamera:
    """Return the camera of a row of a table; what its cells do not say is as in ``others``."""
    if cells.keys() <= {"name", "camera"}:
        given = given.changed(params=others.params)
    if not (given.params or given.focal_px or given.focal_mm):
        given = given.changed(focal_px=others.focal_px)
    if not given.params and given.cx is None:
        given = given.changed(cx=others.cx, cy=others.cy)
    return given


def with_shared_cameras(records: Mapping[int, CameraRecord]) -> dict[int, CameraRecord]:
    """Return records in which images of one size share a camera where nothing is known of it."""
    groups = defaultdict[tuple[int, int], list[int]](list)
    for camera_id, record in sorted(records.items()):
        if record.source == "guess" and not record.given:
            groups[record.size].append(camera_id)
    shared = dict(records)
    for camera_ids in groups.values():
        first = records[camera_ids[0]]
        names = list[str]()
        for camera_id in camera_ids:
            names.extend(shared.pop(camera_id).names)
        shared[camera_ids[0]] = replace(first, names=tuple(sorted(names)))
    return shared
