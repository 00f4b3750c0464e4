from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from small_comparison import NAMES, make_comparison
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.comparison.page import contact_sheet, write_page
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult
from colmap_affrect.comparison.tables import table, verdict

VOID = {"meta", "img", "link", "br", "hr", "input"}


class Page(HTMLParser):
    """Reads a page, whose tags must be balanced: tags, text, cells of the table of methods."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._open: list[tuple[str, dict[str, str | None]]] = []
        self._texts: list[tuple[dict[str, str | None], str]] = []
        self.feed(html)
        self.close()
        assert self._open == []
        ids = [attributes["id"] for _, attributes in self.tags if "id" in attributes]
        assert len(ids) == len(set(ids))
        self.text = "".join(text for _, text in self._texts)
        self.cells = {
            (attributes["data-label"], attributes["data-method"]): text
            for attributes, text in self._texts
            if "data-method" in attributes
        }

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(self.tags[-1])

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        self._texts.append((self._open[-1][1] if self._open else {}, data))

    def values(self, tag: str, name: str) -> list[str]:
        """The values of an attribute of all tags of a kind."""
        return [
            at[name] or "" for found, at in self.tags if found == tag and name in at
        ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("comparison")


@pytest.fixture(scope="module")
def comparison(folder: Path) -> Comparison:
    return make_comparison(folder)


@pytest.fixture(scope="module")
def page(comparison: Comparison, folder: Path) -> Page:
    return Page(write_page(comparison, folder).read_text(encoding="utf-8"))


def test_verdict_table_failures_and_settings_are_told(
    page: Page, comparison: Comparison
) -> None:
    for title, cells in table(comparison).items():
        assert [page.cells[title, name] for name in ("default", "sift")] == cells
    assert page.cells["registered", "default"] == "4.5 (4-5)"
    assert all(paragraph in page.text for paragraph in verdict(comparison))
    assert "broken failed: weights <affnet> & more are missing" in page.text
    assert "not a <readable> image" in page.text
    assert "camera.mode" in page.text
    assert pycolmap.__version__ in page.text


def test_marks_say_what_each_method_does_with_a_photograph(page: Page) -> None:
    titles = page.values("span", "title")
    assert titles.count("sift: registered, correctly") == 4
    assert titles.count("sift: not registered") == 2
    assert titles.count("default: registered, correctly") == 4
    assert titles.count("default: registered with 1 of 2 seeds, wrongly") == 1
    groups = " ".join(page.values("li", "data-groups")).split()
    expected = {
        "all": 6,
        "seeds": 1,
        "wrong": 1,
        "none": 2,
    }  # "usually" differ: not with half
    assert {group: groups.count(group) for group in set(groups)} == expected


def test_photographs_that_their_method_doubts_are_marked(
    comparison: Comparison,
) -> None:
    seeds = [
        replace(seed, scores=None, doubtful={NAMES[1]: "any focal length fits"})
        for seed in comparison.methods[2].seeds
    ]
    compared = replace(
        comparison, methods=(replace(comparison.methods[2], seeds=tuple(seeds)),)
    )
    cards = contact_sheet(compared)
    assert [card.name for card in cards if "uncertain" in card.groups] == [NAMES[1]]


def test_page_loads_nothing_and_names_are_never_markup(
    page: Page, folder: Path
) -> None:
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes)
        for name in {"src", "href", "action", "data", "poster", "srcset"} & {
            *attributes
        }:
            assert str(attributes[name]).startswith(("data:", "#")), (tag, name)
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"https?://[^\s\"'<]*|url\(|@import", html) == []
    assert "default-src 'none'" in html
    assert NAMES[0] in page.text
    assert str(folder) not in html
    assert "photographs of photographs" in " ".join(page.text.split())


def test_what_is_missing_is_said_in_its_place(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    write_image(tmp_path / "photographs" / "a.png", texture((64, 48), 0))
    (tmp_path / "photographs" / "b.png").write_bytes(b"no image")
    seed = SeedResult(0, (), "", 0, 0, 0.0, 0.0)
    nothing = Comparison(
        ("a.png", "b.png"), str(tmp_path / "photographs"),
        (MethodResult("sift", seeds=(seed,)),), (0,), 1, {}, {},
    )  # fmt: skip
    page = Page(write_page(nothing, tmp_path).read_text(encoding="utf-8"))
    for sentence in (
        "no picture", "There is no model.", "No ground truth was given",
    ):  # fmt: skip
        assert sentence in page.text
    failed = replace(nothing, methods=(MethodResult("sift", failed="it <broke>"),))
    page = Page(write_page(failed, tmp_path).read_text(encoding="utf-8"))
    assert "sift failed: it <broke>" in page.text
    assert "No method finished" in page.text


def test_lost_models_are_said_in_their_place(
    comparison: Comparison, tmp_path: Path
) -> None:
    page = Page(write_page(comparison, tmp_path).read_text(encoding="utf-8"))
    assert "The model cannot be shown" in page.text
    assert page.cells["registered", "sift"] == "4"
