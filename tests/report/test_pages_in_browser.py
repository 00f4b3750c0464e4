"""Clicks through the pages of a run and of a comparison as a person would."""

from __future__ import annotations

import base64
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from browser import (
    Browser,
    assert_fits_and_is_readable,
    chromium,
    needs_chromium,
    until_changed,
    until_drawn,
)
from small_comparison import make_comparison
from small_run import NAMES, make_run_page, small_report

from colmap_affrect.comparison.page import write_page
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import pair_lines
from colmap_affrect.report.run_page import RunContent, write_run_page

pytestmark = [needs_chromium, pytest.mark.long]

DIALOG = "return document.getElementById('photo').open"
PLACE_OF_CAMERA = """
    const canvas = document.querySelector("canvas");
    const box = canvas.getBoundingClientRect();
    const readout = document.querySelector("#model .readout");
    for (let y = box.top + 4; y < box.bottom; y += 8) {
      for (let x = box.left + 4; x < box.right; x += 8) {
        canvas.dispatchEvent(new PointerEvent("pointermove", {clientX: x, clientY: y}));
        if (readout.textContent.startsWith(arguments[0])) return [x, y];
      }
    }
    return null"""
OUTSIDE = """return performance.getEntriesByType("resource").map((entry) => entry.name)
    .filter((name) => !name.startsWith("data:"))"""
VISIBLE_CARDS = """return [...document.querySelectorAll("#sheet > li")]
    .filter((card) => card.offsetParent !== null).length"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("comparison")
    run = make_run_page(tmp_path_factory.mktemp("run"))
    return {"run": run, "comparison": write_page(make_comparison(folder), folder)}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def browser(
    running: Browser, pages: dict[str, Path], request: pytest.FixtureRequest
) -> Iterator[Browser]:
    """A page on a desktop; the console must stay empty, and nothing be asked for."""
    running.resize(1200)
    running.prefer("light")
    running.open(pages[getattr(request, "param", "run")])
    until_drawn(running)
    yield running
    assert running.log() == []
    assert running.run(OUTSIDE) == []


SELECTED = "return document.querySelector('#look select').value"
SEEN = """return [...document.querySelectorAll('#model .seen .chip')]
    .map((chip) => chip.textContent)"""
FACTS = "return document.querySelector('#photo .facts').innerText"
MIDDLE = """
    const [x, y] = arguments;
    const canvas = document.querySelector("canvas[data-model]");
    const {width, height} = canvas;
    const copy = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
    copy.drawImage(canvas, 0, 0);
    const [red, green, blue] = copy.getImageData(x * width, y * height, 1, 1).data;
    return [red, green, blue]"""


def test_a_click_on_a_camera_looks_through_it_and_a_key_leaves_it(
    browser: Browser,
) -> None:
    browser.run("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    before = until_drawn(browser)
    browser.press(*browser.run(PLACE_OF_CAMERA, "3 c.png: "))
    assert browser.run(SELECTED) == "2"
    inside = until_changed(browser, before)
    readout = browser.run(
        "return document.querySelector('#model .readout').textContent"
    )
    assert readout.startswith("Through 3 c.png. ~ unsure: 70% probable")
    browser.key("PageDown")
    assert browser.run(SELECTED) == "3"
    until_changed(browser, inside)
    browser.key("Escape")
    assert browser.run(SELECTED) == ""


def test_a_point_says_who_sees_it_and_where(browser: Browser) -> None:
    """Space takes the point in the middle; a click on a piece goes there."""
    browser.run("page.lookThrough(0)")
    browser.run("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    browser.key(" ")
    seen = browser.run(SEEN)
    assert len(seen) >= 2
    assert seen[0].startswith("1 <img src=x")
    text = browser.run(
        "return document.querySelector('#model .seen .note').textContent"
    )
    assert text.startswith(f"This point is seen by {len(seen)} photographs")
    browser.run("document.querySelectorAll('#model .seen .chip')[1].click()")
    assert browser.run(SELECTED) == str(int(seen[1].split()[0]) - 1)


def test_points_lie_on_what_they_are_in_the_photograph(
    browser: Browser,
) -> None:
    """Where a camera sees a point, its view draws it in the colour of points that it sees."""
    browser.run("page.lookThrough(0)")
    before = until_drawn(browser)
    browser.key("+")
    until_changed(browser, before)
    browser.key("-")
    expected = browser.run("""
        const {look} = page.data.views[0].cameras[0];
        const view = page.data.views[0];
        const bytes = page.bytes(view.tracks).buffer;
        const counts = new Uint16Array(bytes, 0, view.count);
        const total = counts.reduce((sum, count) => sum + count, 0);
        const seers = new Uint16Array(bytes, 2 * view.count, total);
        const at = new Uint16Array(bytes, 2 * (view.count + total), 2 * total);
        const row = seers.indexOf(0);
        const canvas = document.querySelector("canvas[data-model]");
        const {width, height} = canvas;
        const scale = Math.min(width / look.size[0], height / look.size[1]);
        return [0.5 + (at[2 * row] / 65535 - 0.5) * look.size[0] * scale / width,
                0.5 + (at[2 * row + 1] / 65535 - 0.5) * look.size[1] * scale / height]""")
    for _ in range(50):
        red, green, blue = browser.run(MIDDLE, *expected)
        if [red, green, blue] == [255, 224, 0]:
            break
        time.sleep(0.02)
    assert [red, green, blue] == [255, 224, 0]


def test_the_dialog_has_the_figures_of_a_photograph(browser: Browser) -> None:
    browser.click("header [data-open='1']")
    facts = browser.run(FACTS)
    for title in ("Points", "Mean residual", "Neighbours", "Focal length"):
        assert title in facts
    assert "200 px at the start, from EXIF" in facts
    browser.click("#photo [data-through]")
    assert not browser.run(DIALOG)
    assert browser.run(SELECTED) == "1"


@pytest.mark.parametrize("size", [(390, 420), (1400, 420)])
def test_buttons_of_the_dialog_are_seen_without_scrolling(
    browser: Browser, size: tuple[int, int]
) -> None:
    browser.resize(*size)
    browser.click("#sheet [data-open='0']")
    assert browser.run("return document.querySelector('#photo').scrollTop") == 0
    ends = """return [...document.querySelectorAll("#photo > .buttons button")]
        .filter((one) => one.offsetParent)
        .map((one) => one.getBoundingClientRect().bottom)"""
    bottoms = browser.run(ends)
    assert len(bottoms) >= 4
    assert max(bottoms) < size[1]


def test_the_dialog_leads_to_what_two_share_and_to_the_tools(browser: Browser) -> None:
    browser.click("header [data-open='1']")
    browser.click("#photo [data-pair]")
    assert not browser.run(DIALOG)
    title = browser.run("return document.querySelector('#pair strong').textContent")
    assert title.startswith("2 b")
    browser.click("header [data-open='2']")
    said = browser.run("return document.getElementById('photo').innerText")
    assert said.count("few matches support its position") == 1
    browser.click("#photo [data-mark]")
    lists = """return [...document.querySelectorAll('#tie-points figure select')]
        .map((list) => list.value)"""
    assert browser.run(lists)[0] == "2"
    browser.click("header [data-open='4']")
    browser.click("#photo [data-mask]")
    masked = "return document.querySelector('#masks [data-part=photo]').value"
    assert browser.run(masked) == "4"


def test_a_click_into_the_matrix_draws_the_pair(browser: Browser) -> None:
    assert browser.run("return document.getElementById('pair').hidden")
    place = browser.run("""const matrix = document.querySelector("[data-matrix]");
        matrix.scrollIntoView({block: "center"});
        const at = matrix.querySelector(".ground").getBoundingClientRect();
        return [at.left + 2.5 * at.width / 6, at.top + 0.5 * at.height / 6]""")
    browser.press(*place)
    text = browser.run("return document.getElementById('pair').innerText")
    assert "1 <img src=x onerror=alert(1)>.png and 3 c.png" in text
    assert "inliers" in text
    assert "--reject-pair" not in text  # the rest of the model speaks for it
    size = (
        "const c = document.querySelector('#pair canvas'); return [c.width, c.height]"
    )
    for _ in range(50):
        width, height = browser.run(size)
        if width > 300:
            break
        time.sleep(0.02)
    assert 0 < height < width
    lines = browser.run("""const canvas = document.querySelector("#pair canvas");
        const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
        copy.drawImage(canvas, 0, 0);
        const pixels = copy.getImageData(0, 0, canvas.width, canvas.height).data;
        let count = 0;
        for (let at = 0; at < pixels.length; at += 4) {
          count += Math.abs(pixels[at] - pixels[at + 2]) > 60;
        }
        return count""")
    assert lines > 500


def test_a_pair_that_the_model_does_not_speak_for_can_be_rejected(
    browser: Browser,
) -> None:
    browser.run("page.showPair(0, 4)")  # the second one is in no model
    text = browser.run("return document.getElementById('pair').innerText")
    assert "--reject-pair '<img src=x onerror=alert(1)>.png,e.png'" in text


PAIR_TEXT = "return document.querySelector('#pair .readout').textContent"
LEFT_OUT = "They share matches that this page leaves out; the command below draws them."
SHOW_PAIR = "page.showPair(...arguments)"


def read_of_pair(browser: Browser, one: int, two: int) -> str:
    """What the page says of a pair, once it has read its file."""
    browser.run(SHOW_PAIR, one, two)
    for _ in range(100):
        text = browser.run(PAIR_TEXT)
        if text != "Reading what they share.":
            break
        time.sleep(0.02)
    return str(text)


@pytest.fixture
def page_with_files(
    running: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A page that has two of 15 pairs, eight in two files, and leaves five out."""
    monkeypatch.setattr(pair_lines, "MAX_NUM_PAIRS", 2)
    monkeypatch.setattr(pair_lines, "NUM_PAIRS_OF_FILE", 4)
    monkeypatch.setattr(pair_lines, "MAX_NUM_PAIRS_IN_FILES", 8)
    page = make_run_page(tmp_path)
    files = sorted(path.name for path in page.parent.glob("*.js"))
    assert files == ["report.pairs-1.js", "report.pairs-2.js"]
    running.resize(1200)
    running.open(page)
    return page


@pytest.mark.usefixtures("page_with_files")
def test_pairs_that_are_not_in_the_page_are_read_from_files_beside_it(
    running: Browser,
) -> None:
    """A page on a disk may read no file but by a script; each is loaded once, by a click."""
    loaded = """return [...document.querySelectorAll("script[src]")]
        .map((one) => one.getAttribute("src"))"""
    assert running.run(loaded) == []
    texts = []
    for one in range(6):
        for two in range(one):
            texts.append(read_of_pair(running, one, two))
    drawn = [text for text in texts if "of them are drawn" in text]
    assert len(drawn) == 10
    assert texts.count(LEFT_OUT) == 5
    assert sorted(running.run(loaded)) == ["report.pairs-1.js", "report.pairs-2.js"]
    assert running.log() == []


def test_a_page_without_the_files_beside_it_says_which_one_belongs_there(
    running: Browser, page_with_files: Path
) -> None:
    for path in page_with_files.parent.glob("report.pairs-*.js"):
        path.unlink()
    texts = set()
    for one in range(6):
        for two in range(one):
            texts.add(read_of_pair(running, one, two))
    missing = "Not found: report.pairs-1.js. It belongs beside this page"
    assert any(text.startswith(missing) for text in texts)
    running.log()  # in which the browser says so, too


def test_photographs_of_a_pair_are_chosen_from_lists_too(browser: Browser) -> None:
    browser.run("""const list = document.querySelector("#pair-choice [data-side='1']");
        list.value = "5";
        list.dispatchEvent(new Event("change"))""")
    text = browser.run("return document.getElementById('pair').innerText")
    assert "f.png" in text


def test_photographs_open_and_panels_grow_with_one_click(browser: Browser) -> None:
    browser.click("#sheet [data-open='0']")
    assert NAMES[0] in browser.run("return document.getElementById('photo').innerText")
    browser.click("#photo [data-step='0']")
    browser.click("#model .enlarge")
    width = (
        "return document.querySelector('.panel.large').getBoundingClientRect().width"
    )
    assert browser.run(width) >= 1180
    browser.click("#model .enlarge")
    browser.click("#filters [data-group=missing]")
    assert browser.run(VISIBLE_CARDS) == 2


of_comparison = pytest.mark.parametrize("browser", ["comparison"], indirect=True)


@of_comparison
def test_filters_show_the_photographs_they_count(browser: Browser) -> None:
    assert browser.run(VISIBLE_CARDS) == 6
    for group, count in (("seeds", 1), ("wrong", 1), ("none", 2), ("all", 6)):
        browser.click(f"#filters [data-group={group}]")
        assert browser.run(VISIBLE_CARDS) == count
        pressed = (
            "return document.querySelector('#filters [aria-pressed=true]').textContent"
        )
        assert f"({count})" in browser.run(pressed)
    assert browser.run("return document.getElementById('shown').textContent") == (
        "6 of 6 photographs shown"
    )


@of_comparison
def test_models_turn_and_zoom(browser: Browser) -> None:
    seen = [until_drawn(browser)]
    for view in ("right", "in", "top"):
        browser.click(f"#view [data-view={view}]")
        seen.append(until_changed(browser, seen[-1]))
    browser.click("#view [data-view=front]")
    assert until_changed(browser, seen[-1]) == seen[0]


def test_pointing_at_a_cell_reads_it(browser: Browser) -> None:
    script = """const [selector, right, down] = arguments;
        const matrix = document.querySelector(selector);
        const at = matrix.querySelector(".ground").getBoundingClientRect();
        const place = {clientX: at.left + right * at.width, clientY: at.top + down * at.height};
        matrix.dispatchEvent(new PointerEvent("pointermove", place));
        return matrix.parentElement.querySelector(".readout").textContent"""
    text = browser.run(script, "[data-matrix]", 1.5 / 6, 0.5 / 6)
    assert text.startswith("1 <img src=x onerror=alert(1)>.png \N{EN DASH} 2 b")
    assert int(text.split(": ")[1].removesuffix(" inliers")) > 0


@pytest.mark.parametrize("browser", ["run", "comparison"], indirect=True)
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400])
def test_pages_fit_and_are_readable(browser: Browser, scheme: str, width: int) -> None:
    assert_fits_and_is_readable(browser, scheme, width)


@pytest.mark.parametrize("width", [390, 1400])
def test_long_names_are_shortened_where_photographs_are_chosen(
    browser: Browser, width: int
) -> None:
    browser.resize(width)
    lengthen = """const name = "2679C386-1DC0-4443-81B5-93D7EDE4AB37-83120.jpg ".repeat(3);
        for (const one of document.querySelectorAll(".ref, option")) one.textContent = name;"""
    browser.run(lengthen)
    assert_fits_and_is_readable(browser, "light", width)
    sizes = """return [...document.querySelectorAll(".ref, select")]
        .filter((one) => one.offsetParent)
        .map((one) => one.getBoundingClientRect())
        .map(({ width, height }) => [width, height])"""
    widths, heights = zip(*browser.run(sizes), strict=True)
    assert max(widths) <= 0.86 * width
    assert max(widths) <= 330
    assert max(heights) <= 42


def test_the_classes_of_photographs_are_one_bar_on_a_phone(browser: Browser) -> None:
    browser.resize(390)
    tops = """return [...document.querySelectorAll(".quality-bar span")]
        .map((one) => one.getBoundingClientRect().top)"""
    found = browser.run(tops)
    assert len(found) == 4
    assert max(found) == min(found)


def test_no_table_scrolls_on_a_phone(browser: Browser) -> None:
    browser.resize(390)
    table = "const table = document.querySelector('.scroll');"
    assert browser.run(f"{table} return table.scrollWidth - table.clientWidth") == 0


def test_models_are_chosen_from_a_list_and_seen_beside_each_other(
    running: Browser, tmp_path: Path
) -> None:
    make_run_page(tmp_path)
    workspace = Workspace(tmp_path / "out")
    report = small_report(tmp_path)
    (first,) = report.models
    shutil.copytree(workspace.sparse / "0", workspace.sparse / "1")
    both = replace(report, models=(first, replace(first, doubtful={})))
    running.open(write_run_page(workspace, both, RunContent(NAMES, {})))
    shown = "return [...document.querySelectorAll('#model figure')].map((one) => !one.hidden)"
    assert running.run(shown) == [True, False]
    running.click('[data-shows="1"]')
    assert running.run(shown) == [True, True]
    running.click('[data-shows="0"]')
    assert running.run(shown) == [False, True]
    kinds = running.run(
        "return JSON.parse(document.getElementById('data').textContent).views"
    )
    assert [camera["kind"] for camera in kinds[0]["cameras"]][-1] == "doubtful"
    assert [camera["kind"] for camera in kinds[1]["cameras"]][-1] == "unsure"
    assert running.log() == []


def test_what_is_printed_has_three_sides_of_the_model_and_no_buttons(
    browser: Browser,
) -> None:
    browser.command("Emulation.setEmulatedMedia", media="print")
    sides = "return [...document.querySelectorAll('#model .sides img')].map((i) => i.naturalWidth)"
    assert browser.run(sides) == [600] * 3
    found = "[...document.querySelectorAll('button:not(.photo, .chip, .ref)')]"
    buttons = f"return {found}.map((b) => b.offsetWidth)"
    assert set(browser.run(buttons)) == {0}
    browser.command("Emulation.setEmulatedMedia", media="")


MAX_NUM_PRINTED = 4  # pages of a run of ten photographs
PRINTED_PX = 680  # width of A4 without its margins
MAX_PRINTED_PX = 16.1  # size of letters of headings, 12 points


def test_a_small_run_is_printed_on_four_pages_and_nothing_is_cut(
    browser: Browser,
) -> None:
    browser.run("window.dispatchEvent(new Event('beforeprint'))")
    options = {"preferCSSPageSize": True, "printBackground": True}
    data = base64.b64decode(browser.command("Page.printToPDF", **options)["data"])
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b(?!s)", data)) <= MAX_NUM_PRINTED
    browser.resize(PRINTED_PX)
    browser.command("Emulation.setEmulatedMedia", media="print")
    width = "return document.documentElement.scrollWidth"
    assert browser.run(width) <= PRINTED_PX
    sizes = """return [...document.querySelectorAll(".note, .command, .legend, h2, .tiles dt")]
        .filter((one) => one.offsetParent)
        .map((one) => parseFloat(getComputedStyle(one).fontSize))"""
    assert max(browser.run(sizes)) <= MAX_PRINTED_PX
    heading = "return document.querySelector('#tie-points h2').offsetParent === null"
    assert browser.run(heading), "nothing is below it on paper"
    browser.command("Emulation.setEmulatedMedia", media="")
