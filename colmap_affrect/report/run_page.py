"""A run as one page, ``report.html`` beside ``report.json``."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import Marks
from colmap_affrect.errors import such_as
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.camera_notes import camera_notes, merge_shared_cameras
from colmap_affrect.project.reasons import FATES, Doubt, text_of, texts_of
from colmap_affrect.project.report import (
    MAX_LINES,
    SOURCES,
    ModelSummary,
    ReconstructionReport,
    by_story,
    probability_text,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.page import TEMPLATES, Page, write_page
from colmap_affrect.report.pairs import LEGEND, PairPicture
from colmap_affrect.report.pictures import base64_text
from colmap_affrect.report.scene import View3D, read_view

KINDS = {
    "tracks": "registered by common points",
    "bridged": "bridged by one pair",
    "existing": "was in the model",
    "doubtful": "doubtful",
}
"""How cameras came in; each has a colour of this name."""

# More would make a page too large to be read or sent.
MAX_NUM_IN_MATRIX = 1000  # photographs; with more there is no matrix of inliers
MAX_NUM_MODELS = 6  # that are drawn
MAX_NUM_CAMERAS = 200  # in the table; report.json has all


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet."""

    name: str
    kind: str  # one of ``KINDS``, or ``missing``
    text: str
    groups: tuple[str, ...]  # what the buttons above the sheet choose by


@dataclass(frozen=True)
class RunContent:
    """What the page of a run has beside its report."""

    names: Sequence[str]  # of all photographs
    num_inliers: Mapping[Pair, int]  # of the verified pairs
    image_path: Path | None = None  # folder of the photographs, if known
    marks: Marks = field(default_factory=dict)  # of the tie points by hand
    pairs_to_check: Sequence[PairPicture] = ()
    cameras: Mapping[str, pycolmap.Camera] = field(
        default_factory=dict
    )  # in the database


def write_run_page(
    workspace: Workspace,
    report: ReconstructionReport,
    content: RunContent,
    progress: Progress = SILENT,
) -> Path:
    """Write ``report.html`` of a run, one file that loads nothing.

    Args:
        workspace: of the run.
        report: of the run.
        content: what else the page has.
        progress: where to show it.

    Returns:
        The path of the page.

    Raises:
        WorkspaceError: the page cannot be written.
    """
    names = content.names
    model = report.models[0] if report.models else ModelSummary((), 0, 0.0, 0.0)
    views = _views(workspace, report)
    known = set(names)
    num_inliers = {
        pair: count
        for pair, count in content.num_inliers.items()
        if known.issuperset(pair)
    }
    cameras = content.cameras
    page = Page(
        template=TEMPLATES / "run.html",
        content={
            "report": report,
            "model": model,
            "headline": f"{len(model.registered_names)} of {len(names)} photographs registered",
            "doubts": _doubts(report, model),
            "notes": [f"{name}: {why}" for name, why in report.warnings.items()],
            "max_num_lines": MAX_LINES,
            "views": views or [read_view(None, {})],
            "kinds": _kinds_legend(views),
            "cards": [_card(name, report, model) for name in names],
            "num_pairs": len(num_inliers),
            "pairs_to_check": content.pairs_to_check,
            "line_colors": LEGEND,
            **_cameras(report, names),
            "lines": list(report.lines.items())[:MAX_NUM_CAMERAS],
            "num_lines_known": sum(one.is_known for one in report.lines.values()),
            "wants_marks": bool(content.marks)
            or len(model.registered_names) < len(names),
            "residuals": [
                f"{one.point} in {one.image}: {one.error_px:.1f} px"
                for one in model.tie_points
            ],
        },
        names=names,
        image_path=content.image_path,
        views=views,
        inlier_matrix=inlier_matrix(names, num_inliers),
        tie_points=_tie_points(model, names, content.marks, cameras),
        can_mark=len(cameras.keys() & known) > 1,
    )
    return write_page(workspace.page, page, progress)


def _views(workspace: Workspace, report: ReconstructionReport) -> list[View3D]:
    """Read the largest models, with the kinds of their cameras."""
    views = []
    for number, model in enumerate(report.models[:MAX_NUM_MODELS]):
        kinds = {
            name: _card(name, report, model).kind for name in model.registered_names
        }
        views.append(read_view(workspace.sparse / str(number), kinds))
    return views


def _kinds_legend(views: Sequence[View3D]) -> dict[str, str]:
    """Return a text for each kind of cameras that there is."""
    counts = Counter[str]()
    for view in views:
        counts.update(view.kinds.values())
    return {
        kind: f"{text} ({counts[kind]})" for kind, text in KINDS.items() if counts[kind]
    }


def _card(name: str, report: ReconstructionReport, model: ModelSummary) -> Card:
    """Return what became of a photograph."""
    if name not in model.registered_names:
        why = report.unregistered.get(name)
        text = why.text() if why else FATES["not_registered"]
        if name in report.failures:
            text += f": {report.failures[name]}"
        return Card(name, "missing", text, ("all", "missing"))
    kind = "tracks"
    text = "registered"
    if name in model.bridges:
        kind = "bridged"
        text = model.bridges[name].text()
    if name in report.extended:
        kind = "existing"
        text = KINDS["existing"]
    groups = ["all", kind]
    if name in report.added:
        groups.append("added")
    if name in model.probabilities:
        text += f", right with a probability of {probability_text(model.probabilities[name])}"
    if name in model.unsure:
        text += "; not sure" + _own_reason(name, model.unsure)
    if name in model.doubtful:
        kind = "doubtful"
        text += "; doubtful" + _own_reason(name, model.doubtful)
        groups.append("doubtful")
    return Card(name, kind, text, tuple(groups))


def _own_reason(name: str, doubts: Mapping[str, tuple[Doubt, ...]]) -> str:
    """Return why an image is doubted; nothing where others are for the same reason.

    Such a reason is above the sheet only.
    """
    reasons = doubts[name]
    return f": {text_of(reasons)}" if list(doubts.values()).count(reasons) == 1 else ""


def _doubts(report: ReconstructionReport, model: ModelSummary) -> list[str]:
    """Return what cannot be trusted, or why there is no model and what became of photographs."""
    if report.models:
        unsure = [f"not sure: {line}" for line in by_story(texts_of(model.unsure))]
        return by_story(texts_of(model.doubtful)) + unsure
    why = report.why_no_model
    fates = {name: why.fate() for name, why in report.unregistered.items()}
    return [f"{why[0].upper()}{why[1:]}.", *by_story(fates)]


def _cameras(report: ReconstructionReport, names: Sequence[str]) -> dict[str, Any]:
    """Return the first cameras, each with its photographs, and the sources of all focal lengths."""
    numbers = {name: number for number, name in enumerate(names, 1)}
    rows = []
    for camera in merge_shared_cameras(report.cameras)[:MAX_NUM_CAMERAS]:
        known = [name for name in camera["names"] if name in numbers]
        photographs = such_as(f"{numbers[name]} {name}" for name in known)
        rows.append((camera, photographs))
    return {
        "cameras": rows,
        "source_counts": Counter(one["source"] for one in report.cameras).most_common(),
        "source_texts": SOURCES,
        "camera_notes": camera_notes(report.cameras),
    }


def _tie_points(
    model: ModelSummary,
    names: Sequence[str],
    marks: Marks,
    cameras: Mapping[str, pycolmap.Camera],
) -> dict[str, Any]:
    """Return what the tool for tie points begins with.

    Args:
        model: has the residuals of tie points.
        names: of all photographs.
        marks: (2,) px by point and photograph.
        cameras: of the photographs in the database, which have their sizes.
    """
    index = {name: number for number, name in enumerate(names)}
    errors_px = {(one.point, one.image): one.error_px for one in model.tie_points}
    rows = []
    for point, points in marks.items():
        for name, (x, y) in points.items():
            rows.append(
                [point, index[name], float(x), float(y), errors_px.get((point, name))]
            )
    photographs = []
    for name in names:
        camera = cameras.get(name)
        photographs.append([name, camera.width, camera.height] if camera else None)
    return {"photographs": photographs, "marks": rows}


def inlier_matrix(names: Sequence[str], num_inliers: Mapping[Pair, int]) -> str:
    """Return the numbers of inliers of all pairs as a matrix.

    Args:
        names: of the (N,) photographs.
        num_inliers: of pairs of these photographs.

    Returns:
        Base64 of the symmetric (N, N) uint16, row by row; empty for too many photographs.
    """
    if len(names) > MAX_NUM_IN_MATRIX:
        return ""
    index = {name: number for number, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)), dtype="<u2")
    for (name1, name2), inliers in num_inliers.items():
        row = index[name1]
        column = index[name2]
        counts[row, column] = counts[column, row] = min(
            inliers, np.iinfo(np.uint16).max
        )
    return base64_text(counts.tobytes())
