"""A run as one page, ``report.html`` beside ``report.json``."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_affrect.errors import such_as
from colmap_affrect.pairs.base import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import MAX_LINES, ModelSummary, ReconstructionReport, by_story
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import view_graph
from colmap_affrect.report.page import TEMPLATES, write_page
from colmap_affrect.report.pictures import thumbnails
from colmap_affrect.report.scene import read_scene

KINDS = {
    "tracks": "registered by common points",
    "guided": "by guided matches",
    "bridged": "bridged by one pair",
    "existing": "was in the model",
    "doubtful": "doubtful",
}
"""How cameras came in; each has a colour of this name."""
FILTERS = {
    "all": "All", "missing": "Missing", "doubtful": "Doubtful", "added": "New",
    "guided": "Guided", "bridged": "Bridged",
}  # fmt: skip

SOURCES = {
    "given": "given",
    "exif": "EXIF",
    "exif-rescaled": "EXIF, scaled to a photograph that was shrunk",
    "pairs": "verified pairs",
    "guess": "guess",
}

MAX_NUM_CAMERAS = 200  # in the table; report.json has all


@dataclass(frozen=True)
class Fate(view_graph.Node):
    """What became of a photograph: one of ``KINDS``, or ``missing``."""

    kind: str
    groups: tuple[str, ...]


def write_run_page(
    workspace: Workspace,
    report: ReconstructionReport,
    names: Sequence[str],
    pair_inliers: Mapping[Pair, int],
    image_path: Path | None,
    progress: Progress = SILENT,
) -> Path:
    """Write ``report.html`` of a run, one file that loads nothing; WorkspaceError if it cannot.

    ``names`` are those of all photographs, ``image_path`` their folder, if known; ``pair_inliers``
    are of the verified pairs.
    """
    model = report.models[0] if report.models else ModelSummary((), 0, 0.0, 0.0)
    cards = [_fate(number, name, report, model) for number, name in enumerate(names, 1)]
    index = {name: number for number, name in enumerate(names)}
    pair_inliers = {pair: n for pair, n in pair_inliers.items() if index.keys() >= set(pair)}
    (view,) = read_scene({"this run": workspace.sparse / "0" if report.models else None})
    kinds = Counter(card.kind for card in cards)
    layout = view_graph.lay_out(names, [pair_inliers])
    matrix = view_graph.matrix(names, pair_inliers)
    content = {
        "headline": f"{len(model.registered_names)} of {len(names)} photographs registered",
        "about": _about(report),
        "doubts": _doubts(report, model),
        "doubts_title": "What to doubt" if report.models else "Why there is no model",
        "notes": [f"{name}: {why}" for name, why in report.warnings.items()],
        "max_num_lines": MAX_LINES,
        "advice": report.advice,
        "tiles": _tiles(report, model),
        "view": view,
        "kinds": {kind: f"{text} ({kinds[kind]})" for kind, text in KINDS.items() if kinds[kind]},
        "cards": cards,
        "filters": FILTERS,
        "thumbnails": thumbnails(image_path, names, progress) if image_path else {},
        "image_index": index,
        "num_pairs": len(pair_inliers),
        "layout": layout,
        "edges": view_graph.edge_paths(names, layout, pair_inliers),
        "matrix": matrix,
        **_cameras(report, index),
        "script_data": {
            "matrices": [matrix],
            "views": [view.script_data(index, {card.name: card.kind for card in cards})],
        },
    }
    folders = [workspace.path.resolve(), *([image_path.resolve()] if image_path else [])]
    return write_page(workspace.page, TEMPLATES / "run.html", content, folders)


def _about(report: ReconstructionReport) -> str:
    by = f"recipe {report.recipe}" if report.recipe else "the database of another program"
    return (
        f"colmap-affrect {report.versions['colmap-affrect']}, {by}, {report.mapping['name']} "
        f"mapper, preset {report.preset}."
    )


def _fate(number: int, name: str, report: ReconstructionReport, model: ModelSummary) -> Fate:
    if name not in set(model.registered_names):
        text = report.unregistered.get(name, "not registered")
        text += f": {report.failures[name]}" if name in report.failures else ""
        return Fate(number, name, "never", False, text, kind="missing", groups=("all", "missing"))
    arrival = model.arrivals.get(name)
    kind = arrival.how if arrival else "tracks"
    text = "registered" if not arrival or kind == "tracks" else arrival.text()
    if name in report.extended:
        kind, text = "existing", KINDS["existing"]
    groups = ["all", kind, *(["added"] if name in report.added else [])]
    if name in model.probabilities:
        text += f", right with a probability of {model.probabilities[name]:.0%}"
    is_doubtful = name in model.doubtful
    if is_doubtful:
        kind, text = "doubtful", f"{text}; doubtful: {model.doubtful[name]}"
        groups.append("doubtful")
    return Fate(number, name, "always", is_doubtful, text, kind=kind, groups=tuple(groups))


def _doubts(report: ReconstructionReport, model: ModelSummary) -> list[str]:
    """Return what cannot be trusted."""
    texts = [] if report.models else _why_no_model(report)
    texts += by_story(model.doubtful)
    if report.contradicting_pairs:
        total = sum(report.contradicting_pairs.values())
        texts.append(f"The model contradicts {total} of the verified pairs.")
    return texts


def _why_no_model(report: ReconstructionReport) -> list[str]:
    """Return the reason, and what became of the photographs, those of one fate together."""
    names: dict[str, list[str]] = {}
    for name, why in report.unregistered.items():
        names.setdefault(why.partition(";")[0], []).append(name)
    why = report.why_no_model
    return [
        f"{why[0].upper()}{why[1:]}.",
        *(f"{reason}: {such_as(alike)}" for reason, alike in names.items()),
    ]


def _tiles(report: ReconstructionReport, model: ModelSummary) -> dict[str, str]:
    tiles = {
        "photographs in the model": f"{len(model.registered_names)} of {report.images_total}",
        "verified pairs": f"{report.num_verified_pairs:,} of {report.num_pairs:,}",
    }
    if report.models:
        tiles |= {
            "points": f"{model.num_points3D:,}",
            "photographs per point": f"{model.mean_track_length:.2f}",
            "reprojection error": f"{model.mean_reprojection_error_px:.2f} px",
        }
    if len(report.models) > 1:
        tiles["models"] = str(len(report.models))
    seconds = sum(stage.wall_s for stage in report.stages)
    return tiles | {"seconds": f"{seconds:,.1f}".removesuffix(".0")}


def _cameras(report: ReconstructionReport, index: Mapping[str, int]) -> dict[str, Any]:
    rows = []
    for camera in report.cameras[:MAX_NUM_CAMERAS]:
        refined = camera["refined_px"]
        names = (f"{index[name] + 1} {name}" for name in camera["names"] if name in index)
        rows.append(
            {
                "photographs": such_as(names),
                "focal": f"{camera['focal_px']:,.0f}",
                "refined": f"{refined:,.0f}" if refined else "-",
                "source": f"{SOURCES[camera['source']]}{camera['why'] and ': '}{camera['why']}",
            }
        )
    counts, total = Counter(camera["source"] for camera in report.cameras), len(report.cameras)
    sources = ", ".join(f"{count} by {SOURCES[key]}" for key, count in counts.most_common())
    note = f"{total} camera{'s' if total != 1 else ''}, focal lengths: {sources}."
    if total > len(rows):
        note += f" The first {len(rows)} are listed, report.json has all."
    return {"cameras": rows, "camera_note": note}
