"""What ``report.json`` of a run has, as a JSON schema: ``docs/report.schema.json``."""

import json
from typing import Any, Literal

import pydantic

from colmap_affrect.mappers.camera_priors import FocalContradiction
from colmap_affrect.project.advised import Advice
from colmap_affrect.project.image_failures import FailureCode
from colmap_affrect.project.line_report import LineReport
from colmap_affrect.project.reasons import DoubtCode, MissingCode
from colmap_affrect.project.report import Bridge, MatchedAgain, Residual
from colmap_affrect.project.stage_warnings import WarningCode
from colmap_affrect.report.photographs import PhotographReport


class Described(pydantic.BaseModel):
    """What a part of the file has, and nothing else."""

    model_config = pydantic.ConfigDict(extra="forbid", use_attribute_docstrings=True)


class DoubtEntry(pydantic.BaseModel):
    """Why a pose may be wrong: beside these two, the numbers and names of the reason."""

    model_config = pydantic.ConfigDict(extra="allow", use_attribute_docstrings=True)

    code: DoubtCode
    """Kind of the reason."""
    text: str
    """The reason in words."""


class MissingEntry(Described):
    """Why a photograph is not in the largest model."""

    code: MissingCode
    """Kind of the reason."""
    text: str
    """The reason in words."""
    model: int = 0
    """Number of the smaller model that it is in."""
    verified_with: dict[str, int] = {}
    """Inliers of its best verified pairs, by the other photograph."""
    doubts: list[DoubtEntry] = []
    """Why it was taken out of the model."""


class WarningEntry(pydantic.BaseModel):
    """What went less well: beside these three, the numbers and names that belong to it."""

    model_config = pydantic.ConfigDict(extra="allow", use_attribute_docstrings=True)

    code: WarningCode
    """Kind of the warning."""
    about: str
    """An image, a file, a folder, or what else it is about."""
    text: str
    """The warning in words."""


class FailureEntry(pydantic.BaseModel):
    """Why a photograph cannot be used: beside these two, the numbers and names of the reason."""

    model_config = pydantic.ConfigDict(extra="allow", use_attribute_docstrings=True)

    code: FailureCode
    """Kind of the reason."""
    text: str
    """The reason in words."""


class StageEntry(Described):
    """One stage of a run."""

    name: str
    """``extract``, ``pairs``, ``match``, ``verify``, ``escalate``, ``guide`` or ``map``."""
    wall_s: float
    """Seconds that it took."""
    num_done: int
    """Images, pairs, cameras or models that were made now."""
    num_kept: int
    """Those that were there already."""
    failures: dict[str, str]
    """Why images cannot be used, in words, by their names."""
    failed: dict[str, FailureEntry]
    """The same with codes."""
    warnings: dict[str, str]
    """What went less well than asked for, in words, by what it is about."""
    warned: list[WarningEntry]
    """The same with codes."""


class CameraEntry(Described):
    """One camera of the database."""

    id: int
    """In the database."""
    num_images: int
    """Photographs that share it."""
    names: list[str]
    """Of these photographs."""
    source: Literal["given", "exif", "exif-rescaled", "guess", "model"]
    """Where its focal length is from."""
    focal_px: float
    """Focal length that mapping began with."""
    focal_longer_sides: float | None
    """The same in longer sides of the photograph."""
    refined_px: float | None
    """Focal length in the largest model."""
    why: str
    """What was decided on the camera, and for what reason."""
    lens_mm: float
    """Focal length in mm by EXIF, where the size of the sensor is not known; else 0."""
    given_principal_point_px: tuple[float, float] | None
    """What the user gives where the points of the largest model contradict it; else null."""
    fitting_principal_point_px: tuple[float, float] | None
    """What then fits better, roughly."""


class ReportFile(Described):
    """The content of report.json; what is said of a model is of the largest one."""

    status: Literal["ok", "partial", "doubtful", "no_model"]
    """``ok``: all photographs are in one model; ``doubtful``: fewer than two can be trusted."""
    images_total: int
    """Photographs that were given."""
    images_registered: int
    """Of them in the largest model."""
    registered_names: list[str]
    """Names of these."""
    photographs: dict[str, PhotographReport]
    """Figures of each photograph, by name."""
    made_from: str
    """Digest of these figures and of the models that they are of; empty without models."""
    probabilities: dict[str, float]
    """That the pose of a photograph is right within 5 degrees."""
    unsure: dict[str, list[DoubtEntry]]
    """Why photographs are neither sure nor doubtful, the main reason first."""
    doubtful: dict[str, list[DoubtEntry]]
    """Why photographs are rather wrong than right."""
    unregistered: dict[str, MissingEntry]
    """Why photographs are not in the largest model."""
    num_models: int
    """Models that were written."""
    models: list[list[str]]
    """Photographs of each model, the largest first: of ``sparse/0``, ``sparse/1`` and so on."""
    points3D: int
    """Points of the largest model."""
    mean_track_length: float
    """Photographs that see a point, on average."""
    mean_reprojection_error_px: float
    """Mean distance between observations and points."""
    hypotheses: list[str]
    """What made the model, by the sparse mapper."""
    one_view: list[tuple[str, str]]
    """Pairs of prints of one negative, or from one place."""
    bridges: dict[str, Bridge]
    """How photographs came in that are in no track through three photographs."""
    tie_points: list[Residual]
    """Residuals of tie points by hand, the worst first."""
    added: list[str]
    """Photographs that came into a model that was extended."""
    extended: list[str]
    """Photographs that were in that model."""
    num_verified_pairs: int
    """Pairs with a two-view geometry."""
    num_pairs: int
    """Pairs that were to be matched."""
    stages: list[StageEntry]
    """What each stage did, and how long that took."""
    advice: list[Advice]
    """What to try next: first commands, then what takes a person minutes, then hours."""
    by_hand: list[str]
    """What was done otherwise than matches alone say."""
    effort: str
    """How much was tried for photographs in need; empty where none was."""
    matched_again: list[MatchedAgain]
    """How pairs of photographs in need were matched again."""
    untried: list[MatchedAgain]
    """What a greater effort would try."""
    guided: dict[str, int]
    """``pairs`` that guided matching gave more inliers, ``matches_before``, ``matches_after``."""
    cameras: list[CameraEntry]
    """The cameras, and where their focal lengths are from."""
    lines: dict[str, LineReport]
    """What straight lines say of the cameras of photographs."""
    focal_contradictions: list[FocalContradiction]
    """Focal lengths of EXIF or the user that straight lines contradict."""
    recipe: str
    """Name of the recipe; empty for the database of another program."""
    preset: str
    """Preset of mapping: ``sparse``, ``colmap`` or ``custom``."""
    mapper: str
    """Name of the mapper."""
    mapper_options: dict[str, Any]
    """Options of COLMAP that were given to it."""
    mapping: dict[str, Any]
    """Its own options."""
    verification: dict[str, Any]
    """Options of two-view geometry."""
    random_seed: int
    """Of verification and mapping."""
    versions: dict[str, str]
    """Versions of Python and of the packages that decide results."""


def report_schema() -> str:
    """Return the JSON schema of ``report.json`` as text."""
    schema = ReportFile.model_json_schema()
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
