"""Clicks through the pages of a run and of a comparison as a person would."""

from __future__ import annotations

import shutil
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


def test_a_click_on_a_camera_shows_its_photograph(browser: Browser) -> None:
    browser.run("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    assert not browser.run(DIALOG)
    browser.press(*browser.run(PLACE_OF_CAMERA, "3 c.png: bridged by"))
    assert browser.run(DIALOG)
    same = """return document.querySelector("#photo img").src ===
        document.querySelectorAll("#sheet img")[2].src"""
    assert browser.run(same)
    assert "12 of 15 depths" in browser.run(
        "return document.getElementById('photo').innerText"
    )
    browser.click("#photo [data-step='1']")
    assert "d.png" in browser.run("return document.getElementById('photo').innerText")
    browser.click("#photo [data-step='0']")
    assert not browser.run(DIALOG)


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
    assert [camera["kind"] for camera in kinds[1]["cameras"]][-1] == "tracks"
    assert running.log() == []


def test_what_is_printed_has_three_sides_of_the_model_and_no_buttons(
    browser: Browser,
) -> None:
    browser.command("Emulation.setEmulatedMedia", media="print")
    sides = "return [...document.querySelectorAll('#model .sides img')].map((i) => i.naturalWidth)"
    assert browser.run(sides) == [600] * 3
    found = "[...document.querySelectorAll('button:not(.photo)')]"
    buttons = f"return {found}.map((b) => b.offsetWidth)"
    assert set(browser.run(buttons)) == {0}
    browser.command("Emulation.setEmulatedMedia", media="")
