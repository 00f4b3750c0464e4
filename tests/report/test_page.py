"""The parts of pages, put together on a page that knows nothing of comparisons."""

from __future__ import annotations

from pathlib import Path

from synthetic import texture

from colmap_affrect.report import view_graph
from colmap_affrect.report.match_plots import MatchPlot, SideBySide
from colmap_affrect.report.page import write_page
from colmap_affrect.report.pictures import Picture
from colmap_affrect.report.scene import read_scene
from colmap_affrect.report.warp_views import WarpedPhotograph, WarpView

TEMPLATE = """{% extends "base.html" %}
{% import "parts.html" as parts with context %}
{% block title %}A run{% endblock %}
{% block body %}
{{ parts.image_list(image_index) }}{{ parts.options({"seed": 3}) }}
{{ parts.class_legend() }}{{ parts.thumbnail_definitions() }}
{{ parts.view_graph("graph", layout, edges, nodes) }}{{ parts.inlier_matrix("m", matrix, 0) }}
{{ parts.pair_picture_definitions() }}{{ parts.match_plot("run", side_by_side, plot) }}
{{ parts.warped_photograph(warped) }}
{{ parts.model_buttons() }}{{ parts.model("run", views[0], 0, "#123456") }}
{% endblock %}
"""


def test_parts_make_a_page_of_one_run(tmp_path: Path) -> None:
    names, pair = ("a <b>.png", "c.png"), ("a <b>.png", "c.png")
    picture = Picture.jpeg(texture((40, 30), 0))
    layout = view_graph.lay_out(names, [{pair: 70}])
    matrix = view_graph.matrix(names, {pair: 70})
    scene = read_scene({"run": None})
    nodes = [view_graph.Node(i, name, "always", False, "ok") for i, name in enumerate(names, 1)]
    view = WarpView(picture, "#ff0000", 2.0, 30.0)
    (tmp_path / "run.html").write_text(TEMPLATE)
    path = write_page(
        tmp_path / "report.html",
        tmp_path / "run.html",
        {
            "image_index": {name: index for index, name in enumerate(names)},
            "thumbnails": dict.fromkeys(names, picture),
            "pair_pictures": dict.fromkeys(names, picture),
            "layout": layout,
            "edges": view_graph.edge_paths(names, layout, {pair: 70}),
            "matrix": matrix,
            "nodes": nodes,
            "side_by_side": SideBySide(pair, (400.0, 400.0)),
            "plot": MatchPlot(70, 1, "M1 2L3 4", "M5 6L7 8"),
            "warped": WarpedPhotograph(pair[0], 1, "asift", 1, picture, (view,), True),
            "views": scene.views,
            "script_data": {"names": names, "matrices": [matrix.counts], **scene.script_data()},
        },
    )
    html = path.read_text(encoding="utf-8")
    assert "<title>A run</title>" in html
    assert html.count("M1 2L3 4") == html.count("M5 6L7 8") == 2  # with a dark line below
    assert "a &lt;b&gt;.png" in html
    assert "<b>" not in html
    assert "There is no model." in html
    assert "70 inliers of run between photographs 1 and 2" in html
