"""Marks tie points on the page of a run as a person would, and runs with what is saved."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, chromium, needs_chromium
from command import on_photographs, run_in_process_of_its_own
from PIL import Image
from small_comparison import IMAGE_SIZE, write_scene
from small_run import small_report
from small_scene import FOCAL_PX, world_to_camera, write_photographs
from small_scene import IMAGE_SIZE as SCENE_SIZE
from small_scene import NAMES as SCENE_NAMES

from colmap_affrect.project.reasons import Missing
from colmap_affrect.project.report import ModelSummary, Residual
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.photographs import photographs_of_report
from colmap_affrect.report.run_page import RunContent, write_run_page
from colmap_affrect.session.view_graph import ViewGraph

pytestmark = [needs_chromium, pytest.mark.long]

ORIENTATION = 0x0112  # tag of EXIF
TURNED = 6  # by a quarter
LOST = "side/č.png"
REJECTED = [f"{LOST},{name}" for name in SCENE_NAMES if name != LOST]
CORNERS = np.array([
    (-0.6, 0.3, 5.0), (0.6, 0.3, 5.0), (0.6, 1.2, 5.0), (-0.6, 1.2, 5.0),
    (-1.5, -1.2, 7.0), (1.5, -1.2, 7.0), (1.2, 0.0, 7.0), (-1.2, 0.1, 7.0),
])  # fmt: skip
"""Places on the faces of the small scene."""

CANVAS = """const canvas = document.querySelectorAll("#tie-points canvas")[arguments[0]];
    canvas.scrollIntoView({block: "center"});
    const box = canvas.getBoundingClientRect();"""
BOX = f"{CANVAS} return [box.left, box.top, box.width, box.height]"
BRIGHT = f"""{CANVAS}
    const {{width, height}} = canvas;
    const copy = new OffscreenCanvas(width, height).getContext("2d", {{willReadFrequently: true}});
    copy.drawImage(canvas, 0, 0);
    const pixels = copy.getImageData(0, 0, width, height).data;
    let [count, x, y] = [0, 0, 0];
    for (let at = 0; at < width * height; at++) {{
      if (pixels[4 * at] < 200 || !pixels[4 * at + 3]) continue;
      count += 1;
      x += at % width + 0.5;
      y += Math.floor(at / width) + 0.5;
    }}
    return count ? [box.left + x / count, box.top + y / count] : null"""
"""Where the middle of what is bright is in the window."""
CHOOSE = """const list = document.querySelectorAll("#tie-points select")[arguments[0]];
    list.value = [...list.options].find((option) => option.text.includes(arguments[1])).value;
    list.dispatchEvent(new Event("change"))"""
"""In the list of points, 0, or of the first or second photographs, 1 or 2."""
MARKS = """return [...document.querySelectorAll("#tie-points tbody tr")]
    .map((row) => [...row.cells].slice(0, 5).map((cell) => cell.textContent))"""
TEXT = "return document.querySelector(arguments[0]).textContent"
SAID = "[data-part=said]"


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def browser(running: Browser, tmp_path: Path) -> Iterator[Browser]:
    """On a desktop, with downloads into a folder; the console must stay empty."""
    running.resize(1200)
    running.command(
        "Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path)
    )
    yield running
    assert running.log() == []
    running.run("localStorage.clear()")


def write_block(path: Path, size: tuple[int, int], left: int, top: int) -> None:
    """Write a dark photograph with a bright square of 8 px, which EXIF turns."""
    exif = Image.Exif()
    image = np.full(size[::-1], 40, np.uint8)
    image[top : top + 8, left : left + 8] = 255
    exif[ORIENTATION] = TURNED
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(image).save(path, quality=100, exif=exif)


@pytest.fixture(params=["jpg"])
def page(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Six photographs with a square whose middle is at 44, 20; the fifth is the first lost one."""
    names = [f"{number}.{request.param}" for number in range(6)]
    for name in names:
        write_block(tmp_path / "photographs" / name, IMAGE_SIZE, 40, 16)
    workspace = Workspace(tmp_path)
    write_scene(workspace.database, names)
    marks = {
        "corner": {names[0]: np.array([100.0, 90.0]), names[4]: np.array([1.5, 2.25])}
    }
    residuals = (Residual("corner", names[0], 7.25),)
    model = ModelSummary(tuple(names[:4]), 90, 3.5, 0.25, tie_points=residuals)
    report = small_report(tmp_path)
    values = {
        **vars(report),
        "models": (model,),
        "unregistered": dict.fromkeys(names[4:], Missing("not_registered")),
        "photographs": photographs_of_report(
            ModelReader(workspace.sparse), names, (model,), (), {}
        ),
    }
    cameras = ViewGraph(workspace.database).cameras
    content = RunContent(names, {}, tmp_path / "photographs", marks, cameras=cameras)
    return write_run_page(workspace, type(report)(**values), content)


def until(true: Callable[[], object]) -> None:
    for _ in range(200):
        if true():
            return
        time.sleep(0.02)
    pytest.fail("nothing happened")


def shown(browser: Browser, pane: int) -> tuple[float, float]:
    """Where the square is in the window, once it is drawn."""
    until(lambda: browser.run(BRIGHT, pane))
    x, y = browser.run(BRIGHT, pane)
    return x, y


def mark_of(browser: Browser, point: str) -> list[float]:
    (found,) = [row[2:4] for row in browser.run(MARKS) if row[1] == point]
    return list(map(float, found))


@pytest.mark.parametrize("page", ["jpg", "png"], indirect=True)
def test_marks_are_px_from_the_corner_of_the_image_as_stored(
    browser: Browser, page: Path
) -> None:
    browser.open(page)
    x, y = shown(browser, 1)
    browser.press(round(x), round(y))
    scale = browser.run(BOX, 1)[2] / IMAGE_SIZE[0]
    np.testing.assert_allclose(mark_of(browser, "1"), (44.0, 20.0), atol=1 / scale)

    # The original may be of another size; the marks stay those of the run.
    (name,) = [path.name for path in (page.parent / "photographs").glob("4.*")]
    original = page.parent / "scans" / name
    write_block(original, (2 * IMAGE_SIZE[0], 2 * IMAGE_SIZE[1]), 256, 32)
    browser.give_files("[data-part=originals-input]", original)
    until(lambda: "Originals found: 1 of 6" in browser.run(TEXT, SAID))
    browser.run(CHOOSE, 0, "2")
    until(lambda: abs(shown(browser, 0)[0] - browser.run(BOX, 0)[0] - 130 * scale) < 2)
    browser.press(*map(round, shown(browser, 0)))
    np.testing.assert_allclose(mark_of(browser, "2"), (130.0, 18.0), atol=1 / scale)


def test_keys_and_the_wheel_do_what_they_say(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.press(*map(round, shown(browser, 0)))
    x, y = mark_of(browser, "1")
    for key in ("ArrowRight", "ArrowRight", "ArrowUp"):
        browser.key(key)
    assert mark_of(browser, "1") == pytest.approx([x + 2, y - 1], abs=0.011)
    browser.key("z", is_ctrl=True)
    assert mark_of(browser, "1") == pytest.approx([x + 2, y], abs=0.011)
    browser.key("Delete")
    assert [row[1] for row in browser.run(MARKS)] == ["corner", "corner"]
    before = browser.run(BOX, 0)[2] / IMAGE_SIZE[0]
    place = dict(zip("xy", shown(browser, 0), strict=True))
    browser.command(
        "Input.dispatchMouseEvent", type="mouseWheel", **place, deltaX=0, deltaY=-400
    )
    browser.press(*map(round, shown(browser, 0)))
    scale = np.e * before
    np.testing.assert_allclose(mark_of(browser, "1"), (44.0, 20.0), atol=1 / scale)
    browser.key("Enter")
    browser.key(" ")
    assert [row[1] for row in browser.run(MARKS)] == ["corner", "corner", "1", "2"]


def test_dragging_moves_the_photograph_and_marks_nothing(
    browser: Browser, page: Path
) -> None:
    browser.open(page)
    x, y = shown(browser, 0)
    for _ in range(3):
        browser.click("#tie-points figure [data-act='+']")
    x, y, width, height = browser.run(BOX, 0)
    known = len(browser.run(MARKS))
    for kind, dx in (("mousePressed", 0), ("mouseMoved", 60), ("mouseReleased", 60)):
        place = {"x": round(x + width / 2 + dx), "y": round(y + height / 2)}
        browser.command("Input.dispatchMouseEvent", type=kind, button="left", **place)
    assert len(browser.run(MARKS)) == known
    browser.press(round(x + width / 2), round(y + height / 2))
    scale = 1.5**3 * width / IMAGE_SIZE[0]
    expected = IMAGE_SIZE[0] / 2 - 60 / scale, IMAGE_SIZE[1] / 2
    np.testing.assert_allclose(mark_of(browser, "1"), expected, atol=1 / scale)


def test_two_fingers_zoom_and_a_tap_marks(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.resize(390)
    shown(browser, 0)
    x, y, width, height = browser.run(BOX, 0)
    middle = x + width / 2, y + height / 2
    for kind, reach in (
        ("touchStart", 20),
        ("touchMove", 40),
        ("touchMove", 80),
        ("touchEnd", 0),
    ):
        fingers = [
            {"x": middle[0] + s * reach, "y": middle[1], "id": s + 1} for s in (-1, 1)
        ]
        points = [] if kind == "touchEnd" else fingers
        browser.command("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    for kind in ("touchStart", "touchEnd"):
        points = [{"x": middle[0], "y": middle[1] + 30}] if kind == "touchStart" else []
        browser.command("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    scale = 4 * width / IMAGE_SIZE[0]
    expected = IMAGE_SIZE[0] / 2, IMAGE_SIZE[1] / 2 + 30 / scale
    np.testing.assert_allclose(mark_of(browser, "1"), expected, atol=1 / scale)


def test_residuals_are_those_of_the_run_until_a_mark_moves(
    browser: Browser, page: Path
) -> None:
    assert "corner in 0.jpg: 7.2 px" in page.read_text(encoding="utf-8")
    browser.open(page)
    assert browser.run(MARKS) == [
        ["1 0.jpg", "corner", "100.00", "90.00", "7.3"],
        ["5 4.jpg", "corner", "1.50", "2.25", "-"],
    ]
    browser.click("#tie-points tbody button")
    assert (
        browser.run("return document.querySelectorAll('#tie-points select')[2].value")
        == "0"
    )
    browser.key("ArrowLeft")
    assert browser.run(MARKS)[0] == ["1 0.jpg", "corner", "99.00", "90.00", "-"]


def test_a_saved_table_can_be_opened_and_wrong_ones_say_why(
    browser: Browser, page: Path
) -> None:
    table = page.parent / "given.csv"
    browser.open(page)
    for text, said in (
        ("x,y\n1,2\n", "its first line must be point,photograph,x,y"),
        ("point,photograph,x,y\n1,9.jpg,1,2\n", "line 2: no such photograph, 9.jpg"),
        ("point,photograph,x,y\n\n1,1.jpg,1,\n", "line 3: must have a point, x and y"),
        (
            'y,x,photograph,point\r\n2.5,1,1.jpg,"a ""b"", c"\r\n',
            "Marks read from given.csv: 1",
        ),
    ):
        table.write_text(text, encoding="utf-8")
        browser.give_files("[data-part=table-input]", table)
        until(lambda said=said: said in browser.run(TEXT, SAID))
    browser.click("[data-part=save]")
    saved = page.parent / "tie-points.csv"
    until(saved.exists)
    assert saved.read_text() == 'point,photograph,x,y\n"a ""b"", c",1.jpg,1.00,2.50\n'
    assert (
        browser.run("return document.querySelector('[data-part=saved]').offsetHeight")
        > 0
    )


def click(browser: Browser, pane: int, point: np.ndarray) -> np.ndarray:
    """Click next to a point of a photograph of the small scene, and return where: (2,) px."""
    left, top, width, height = browser.run(BOX, pane)
    scale = min(width / SCENE_SIZE[0], height / SCENE_SIZE[1])
    in_window = np.rint([left, top] + scale * point)
    browser.press(*in_window.tolist())
    return (in_window - [left, top]) / scale


def corners_in_photograph(name: str) -> np.ndarray:
    """(8, 2) positions of ``CORNERS`` in a photograph of the small scene, px from its corner."""
    index = SCENE_NAMES.index(name)
    position = (0.55 * (index - 1.5), -0.1 * index, 0.1 * index)
    seen = (CORNERS - position) @ world_to_camera(-5.0 * (index - 1.5)).T
    return FOCAL_PX * seen[:, :2] / seen[:, 2:] + np.array(SCENE_SIZE) / 2


def test_a_lost_photograph_comes_back_by_what_was_clicked(
    browser: Browser, tmp_path: Path
) -> None:
    write_photographs(tmp_path / "photographs")
    options = on_photographs(tmp_path / "photographs", tmp_path / "out")
    options += [word for pair in REJECTED for word in ("--reject-pair", pair)]
    lost = run_in_process_of_its_own("run", *options, "--json")
    assert list(lost.report["unregistered"]) == [LOST]

    browser.open(tmp_path / "out" / "report.html")
    assert "not placed" in browser.run(TEXT, "#tie-points figure option:checked")
    others = [name for name in SCENE_NAMES if name != LOST][:2]
    clicked = {}
    for photograph, pane in ((LOST, 0), (others[0], 1), (others[1], 1)):
        browser.run(CHOOSE, pane + 1, photograph)
        for number, corner in enumerate(corners_in_photograph(photograph), 1):
            browser.run(CHOOSE, 0, str(number))
            clicked[str(number), photograph] = click(browser, pane, corner)
    browser.click("[data-part=save]")
    table = tmp_path / "tie-points.csv"
    until(table.exists)
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    saved = {
        (row["point"], row["photograph"]): (float(row["x"]), float(row["y"]))
        for row in rows
    }
    assert saved == {
        key: pytest.approx(place, abs=0.006) for key, place in clicked.items()
    }

    back = run_in_process_of_its_own("run", *options, "--tie-points", table, "--json")
    assert not back.report["unregistered"]
    errors = [residual["error_px"] for residual in back.report["tie_points"]]
    assert len(errors) == 24
    assert max(errors) < 2.0
