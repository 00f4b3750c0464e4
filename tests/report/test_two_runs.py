"""Two runs laid over each other: the similarity, the page and its slider."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import (
    Browser,
    assert_fits_and_is_readable,
    chromium,
    needs_chromium,
    until_changed,
    until_drawn,
)
from small_comparison import write_scene

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import NoModelError, OptionError
from colmap_affrect.mappers.mapping import read_summaries, write_summary
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.report.two_runs import similarity_of, write_two_runs

NAMES = ["a.png", "b.png", "c.png", "d.png", "e.png"]
MOVED = pycolmap.Sim3d(
    2.5, pycolmap.Rotation3d(np.array([0.5, 0.5, 0.5, 0.5])), np.array([3.0, -1.0, 4.0])
)


def centers_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.projection_center() for image in model.images.values()}


@pytest.fixture
def scene(tmp_path: Path) -> pycolmap.Reconstruction:
    return write_scene(tmp_path / "scene.db", NAMES)[0]


def test_models_are_laid_over_each_other_by_the_photographs_that_both_have(
    scene: pycolmap.Reconstruction,
) -> None:
    source = pycolmap.Reconstruction(scene)
    source.transform(MOVED)
    found = similarity_of(source, scene)
    assert found is not None
    source.transform(found)
    expected = centers_of(scene)
    for name, center in centers_of(source).items():
        assert center == pytest.approx(expected[name], abs=1e-6)


def test_a_photograph_that_is_elsewhere_moves_no_model(
    scene: pycolmap.Reconstruction,
) -> None:
    source = pycolmap.Reconstruction(scene)
    source.transform(MOVED)
    elsewhere = next(i for i in source.images.values() if i.name == "c.png")
    elsewhere.frame.rig_from_world = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.0, 1.0, 0.0, 0.0])), np.array([40.0, 0.0, 9.0])
    )
    found = similarity_of(source, scene)
    assert found is not None
    source.transform(found)
    expected = centers_of(scene)
    for name, center in centers_of(source).items():
        is_right = np.allclose(center, expected[name], atol=1e-6)
        assert is_right == (name != "c.png")


def test_models_without_photographs_in_common_cannot_be_laid_over(
    scene: pycolmap.Reconstruction,
) -> None:
    other = pycolmap.Reconstruction(scene)
    for image in other.images.values():
        image.name = f"other {image.name}"
    assert similarity_of(other, scene) is None


def write_run(folder: Path, model: pycolmap.Reconstruction, num: int) -> None:
    """Write a folder of one model with the first photographs."""
    path = folder / "sparse" / "0"
    path.mkdir(parents=True)
    kept = pycolmap.Reconstruction(model)
    for image in list(kept.images.values()):
        if image.name not in NAMES[:num]:
            kept.deregister_frame(image.frame_id)
    kept.write(path)
    summary = ModelSummary(
        tuple(NAMES[:num]), 90, 3.0, 0.5, probabilities=dict.fromkeys(NAMES[:num], 0.95)
    )
    write_summary(summary, path)


@pytest.fixture
def page(tmp_path: Path, scene: pycolmap.Reconstruction) -> Path:
    write_run(tmp_path / "before", scene, 3)
    scene.transform(MOVED)
    write_run(tmp_path / "after", scene, 5)
    assert len(read_summaries(tmp_path / "after" / "sparse")) == 1
    return write_two_runs(tmp_path / "before", tmp_path / "after")


def test_the_page_says_what_changed_and_is_replaced_while_files_of_others_stay(
    page: Path, tmp_path: Path
) -> None:
    text = page.read_text(encoding="utf-8")
    assert "2 of 5 photographs changed" in text
    assert text.count("was not placed, is sure") == 2
    write_two_runs(tmp_path / "before", tmp_path / "after")
    mine = tmp_path / "mine.html"
    mine.write_text("my page", encoding="utf-8")
    with pytest.raises(OptionError, match="is there already"):
        write_two_runs(tmp_path / "before", tmp_path / "after", mine)
    assert mine.read_text(encoding="utf-8") == "my page"
    with pytest.raises(NoModelError, match="has no model"):
        write_two_runs(tmp_path, tmp_path / "after")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        found.resize(1400)
        yield found


SLIDE = """const slider = document.getElementById("before-after");
    slider.value = arguments[0];
    slider.dispatchEvent(new Event("input"))"""
NUM_DRAWN = """const canvas = document.querySelector("canvas");
    const copy = new OffscreenCanvas(canvas.width, canvas.height)
      .getContext("2d", {willReadFrequently: true});
    copy.drawImage(canvas, 0, 0);
    const pixels = copy.getImageData(0, 0, canvas.width, canvas.height).data;
    let [orange, all] = [0, 0];
    for (let at = 0; at < pixels.length; at += 4) {
      if (!pixels[at + 3]) continue;
      all += 1;
      orange += pixels[at] > 150 && pixels[at + 2] < 60;
    }
    return [orange, all]"""


@needs_chromium
@pytest.mark.long
def test_the_slider_goes_from_before_to_after(browser: Browser, page: Path) -> None:
    browser.open(page)
    both = until_drawn(browser)
    browser.run(SLIDE, 0)
    before = until_changed(browser, both)
    orange, drawn = browser.run(NUM_DRAWN)
    assert orange > 0.5 * drawn
    browser.run(SLIDE, 100)
    until_changed(browser, before)
    orange, drawn_after = browser.run(NUM_DRAWN)
    assert orange == 0
    assert drawn_after > 0
    for width in (390, 1400):
        for scheme in ("light", "dark"):
            assert_fits_and_is_readable(browser, scheme, width)
    assert browser.log() == []
