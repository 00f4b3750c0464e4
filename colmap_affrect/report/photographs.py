"""What a report says of each photograph, in figures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError
from colmap_affrect.options import documented
from colmap_affrect.project.line_report import LineReport
from colmap_affrect.project.report import SOURCES, SURE, ModelSummary
from colmap_affrect.report.observations import ModelReader, registered_images

NUM_NEIGHBOURS = 5  # that are named of each photograph; the viewer shows all
MODEL_FIGURES = (  # what the files of a model say
    "num_points", "mean_error_px", "neighbours", "num_neighbours", "focal_px", "distortion_px",
    "shift_px",
)  # fmt: skip

Quality = Literal["sure", "unsure", "doubtful", "missing"]
"""How far a pose can be trusted: right with 90 per cent or more, between, rather wrong than right;
or there is none."""


@documented
@dataclass(frozen=True)
class PhotographReport:
    """What is known of one photograph."""

    quality: Quality
    """``sure``, ``unsure``, ``doubtful``, or ``missing`` where it is in no model."""
    model: int | None = None
    """Number of the model that it is in, as in ``sparse/0``."""
    probability: float | None = None
    """Probability that its pose is right within 5 degrees."""
    num_points: int = 0
    """Points of the model that it sees."""
    mean_error_px: float | None = None
    """Mean distance between where it sees them and where the model has them, in px."""
    neighbours: dict[str, int] = field(default_factory=dict)
    """The photographs that share most points with it, and how many."""
    num_neighbours: int = 0
    """Photographs that share points with it."""
    focal_start_px: float | None = None
    """Focal length that mapping began with, in px."""
    focal_source: str = ""
    """Where that is from: ``given``, ``exif``, ``exif-rescaled``, ``guess`` or ``model``."""
    focal_px: float | None = None
    """Focal length in the model, in px."""
    focal_by_lines_px: float | None = None
    """Focal length by its straight lines, in px, where they tell it."""
    distortion_px: float | None = None
    """How far distortion moves the corner of the photograph outwards, in px."""
    shift_px: tuple[float, float] | None = None
    """How far right of and below its middle the optical axis is, in px."""


def quality_of(name: str, model: ModelSummary) -> Quality:
    """Return how far the pose of a photograph in a model can be trusted."""
    if name not in model.registered_names:
        return "missing"
    if name in model.doubtful:
        return "doubtful"
    is_sure = model.probabilities.get(name, 0.0) >= SURE
    return "sure" if is_sure else "unsure"


def photographs_of_report(
    reader: ModelReader,
    names: Sequence[str],
    models: Sequence[ModelSummary],
    cameras: Sequence[Mapping[str, Any]],
    lines: Mapping[str, LineReport],
    kept: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, PhotographReport]:
    """Return what is known of each photograph.

    Args:
        reader: of the models of the run.
        names: of all photographs.
        models: summaries of the models, the largest first.
        cameras: entries of ``report.json``, which say where focal lengths are from.
        lines: what straight lines say, by name.
        kept: figures of these models by name, which need not be counted again.

    Returns:
        Reports by name, in the order of the names.
    """
    begun = _of_cameras(cameras)
    placed = dict[str, dict[str, Any]]()
    for number, model in enumerate(models):
        figures = _of_model(reader, number) if kept is None else kept
        for name in model.registered_names:
            if name not in placed:
                placed[name] = {
                    **figures.get(name, {}),
                    "model": number,
                    "quality": quality_of(name, model),
                    "probability": model.probabilities.get(name),
                }
    found = {}
    for name in names:
        one = lines.get(name)
        found[name] = PhotographReport(
            **{"quality": "missing", **placed.get(name, {}), **begun.get(name, {})},
            focal_by_lines_px=one.focal_px if one and one.is_known else None,
        )
    return found


def _of_cameras(cameras: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the focal lengths that mapping begins with, and their sources, by photograph."""
    found = {}
    for camera in cameras:
        figures = {
            "focal_start_px": float(camera["focal_px"]),
            "focal_source": str(camera["source"]),
        }
        for name in camera["names"]:
            found[name] = figures
    return found


def _of_model(reader: ModelReader, number: int) -> dict[str, dict[str, Any]]:
    """Return the figures of the photographs of a model; none where it cannot be read."""
    try:
        model = reader.model(number)
        seen = reader.observations(number)
    except AffrectError:
        reader.unreadable.add(number)
        return {}
    counts = np.bincount(seen.rows, minlength=len(seen.names))
    errors_px = seen.mean_errors_px()
    found = {}
    for row, image in enumerate(registered_images(model)):
        shared = seen.num_shared[row]
        best = np.argsort(-shared, kind="stable")[:NUM_NEIGHBOURS].tolist()
        error_px = float(errors_px[row])
        found[image.name] = {
            "num_points": int(counts[row]),
            "mean_error_px": None if math.isnan(error_px) else round(error_px, 3),
            "neighbours": {
                seen.names[other]: int(shared[other]) for other in best if shared[other]
            },
            "num_neighbours": int(np.count_nonzero(shared)),
            **_of_intrinsics(model.cameras[image.camera_id]),
        }
    return found


def _of_intrinsics(camera: pycolmap.Camera) -> dict[str, Any]:
    """Return focal length, distortion and shift of a camera of a model."""
    if not len(camera.focal_length_idxs()):  # of a panorama
        return {}
    middle = np.array([camera.width, camera.height]) / 2.0
    axis = np.array([camera.principal_point_x, camera.principal_point_y])
    shift = axis - middle
    return {
        "focal_px": round(float(camera.mean_focal_length()), 1),
        "distortion_px": corner_distortion_px(camera),
        "shift_px": (round(float(shift[0]), 1), round(float(shift[1]), 1)),
    }


def corner_distortion_px(camera: pycolmap.Camera) -> float | None:
    """Return how far distortion moves the lower right corner outwards, in px; None if unknown."""
    corner = np.array([[camera.width, camera.height]], dtype=np.float64)
    ray = np.asarray(camera.cam_from_img(corner), dtype=np.float64)
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    axis = np.array([camera.principal_point_x, camera.principal_point_y])
    straight_px = float(np.linalg.norm(focal * ray[0]))
    distorted_px = float(np.linalg.norm(corner[0] - axis))
    difference_px = distorted_px - straight_px
    if not math.isfinite(difference_px):
        return None
    return round(difference_px, 1) + 0.0  # not -0.0


def facts_of(
    photograph: PhotographReport, lines: LineReport | None
) -> list[tuple[str, str]]:
    """Return what the page says of a photograph: titles and texts.

    Args:
        photograph: what is known of it.
        lines: what its straight lines say.
    """
    facts = []
    if photograph.model is not None:
        facts += [
            ("Points", f"{photograph.num_points:,}"),
            ("Mean residual", _px(photograph.mean_error_px, 2)),
            ("Neighbours", f"{photograph.num_neighbours}"),
        ]
    facts += [("Focal length", _focal_text(photograph))]
    if lines is not None:
        facts += [("By straight lines", lines.sentence())]
    if photograph.shift_px is not None:
        facts += [
            ("Distortion at the corner", _px(photograph.distortion_px, 1)),
            ("Optical axis off the middle", _shift_text(photograph.shift_px)),
        ]
    return facts


def _px(length: float | None, num_digits: int) -> str:
    return "not known" if length is None else f"{length:,.{num_digits}f} px"


def _focal_text(photograph: PhotographReport) -> str:
    """Return the focal lengths in the model and before, and where that was from."""
    texts = []
    if photograph.focal_px is not None:
        texts.append(f"{photograph.focal_px:,.0f} px in the model")
    if photograph.focal_start_px is not None:
        source = SOURCES.get(photograph.focal_source, photograph.focal_source)
        texts.append(f"{photograph.focal_start_px:,.0f} px at the start, {source}")
    return "; ".join(texts) or "not known"


def _shift_text(shift_px: tuple[float, float]) -> str:
    """Say where the optical axis is."""
    right, below = shift_px
    if not right and not below:
        return "0 px"
    across = f"{abs(right):,.0f} px {'right' if right > 0.0 else 'left'}"
    down = f"{abs(below):,.0f} px {'below' if below > 0.0 else 'above'}"
    return f"{across}, {down}"
