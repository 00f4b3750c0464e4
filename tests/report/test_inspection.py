"""What inspection writes: sheets that show the regions, warps and features of extraction."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import texture, write_image

from colmap_affrect.data import (
    LocalFeatures,
    Photograph,
    Rectification,
    RectificationPlan,
)
from colmap_affrect.errors import ImageError
from colmap_affrect.recipes import load_recipe
from colmap_affrect.report.inspection import inspect_image, inspect_level, tinted
from colmap_affrect.report.sheets import PALETTE, WIDTH_PX, Panel, rgb
from colmap_affrect.session import context
from colmap_affrect.stages.one_image import ImageExtractor, prepare

SIZE = (300, 200)


@pytest.fixture(scope="module")
def extractor() -> ImageExtractor:
    return prepare(load_recipe("rectified").extraction)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """A texture that is slanted, so that it is warped."""
    slanted = cv2.resize(
        texture((3 * SIZE[0], SIZE[1]), 3), SIZE, interpolation=cv2.INTER_AREA
    )
    return write_image(tmp_path / "photo.png", slanted)


def inspect(extractor: ImageExtractor, path: Path, output_path: Path) -> str:
    """Inspect an image and return what is said; the sheet must be of sane size and not blank."""
    said = inspect_image(extractor, path, output_path)
    data = np.fromfile(output_path / f"{path.stem}-inspection.png", np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture.shape[1] == WIDTH_PX
    assert 50 < picture.shape[0] < 6000
    assert picture.std() > 5.0
    lines = cv2.imdecode(
        np.fromfile(output_path / f"{path.stem}-inspection-lines.png", np.uint8),
        cv2.IMREAD_COLOR,
    )
    assert lines.shape[1] == WIDTH_PX
    assert "lines: " in said
    return said


def test_level_has_the_plan_and_the_features_of_extraction(
    extractor: ImageExtractor, photo: Path, tmp_path: Path
) -> None:
    photograph, _ = extractor.photograph(photo)
    level = inspect_level(extractor, photograph, 0)
    plan, _ = extractor.plan(photograph)
    features = extractor.extract_file(photo).features
    assert len(level.plan.items) == len(plan.items) > 0
    assert_array_equal(level.features.lafs, features.lafs)
    kept = np.bincount(level.features.rectification_ids, minlength=len(plan.items) + 1)
    assert set(level.detected) == set(range(len(plan.items) + 1))
    assert all(
        kept[number] <= len(found) for number, (_, found) in level.detected.items()
    )
    said = inspect(extractor, photo, tmp_path / "new" / "out")
    assert f"{len(plan.items)} warp" in said
    assert f"{len(features)} features" in said


@pytest.mark.long
def test_levels_that_wait_for_weights_are_passed_over(
    photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(context, "find", lambda *_: None)
    said = inspect(prepare(load_recipe("default").extraction), photo, tmp_path / "out")
    assert [line.partition(",")[0] for line in said.splitlines()[:3]] == [
        "level 0", "level 1", "level 3"
    ]  # fmt: skip
    assert (tmp_path / "out" / "photo-inspection-level-3.png").exists()


def test_missing_depth_is_a_warning_as_in_extraction(
    photo: Path, tmp_path: Path
) -> None:
    (tmp_path / "depth").mkdir()
    recipe = load_recipe(
        "depth-planes-recommended", [f'depth.path="{tmp_path / "depth"}"']
    )
    said = inspect(prepare(recipe.extraction), photo, tmp_path / "out")
    assert "no warps; " in said
    assert "no depth map of photo.png" in said


def test_unreadable_image_is_refused_before_anything_is_written(
    extractor: ImageExtractor, tmp_path: Path
) -> None:
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"broken\.png"):
        inspect_image(extractor, tmp_path / "broken.png", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("size", [(1, 1), (600, 33)])
def test_sheet_of_small_and_flat_images(
    extractor: ImageExtractor, size: tuple[int, int], tmp_path: Path
) -> None:
    path = write_image(tmp_path / "flat.png", np.full(size[::-1], 90, np.uint8))
    inspect(extractor, path, tmp_path / "out")


def test_names_of_every_kind_are_written_and_drawn(
    extractor: ImageExtractor, photo: Path, tmp_path: Path
) -> None:
    inspect(
        extractor, photo.rename(tmp_path / "a $x^{$ ü 漢字.png"), tmp_path / "Ausgabe ä"
    )
    assert (tmp_path / "Ausgabe ä" / "a $x^{$ ü 漢字-inspection.png").exists()


def test_features_are_ellipses_of_two_sigmas() -> None:
    """The LAF of a feature is that of six sigmas."""
    lafs = np.array([[[30.0, 0.0, 49.5], [0.0, 15.0, 49.5]]])
    features = LocalFeatures(lafs, np.ones(1, np.float32), np.zeros((1, 0), np.float32))
    panel = Panel.fit(np.zeros((100, 100), np.uint8), 2)
    scale = len(panel.image) / 100
    panel.draw_features(features, [(255, 0, 0)], 1)
    rows, columns = np.nonzero(panel.image[:, :, 0])
    assert np.ptp(columns) == pytest.approx(2 * 10 * scale, abs=3)
    assert np.ptp(rows) == pytest.approx(2 * 5 * scale, abs=3)


def test_region_is_tinted_where_it_lies() -> None:
    region = np.ones((50, 120), bool)
    item = Rectification(np.eye(3), SIZE, region, 2.0, 0.3, region_origin=(150, 20))
    photograph = Photograph(
        np.full(SIZE[::-1], 100, np.uint8), "photo.png", None, np.eye(3)
    )
    image = tinted(photograph, RectificationPlan(SIZE, (item,)))
    color = np.array(rgb(PALETTE[0]))
    is_tinted = np.zeros(SIZE[::-1], bool)
    is_tinted[20:70, 150:270] = True
    assert_allclose(
        image[is_tinted], np.tile(0.55 * 100 + 0.45 * color, (6000, 1)), atol=1
    )
    assert_array_equal(image[~is_tinted], 100)
