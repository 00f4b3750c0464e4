"""A run as one page, ``report.html`` beside ``report.json``."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap.by_hand import Marks
from colmap_affrect.colmap.database import read_cameras
from colmap_affrect.errors import such_as
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import (
    MAX_LINES,
    SOURCES,
    ModelSummary,
    ReconstructionReport,
    as_mapped,
    by_story,
    camera_notes,
    probability_text,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.page import TEMPLATES, write_page
from colmap_affrect.report.pairs import KINDS as LINES
from colmap_affrect.report.pictures import base64_text
from colmap_affrect.report.scene import read_view

KINDS = {
    "tracks": "registered by common points",
    "bridged": "bridged by one pair",
    "existing": "was in the model",
    "doubtful": "doubtful",
}
"""How cameras came in; each has a colour of this name."""

MAX_NUM_IN_MATRIX = 1000  # photographs; with more there is no matrix of inliers
MAX_NUM_MODELS = 6  # that are drawn
MAX_NUM_CAMERAS = 200  # in the table; report.json has all


@dataclass(frozen=True)
class Card:
    """What became of a photograph."""

    name: str
    kind: str  # one of ``KINDS``, or ``missing``
    text: str
    groups: tuple[str, ...]


def write_run_page(
    workspace: Workspace,
    report: ReconstructionReport,
    names: Sequence[str],
    pair_inliers: Mapping[Pair, int],
    image_path: Path | None,
    progress: Progress = SILENT,
    *,
    marks: Marks | None = None,
    looks: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Write ``report.html`` of a run, one file that loads nothing; WorkspaceError if it cannot.

    ``names`` are those of all photographs, ``image_path`` their folder, if known; ``pair_inliers``
    are of the verified pairs, ``marks`` those of the tie points by hand; ``looks`` see
    :func:`.pairs.pairs_of_page`.
    """
    model = report.models[0] if report.models else ModelSummary((), 0, 0.0, 0.0)
    cards = [_card(name, report, model) for name in names]
    known = set(names)
    pair_inliers = {pair: n for pair, n in pair_inliers.items() if known >= set(pair)}
    shown = report.models[:MAX_NUM_MODELS]
    kinds = [{name: _card(name, report, m).kind for name in m.registered_names} for m in shown]
    views = [read_view(workspace.sparse / str(k)) for k in range(len(shown))] or [read_view(None)]
    counts = Counter(kind for of_model in kinds for kind in of_model.values())
    content = {
        "report": report,
        "model": model,
        "headline": f"{len(model.registered_names)} of {len(names)} photographs registered",
        "doubts": _doubts(report, model),
        "notes": [f"{name}: {why}" for name, why in report.warnings.items()],
        "max_num_lines": MAX_LINES,
        "views": views,
        "kinds": {kind: f"{text} ({counts[kind]})" for kind, text in KINDS.items() if counts[kind]},
        "cards": cards,
        "num_pairs": len(pair_inliers),
        "looks": looks,
        "line_colors": LINES,
        "matrix": _matrix(names, pair_inliers),
        **_cameras(report, names),
        **_tie_points(workspace, model, names, marks or {}),
    }
    template, drawn = TEMPLATES / "run.html", zip(views, kinds, strict=False)
    return write_page(workspace.page, template, content, names, image_path, drawn, progress)


def _card(name: str, report: ReconstructionReport, model: ModelSummary) -> Card:
    if name not in set(model.registered_names):
        text = report.unregistered.get(name, "not registered")
        text += f": {report.failures[name]}" if name in report.failures else ""
        return Card(name, "missing", text, ("all", "missing"))
    bridge = model.bridges.get(name)
    kind, text = ("bridged", bridge.text()) if bridge else ("tracks", "registered")
    if name in report.extended:
        kind, text = "existing", KINDS["existing"]
    groups = ["all", kind, *(["added"] if name in report.added else [])]
    if name in model.probabilities:
        text += f", right with a probability of {probability_text(model.probabilities[name])}"
    if name in model.unsure:
        why, reasons = model.unsure[name], list(model.unsure.values())
        text += "; not sure" + f": {why}" * (reasons.count(why) == 1)
    if name in model.doubtful:
        why, reasons = model.doubtful[name], list(model.doubtful.values())
        kind, text = "doubtful", f"{text}; doubtful" + f": {why}" * (reasons.count(why) == 1)
        groups.append("doubtful")
    return Card(name, kind, text, tuple(groups))


def _doubts(report: ReconstructionReport, model: ModelSummary) -> list[str]:
    """Return what cannot be trusted, or why there is no model and what became of photographs."""
    if report.models:
        unsure = [f"not sure: {line}" for line in by_story(model.unsure)]
        return by_story(model.doubtful) + unsure
    why = report.why_no_model
    fates = {name: fate.partition(";")[0] for name, fate in report.unregistered.items()}
    return [f"{why[0].upper()}{why[1:]}.", *by_story(fates)]


def _cameras(report: ReconstructionReport, names: Sequence[str]) -> dict[str, Any]:
    """Return the cameras that are listed, with photographs, and how many lengths are from where."""
    numbered = {name: f"{number} {name}" for number, name in enumerate(names, 1)}
    cameras = [
        (camera, such_as(numbered[name] for name in camera["names"] if name in numbered))
        for camera in as_mapped(report.cameras)[:MAX_NUM_CAMERAS]
    ]
    counts = Counter(camera["source"] for camera in report.cameras).most_common()
    notes = camera_notes(report.cameras)
    return {
        "cameras": cameras, "source_counts": counts, "source_texts": SOURCES, "camera_notes": notes,
    }  # fmt: skip


def _tie_points(
    workspace: Workspace, model: ModelSummary, names: Sequence[str], marks: Marks
) -> dict[str, Any]:
    """Return what the tool for tie points begins with, sizes as stored and marks in px."""
    cameras = read_cameras(workspace.database) if workspace.database.exists() else {}
    sizes = {name: [name, camera.width, camera.height] for name, camera in cameras.items()}
    index = {name: number for number, name in enumerate(names)}
    errors = {(one.point, one.image): one.error_px for one in model.tie_points}
    shown = [
        [point, index[name], *place.tolist(), errors.get((point, name))]
        for point, places in marks.items()
        for name, place in places.items()
    ]
    return {
        "tie_points": {"photographs": [sizes.get(name) for name in names], "marks": shown},
        "can_mark": len(sizes.keys() & index.keys()) > 1,
        "wants_marks": bool(marks) or len(model.registered_names) < len(names),
        "residuals": [f"{r.point} in {r.image}: {r.error_px:.1f} px" for r in model.tie_points],
    }


def _matrix(names: Sequence[str], pair_inliers: Mapping[Pair, int]) -> str:
    """Return the symmetric (N, N) uint16 inliers of pairs, row by row, as base64."""
    if len(names) > MAX_NUM_IN_MATRIX:
        return ""
    index = {name: number for number, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)), dtype="<u2")
    for (name1, name2), inliers in pair_inliers.items():
        row, column = index[name1], index[name2]
        counts[row, column] = counts[column, row] = min(inliers, np.iinfo(np.uint16).max)
    return base64_text(counts.tobytes())
