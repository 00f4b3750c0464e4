"""What the page of a run says, and what it must not have."""

from __future__ import annotations

import base64
import hashlib
import html as markup
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_comparison import IMAGE_SIZE
from small_run import NAMES, make_run_page, small_report

from colmap_affrect.colmap import pycolmap
from colmap_affrect.project.advised import Advice
from colmap_affrect.project.reasons import Missing
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import pictures, run_page
from colmap_affrect.report.pair_lines import PairFile
from colmap_affrect.report.run_page import RunContent, inlier_matrix, write_run_page
from colmap_affrect.session.view_graph import ViewGraph


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    return make_run_page(folder).read_text(encoding="utf-8")


def test_everything_of_the_report_is_told(html: str) -> None:
    for text in (
        "<title>2 of 6 photographs are placed surely, 1 unsure, 1 doubtful, 2 not placed</title>",
        "Next: one camera.", "sparse/0: 4 photographs", "Not placed: 2",
        "sure: 95% probable", "unsure: 70% probable; bridged by &lt;img src=x",
        "may be a mirrored copy of &lt;b&gt;.jpg",
        "Why photographs are not sure, or not placed", "colmap-affrect show-runs ",
        "doubtful: 40% probable; may be a mirrored",
        ">colmap-affrect run --output-path out-2<", "no verified pair",
        "unreadable: f.png: not a readable image",
        "12 of 15 depths agree, scale +-3.1%",
        "1 camera, focal lengths: 1 from EXIF.", "one of them",
        "15 pairs are verified", "Pairs to look at", "is doubtful; guided", "60 inliers.",
        "colmap-affrect show-pair OUT", "model: not rectified: an &lt;old&gt; one",
    ):  # fmt: skip
        assert text in html
    parts = [
        "Next: one camera",
        "Why photographs are not sure",
        "What to try next",
        "<main>",
    ]
    positions = [html.index(part) for part in parts]
    assert positions == sorted(positions)


def test_each_row_of_a_table_has_a_cell_for_each_heading(html: str) -> None:
    """Where a page is narrow, cells stand below each other, and say what their headings say."""
    num_rows = 0
    for table in re.findall(r"<table.*?</table>", html, re.DOTALL):
        head, _, body = table.partition("</thead>")
        headings = re.findall(r"<th [^>]*>(.*?)</th>", head, re.DOTALL)
        for row in re.findall(r"<tr>(.*?)</tr>", body, re.DOTALL):
            num_rows += 1
            cells = re.findall(r"<(?:th|td)\b([^>]*)>", row)
            assert len(cells) == len(headings), f"cells of a row below {headings}"
            for cell, heading in zip(cells, headings, strict=True):
                label = re.search(r'data-label="([^"]*)"', cell)
                assert label is None or label[1] == heading, f"{cell} below {heading}"
    assert num_rows > len(NAMES)


def test_page_loads_nothing_and_names_are_never_markup(html: str) -> None:
    assert re.findall(r"https?://[^\s\"'<]*", html) == []
    assert "default-src 'none'" in html
    assert "<img src=x" not in html
    assert "\u202e" not in html
    assert r"b\u202egnp.c" in html


def test_only_the_scripts_of_the_page_may_run(html: str) -> None:
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    digests = [
        base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        for script in re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    ]
    assert len(digests) == 7
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    assert markup.unescape(policy) == (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}"
    )


def test_only_a_page_with_files_beside_it_may_load_scripts(
    html: str, tmp_path: Path
) -> None:
    assert "'self'" not in html
    content = RunContent(NAMES, {}, pair_files=[PairFile("report.pairs-1.js", (0, 1))])
    page = write_run_page(Workspace(tmp_path), small_report(tmp_path), content)
    assert "script-src 'self' file: 'sha256-" in page.read_text(encoding="utf-8")


def test_without_a_matrix_pairs_are_chosen_from_lists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_page, "MAX_NUM_IN_MATRIX", 5)
    content = RunContent(NAMES, {NAMES[:2]: 60})
    page = write_run_page(Workspace(tmp_path), small_report(tmp_path), content)
    text = page.read_text(encoding="utf-8")
    assert 'id="pair-choice"' in text
    assert "<svg" not in text.split('<section id="pairs">')[1].split("</section>")[0]


def test_the_tool_for_tie_points_knows_names_and_sizes(html: str) -> None:
    data = json.loads(html.split('id="data">')[1].split("</script>")[0])
    assert data["tie_points"]["photographs"] == [[n, *IMAGE_SIZE] for n in NAMES]
    assert data["tie_points"]["marks"] == []


def test_marks_that_a_browser_keeps_are_of_one_run_and_masks_of_its_photographs(
    folder: Path, html: str, tmp_path: Path
) -> None:
    """Marks that were given to a run are in its page, and what was kept before is old."""
    before = json.loads(html.split('id="data">')[1].split("</script>")[0])
    cameras = ViewGraph(Workspace(folder / "out").database).cameras
    marks = {"1": {NAMES[0]: np.array([3.0, 4.0])}}
    content = RunContent(NAMES, {}, marks=marks, cameras=cameras)
    page = write_run_page(Workspace(tmp_path), small_report(tmp_path), content)
    text = page.read_text(encoding="utf-8")
    after = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert after["tie_points"]["key"] != before["tie_points"]["key"]
    assert after["masks_key"] == before["masks_key"]


def test_no_folder_of_this_machine_is_in_the_page(html: str, folder: Path) -> None:
    assert str(folder) not in html
    assert "/home/" not in html


def test_cameras_are_where_the_model_has_them_seen_from_the_front(
    html: str, folder: Path
) -> None:
    data = json.loads(html.split('id="data">')[1].split("</script>")[0])
    assert data["names"][0] == NAMES[0]
    (view,) = data["views"]
    kinds = {camera["index"]: camera["kind"] for camera in view["cameras"]}
    assert kinds == {0: "sure", 1: "sure", 2: "unsure", 3: "doubtful"}
    model = pycolmap.Reconstruction(folder / "out" / "sparse" / "0")
    centers = {image.name: image.projection_center() for image in model.images.values()}
    shown = np.array([camera["corners"][:3] for camera in view["cameras"]])
    true = np.array([centers[NAMES[camera["index"]]] for camera in view["cameras"]])

    def lengths(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[:, None] - points[None], axis=2)[
            np.triu_indices(4, 1)
        ]

    ratios = lengths(shown) / lengths(true)
    np.testing.assert_allclose(ratios, ratios[0], rtol=2e-3)


def test_matrix_of_inliers_is_symmetric_and_not_there_for_many_photographs() -> None:
    names = [f"{number}.png" for number in range(1000)]
    data = base64.b64decode(inlier_matrix(names, {("0.png", "2.png"): 70_000}))
    counts = np.frombuffer(data, "<u2").reshape(1000, 1000)
    assert counts[0, 2] == counts[2, 0] == 65_535
    assert np.count_nonzero(counts) == 2
    assert inlier_matrix([*names, "one more.png"], {}) == ""


@pytest.mark.parametrize(
    ("num_photographs", "side_px"), [(1, 640), (17, 640), (40, 428), (1000, 126)]
)
def test_thumbnails_are_smaller_the_more_photographs_a_page_has(
    num_photographs: int, side_px: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All together have at most 6 megapixels, or 126 px in length each."""
    asked = []

    def read(_: Path, size_px: int, *, is_shown: bool) -> np.ndarray:
        assert is_shown
        asked.append(size_px)
        return np.zeros((2, 2, 3), np.uint8)

    monkeypatch.setattr(pictures, "read_color", read)
    names = [f"{number}.png" for number in range(num_photographs)]
    assert list(pictures.thumbnails(tmp_path, names)) == names
    assert set(asked) == {side_px}


def test_advice_leads_to_the_tool_that_makes_what_its_command_takes(
    folder: Path, html: str, tmp_path: Path
) -> None:
    assert "data-tool" not in html.split("</header>")[0]
    cameras = ViewGraph(Workspace(folder / "out").database).cameras
    advised = (
        Advice(
            "tie_points", "mark six points", "colmap-affrect run --tie-points marks.csv"
        ),
        Advice("masks", "mask captions", "colmap-affrect run --mask-path masks"),
        Advice("photographs", "more photographs"),
    )
    report = replace(small_report(tmp_path), advice=advised)
    page = write_run_page(
        Workspace(tmp_path), report, RunContent(NAMES, {}, cameras=cameras)
    )
    head = page.read_text(encoding="utf-8").split("<main>")[0]
    assert re.findall('data-tool="([^"]*)"', head) == [
        "tie-points", "tie-points", "masks",
    ]  # fmt: skip


def test_what_lost_photographs_matched_is_told_as_their_neighbours(
    folder: Path, tmp_path: Path
) -> None:
    values = {"unregistered": {NAMES[4]: Missing("not_registered", 0, {NAMES[1]: 31})}}
    report = replace(small_report(folder / "out"), **values)
    page = write_run_page(Workspace(tmp_path), report, RunContent(NAMES, {}))
    text = page.read_text(encoding="utf-8")
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert data["neighbours"][4] == [[1, 31, "inliers"]]


def test_figures_of_several_models_are_called_those_of_the_largest(
    folder: Path, tmp_path: Path
) -> None:
    report = small_report(folder / "out")
    both = replace(report, models=report.models * 2)
    page = write_run_page(Workspace(tmp_path), both, RunContent(NAMES, {}))
    which = "photographs in the largest model"
    assert which in page.read_text(encoding="utf-8")
    assert which in both._repr_html_()
    assert which not in report._repr_html_()


def test_a_run_without_anything_says_so(tmp_path: Path) -> None:
    report = small_report(tmp_path)
    values = {
        "models": (),
        "num_verified_pairs": 0,
        "unregistered": dict.fromkeys(NAMES, Missing("no_features")),
        "photographs": {},
        "cameras": (),
    }
    nothing = type(report)(**{**vars(report), **values})
    path = write_run_page(Workspace(tmp_path), nothing, RunContent(NAMES, {}))
    html = path.read_text(encoding="utf-8")
    for text in (
        "Why there is no model",
        "No model was found: no pair of images is verified.",
        "f.png: no features",
        "There is no model.",
        "No pair of photographs is verified",
    ):
        assert text in html
    assert html.count("no picture</span>") == 6
    assert "Tie points by hand" not in html
