"""A run as one page, ``report.html`` beside ``report.json``."""

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import Marks
from colmap_affrect.errors import such_as, with_flags
from colmap_affrect.options import digest_of
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.camera_notes import camera_notes, merge_shared_cameras
from colmap_affrect.project.reasons import FATES, Doubt, text_of
from colmap_affrect.project.report import (
    MAX_LINES,
    SOURCES,
    by_story,
    largest_of,
    probability_text,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.page import TEMPLATES, Page, write_page
from colmap_affrect.report.pair_lines import PairFile, PairLines
from colmap_affrect.report.pairs import LEGEND, PairPicture
from colmap_affrect.report.photographs import (
    PhotographReport,
    Quality,
    facts_of,
    quality_of,
)
from colmap_affrect.report.pictures import base64_text
from colmap_affrect.report.run_report import RunReport, contradiction_words
from colmap_affrect.report.scene import (
    View3D,
    max_num_observations,
    read_view,
    read_view_with_tracks,
)
from colmap_affrect.report.verdict import QUALITIES, SIGNS, tool_of, verdict_of
from colmap_affrect.report.why_not_sure import groups_of

# More would make a page too large to be read or sent.
MAX_NUM_IN_MATRIX = 1000  # photographs; with more there is no matrix of inliers
MAX_NUM_MODELS = 6  # that are drawn
MAX_NUM_NAMED = 3  # photographs of a reason that are told by name; display
MAX_NUM_CAMERAS = 200  # in the table; report.json has all
NUM_KEY_LETTERS = 16  # of the digests by which a browser keeps marks and masks

SCRIPTS = ("page.js", "geometry.js", "pairs.js", "viewer.js")
TOOL_SCRIPTS = ("tie_points.js", "places.js", "masks.js")


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet."""

    name: str
    kind: Quality
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
    pair_lines: PairLines = field(default_factory=PairLines)
    pair_files: Sequence[PairFile] = ()  # beside the page
    num_pairs_left_out: int = 0  # verified ones, in neither
    # In the database
    cameras: Mapping[str, pycolmap.Camera] = field(default_factory=dict)
    marks_command: str = ""  # maps again with marks that are saved
    masks_command: str = ""  # runs anew with masks that are saved
    reader: ModelReader | None = None  # of the models; one of its own where None
    key: str = ""  # of all that it is made from; empty where nothing tells


def write_run_page(
    workspace: Workspace,
    report: RunReport,
    content: RunContent,
    progress: Progress = SILENT,
) -> Path:
    """Write ``report.html`` of a run, one file that loads nothing but what is beside it.

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
    known = set(names)
    num_inliers = {
        pair: count
        for pair, count in content.num_inliers.items()
        if known.issuperset(pair)
    }
    photographs = _known_photographs(report, names)
    views = _views(content.reader or ModelReader(workspace.sparse), report)
    can_mark = len(content.cameras.keys() & known) > 1
    page = Page(
        template=TEMPLATES / "run.html",
        content={
            **_content(report, content, photographs),
            "views": views or [read_view(None, {})],
            "num_pairs": len(num_inliers),
            "can_mark": can_mark,
        },
        names=names,
        image_path=content.image_path,
        views=views,
        inlier_matrix=inlier_matrix(names, num_inliers),
        script_data={
            **_tools(report, content),
            "pair_lines": content.pair_lines.script_data(),
            "pair_files": [[file.name, *file.first] for file in content.pair_files],
            "num_pairs_left_out": content.num_pairs_left_out,
            "line_colors": list(LEGEND.values()),
            "facts": _facts(report, photographs, names),
            "neighbours": _neighbours(report, photographs, names),
        },
        scripts=SCRIPTS + TOOL_SCRIPTS if can_mark else SCRIPTS,
        reads_files=bool(content.pair_files),
        made_from=f"{content.key} {len(content.pair_files)}" if content.key else "",
    )
    return write_page(workspace.page, page, progress)


def _facts(
    report: RunReport,
    photographs: Mapping[str, PhotographReport],
    names: Sequence[str],
) -> list[list[tuple[str, str]]]:
    """Return what the dialog says of photographs, first reasons that their cards leave out."""
    shared = dict[str, str]()
    for model in report.models:
        doubts = {**model.unsure, **model.doubtful}
        for name, reasons in doubts.items():
            if not _own_reason(name, doubts):
                shared[name] = text_of(reasons)
    found = []
    for name in names:
        facts = facts_of(photographs[name], report.lines.get(name))
        if name in shared:
            facts.insert(0, ("Why not surer", shared[name]))
        found.append(facts)
    return found


def _neighbours(
    report: RunReport,
    photographs: Mapping[str, PhotographReport],
    names: Sequence[str],
) -> list[list[tuple[int, int, str]]]:
    """Return which photographs share most with each: their numbers, how many, and of what."""
    index = {name: number for number, name in enumerate(names)}
    found = []
    for name in names:
        shared = photographs[name].neighbours
        kind = "points"
        if not shared and name in report.unregistered:
            shared = report.unregistered[name].partners
            kind = "inliers"
        rows = []
        for other, num in shared.items():
            if other in index:
                rows.append((index[other], num, kind))
        found.append(rows)
    return found


def _known_photographs(
    report: RunReport, names: Sequence[str]
) -> dict[str, PhotographReport]:
    """Return what is known of all photographs, by the models alone where nothing else is."""
    found = dict(report.photographs)
    for name in names:
        if name not in found:
            found[name] = PhotographReport("missing")
    return found


def _content(
    report: RunReport,
    content: RunContent,
    photographs: Mapping[str, PhotographReport],
) -> dict[str, Any]:
    """Return the variables of the template."""
    names = content.names
    model = largest_of(report.models)
    verdict = verdict_of(report, names, photographs)
    return {
        "report": report,
        "model": model,
        "verdict": verdict,
        "tool_of": tool_of,
        "qualities": QUALITIES,
        "signs": SIGNS,
        "photographs": [(name, photographs[name]) for name in names[:MAX_NUM_CAMERAS]],
        "contradictions": [
            with_flags(contradiction_words(one)) for one in report.focal_contradictions
        ],
        "why_no_model": _why_no_model(report),
        "reasons": groups_of(names, report.models, report.unregistered),
        "after_next_run": _command_to_compare(report.output_path),
        "notes": [
            f"{name}: {why}" for name, why in report.stage_warnings(with_flags).items()
        ],
        "max_num_lines": MAX_LINES,
        "max_num_named": MAX_NUM_NAMED,
        "cards": [_card(name, report, photographs[name]) for name in names],
        "pairs_to_check": content.pairs_to_check,
        "marks_command": content.marks_command,
        "masks_command": content.masks_command,
        "line_colors": LEGEND,
        **_cameras(report, names),
        "lines": list(report.lines.items())[:MAX_NUM_CAMERAS],
        "num_lines_known": sum(one.is_known for one in report.lines.values()),
        "wants_marks": bool(content.marks) or "missing" in verdict.counts,
        "residuals": [
            f"{one.point} in {one.image}: {one.error_px:.1f} px"
            for one in model.tie_points
        ],
    }


def _views(reader: ModelReader, report: RunReport) -> list[View3D]:
    """Read the largest models, with the classes of their photographs as colours."""
    views = []
    shown = report.models[:MAX_NUM_MODELS]
    most = max_num_observations(report.images_total) // max(1, len(shown))
    for number, model in enumerate(shown):
        kinds = {name: quality_of(name, model) for name in model.registered_names}
        views.append(read_view_with_tracks(reader, number, kinds, most))
    return views


def _card(name: str, report: RunReport, photograph: PhotographReport) -> Card:
    """Return what became of a photograph."""
    if photograph.model is None:
        return _card_of_missing(name, report)
    kind = photograph.quality
    model = report.models[photograph.model]
    texts = [str(kind)]
    if photograph.probability is not None:
        texts[0] += f": {probability_text(photograph.probability)} probable"
    groups = ["all", str(kind)]
    if photograph.model:
        texts.append(f"in another model, sparse/{photograph.model}")
    if name in model.bridges:
        texts.append(model.bridges[name].text())
        groups.append("bridged")
    if name in report.extended:
        texts.append("was in the model")
    if name in report.added:
        groups.append("added")
    doubts = {**model.unsure, **model.doubtful}
    if name in doubts:
        texts.append(_own_reason(name, doubts))
    return Card(name, kind, "; ".join(filter(None, texts)), tuple(groups))


def _card_of_missing(name: str, report: RunReport) -> Card:
    """Return why a photograph is in no model."""
    why = report.unregistered.get(name)
    text = why.text() if why else FATES["not_registered"]
    for stage in report.stages:
        if name in stage.failed:
            text += f": {stage.failed[name].text()}"
    return Card(name, "missing", text, ("all", "missing"))


def _own_reason(name: str, doubts: Mapping[str, tuple[Doubt, ...]]) -> str:
    """Return why an image is doubted; nothing where others are for the same reason.

    Such a reason is above the sheet only.
    """
    reasons = doubts[name]
    return text_of(reasons) if list(doubts.values()).count(reasons) == 1 else ""


def _why_no_model(report: RunReport) -> list[str]:
    """Return why there is no model, and what became of photographs; nothing where there is one."""
    if report.models:
        return []
    why = report.why_no_model
    fates = {name: why.fate() for name, why in report.unregistered.items()}
    return [f"{why[0].upper()}{why[1:]}.", *by_story(fates)]


def _command_to_compare(output_path: Path) -> str:
    """Return the command that lays this run and a next one over each other."""
    this_path = output_path.absolute()  # "." has no name
    next_path = this_path.with_name(f"{this_path.name}-2")
    return shlex.join(["colmap-affrect", "show-runs", str(this_path), str(next_path)])


def _cameras(report: RunReport, names: Sequence[str]) -> dict[str, Any]:
    """Return the first cameras, each with its photographs, and the sources of all focal lengths."""
    numbers = {name: number for number, name in enumerate(names, 1)}
    rows = []
    mapped = merge_shared_cameras(report.cameras)
    for camera in mapped[:MAX_NUM_CAMERAS]:
        known = [name for name in camera["names"] if name in numbers]
        photographs = such_as(f"{numbers[name]} {name}" for name in known)
        rows.append((camera, photographs))
    return {
        "cameras": rows,
        "is_cut": len(mapped) > MAX_NUM_CAMERAS,
        "source_counts": Counter(one["source"] for one in report.cameras).most_common(),
        "source_texts": SOURCES,
        "camera_notes": list(map(with_flags, camera_notes(report.cameras))),
    }


def _tools(report: RunReport, content: RunContent) -> dict[str, Any]:
    """Return what the tools for tie points and masks begin with."""
    model = largest_of(report.models)
    names = content.names
    index = {name: number for number, name in enumerate(names)}
    errors_px = {(one.point, one.image): one.error_px for one in model.tie_points}
    rows = []
    for point, points in content.marks.items():
        for name, (x, y) in points.items():
            rows.append(
                [point, index[name], float(x), float(y), errors_px.get((point, name))]
            )
    sizes = []
    for name in names:
        camera = content.cameras.get(name)
        sizes.append([name, camera.width, camera.height] if camera else None)
    # What a browser keeps belongs to these photographs, marks also to those given before
    key = digest_of([sizes, rows])[:NUM_KEY_LETTERS]
    return {
        "tie_points": {"photographs": sizes, "marks": rows, "key": key},
        "masks_key": digest_of(sizes)[:NUM_KEY_LETTERS],
    }


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
