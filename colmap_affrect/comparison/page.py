"""A comparison of methods as one page, ``report.html``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from colmap_affrect.colmap.poses import AUC_THRESHOLDS_DEG, MAX_CORRECT_ERROR_DEG
from colmap_affrect.comparison.contact_sheet import FILTERS, KINDS, cards_of
from colmap_affrect.comparison.differing_pairs import choose_pairs, pair_rows, plot_pairs
from colmap_affrect.comparison.method_table import (
    Column,
    columns_of,
    digits_of,
    span_text,
    summary_rows,
)
from colmap_affrect.comparison.results import Comparison
from colmap_affrect.comparison.verdict import cautions, changes, headline
from colmap_affrect.errors import AffrectError
from colmap_affrect.options import flat
from colmap_affrect.pairs.base import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import page, view_graph
from colmap_affrect.report.pictures import photograph_pictures, thumbnails
from colmap_affrect.report.scene import read_scene
from colmap_affrect.report.warp_views import rectifies, warped_photographs
from colmap_affrect.stages.context import Resources

TEMPLATE = Path(__file__).parent / "templates" / "comparison.html"
FILE_NAME = "report.html"

MATCH_PICTURE_PX = 560
MAX_NUM_WARPED_PHOTOGRAPHS = 3
MAX_NUM_TABLE_PAIRS = 200


def write_page(
    comparison: Comparison,
    output_path: Path,
    progress: Progress = SILENT,
    resources: Resources | None = None,
) -> Path:
    """Write ``report.html`` into the folder of a comparison, and return its path.

    It is one file that loads nothing. Whatever is missing, such as a photograph that cannot be read
    or a model that is not there, is said in its place. ``resources`` are those of methods with
    networks, to draw their warps. Raises WorkspaceError when it cannot be written.
    """
    columns = columns_of(comparison)
    methods = [column.method for column in columns]
    folder = Path(comparison.image_path)
    rectifying = [
        method.name
        for method in methods
        if method.folder and rectifies(Workspace(output_path / method.folder))
    ]
    chosen = choose_pairs(methods, rectifying)
    of_pairs = list(dict.fromkeys(name for item in chosen for name in item.names))
    pair_pictures = photograph_pictures(folder, sorted(of_pairs), MATCH_PICTURE_PX)
    rows = pair_rows(methods)
    content = {
        "comparison": comparison,
        "headline": headline(comparison),
        "changes": changes(comparison),
        "cautions": cautions(comparison),
        "bars": _bars(columns, comparison),
        "columns": columns,
        "column_of": {column.name: column for column in columns},
        "failed": [method for method in comparison.methods if method.failed],
        "rows": summary_rows(columns, comparison),
        "filters": FILTERS,
        "thumbnails": thumbnails(folder, comparison.image_names, progress),
        "image_index": {name: index for index, name in enumerate(comparison.image_names)},
        "pair_rows": rows[:MAX_NUM_TABLE_PAIRS],
        "num_verified_pairs": len(rows),
        "pair_pictures": pair_pictures,
        "pair_plots": plot_pairs(chosen, pair_pictures, output_path),
        "rectifying": rectifying,
        "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
        "auc_thresholds_deg": AUC_THRESHOLDS_DEG,
        "settings": flat(comparison.settings),
        "method_options": {method.name: flat(method.options) for method in methods},
        **_warps(comparison, rectifying, of_pairs, output_path, resources),
        **_graphs_and_models(columns, comparison, output_path),
    }
    folders = [folder, output_path.resolve()]
    return page.write_page(output_path / FILE_NAME, TEMPLATE, content, folders)


def _bars(columns: Sequence[Column], comparison: Comparison) -> list[dict[str, Any]]:
    """Return a bar for each method: photographs registered and, in front, those correctly."""
    total = max(1, len(comparison.image_names))
    bars = []
    for column in columns:
        spans = [column.method.registered, column.method.correct]
        known = [span for span in spans if span]
        texts = [span_text(span, digits_of([span.mean], 1)) for span in known]
        bars.append(
            {
                "column": column,
                "shares": [span.mean / total for span in known],
                "text": ", ".join([f"{texts[0]} of {total}", *(f"{t} correct" for t in texts[1:])]),
            }
        )
    return bars


def _graphs_and_models(
    columns: Sequence[Column], comparison: Comparison, output_path: Path
) -> dict[str, Any]:
    """Return the content of the sections that the script of the page works on."""
    names = comparison.image_names
    graphs = [column.method.pair_inliers for column in columns]
    layout = view_graph.lay_out(names, graphs)
    cards = cards_of(columns, comparison)
    paths = comparison.model_paths(output_path)
    views = read_scene({column.name: paths[column.name] for column in columns})
    index = {name: number for number, name in enumerate(names)}
    kinds = [{card.name: card.marks[number].kind for card in cards} for number in range(len(views))]
    used = {kind for of_view in kinds for kind in of_view.values()}
    return {
        "cards": cards,
        "layout": layout,
        "edges": [
            view_graph.differing_edge_paths(names, layout, graph, graphs[0])
            if number
            else view_graph.edge_paths(names, layout, graph)
            for number, graph in enumerate(graphs)
        ],
        "edge_notes": [
            f"{len(graph)} verified pairs" + (_difference(graph, graphs[0]) if number else "")
            for number, graph in enumerate(graphs)
        ],
        "views": views,
        "kinds": {kind: text for kind, text in KINDS.items() if kind in used},
        "script_data": {
            "matrices": [view_graph.matrix(names, graph) for graph in graphs],
            "views": [
                view.script_data(index, of_view) for view, of_view in zip(views, kinds, strict=True)
            ],
        },
    }


def _difference(graph: Mapping[Pair, int], first: Mapping[Pair, int]) -> str:
    counts = {"new": len(graph.keys() - first.keys()), "lost": len(first.keys() - graph.keys())}
    return "".join(f", {count} {what}" for what, count in counts.items() if count)


def _warps(
    comparison: Comparison,
    rectifying: Sequence[str],
    of_pairs: Sequence[str],
    output_path: Path,
    resources: Resources | None,
) -> dict[str, Any]:
    """Return the method whose warps are shown, those of a few photographs, or why there are none.

    It is the method with most registered images of those that rectify; its photographs are
    those of the pairs that are drawn.
    """
    content: dict[str, Any] = {"warped_method": "", "warped": [], "warped_error": ""}
    methods = [method for method in comparison.finished if method.name in rectifying]
    if not methods:
        return content
    best = max(methods, key=lambda method: method.registered.mean)
    content["warped_method"] = best.name
    names = dict.fromkeys([*of_pairs, *comparison.image_names])
    readable = [name for name in names if name in best.num_keypoints]
    try:
        workspace = Workspace(output_path / best.folder)
        shown = readable[:MAX_NUM_WARPED_PHOTOGRAPHS]
        content["warped"] = warped_photographs(workspace, shown, resources)
    except AffrectError as error:
        content["warped_error"] = str(error)
    return content
