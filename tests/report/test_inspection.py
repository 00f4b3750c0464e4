"""What inspection writes: the plan as data, and sheets that show it at the right place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import texture, write_image

from colmap_affrect.data import Photograph, Rectification, RectificationPlan
from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.affine import fit_canvas, image_corners, rectifying_affine
from colmap_affrect.recipes import load_recipe
from colmap_affrect.report.inspection import inspect_image
from colmap_affrect.report.levels import bounding_box
from colmap_affrect.report.sheet import PALETTE, WIDTH_PX, tinted
from colmap_affrect.stages.one_image import ImageExtractor, prepare

SIZE = (300, 200)


@pytest.fixture(scope="module")
def extractor() -> ImageExtractor:
    return prepare(load_recipe("default").extraction)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """A texture that is slanted, so that it is warped."""
    slanted = cv2.resize(texture((3 * SIZE[0], SIZE[1]), 3), SIZE, interpolation=cv2.INTER_AREA)
    return write_image(tmp_path / "photo.png", slanted)


def inspect(extractor: ImageExtractor, path: Path, output_path: Path) -> list[dict[str, Any]]:
    """Inspect an image and return its levels; the sheet must be of sane size and not blank."""
    inspect_image(extractor, path, output_path)
    data = np.fromfile(output_path / f"{path.stem}-inspection.png", np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture.shape[1] == WIDTH_PX
    assert 50 < picture.shape[0] < 6000
    assert picture.std() > 5.0
    plan = json.loads((output_path / f"{path.stem}-plan.json").read_text(encoding="utf-8"))
    assert plan["image"] == path.name
    levels: list[dict[str, Any]] = plan["levels"]
    return levels


def warp_of(box: tuple[int, int, int, int], tilt: float, angle_rad: float) -> Rectification:
    """Warp of a box (left, top, width, height)."""
    (left, top), size = box[:2], box[2:]
    corners = image_corners(size) + np.array([left, top])
    matrix, canvas = fit_canvas(rectifying_affine(tilt, angle_rad), corners, 8.0)
    region = np.ones(size[::-1], bool)
    return Rectification(matrix, canvas, region, tilt, angle_rad, (left, top), 0)


def test_json_has_the_plan_and_the_features_of_extraction(
    extractor: ImageExtractor, photo: Path, tmp_path: Path
) -> None:
    (level,) = inspect(extractor, photo, tmp_path / "new" / "out")
    photograph, stored_size = extractor.photograph(photo)
    plan, _ = extractor.plan_or_warn(photograph)
    assert level["size"] == list(stored_size) == list(SIZE)
    assert len(level["warps"]) == len(plan.items) > 0
    for number, (warp, item) in enumerate(zip(level["warps"], plan.items, strict=True), 1):
        assert (warp["id"], warp["tilt"]) == (number, item.tilt)
        assert warp["angle_deg"] == pytest.approx(np.rad2deg(item.tilt_angle_rad))
        assert_allclose(warp["rectified_from_image"], item.rectified_from_image)
        assert warp["canvas_size"] == list(item.canvas_size)
        assert warp["region"]["area_px"] == np.count_nonzero(item.region)
        assert warp["features_kept"] <= warp["features_found"]
    totals = level["totals"]
    area_px = sum(item.canvas_area_px for item in plan.items)
    assert totals["warped_area_mpx"] == pytest.approx(area_px / 1e6)
    assert totals["warped_share"] == pytest.approx(area_px / 60_000)
    kept = level["original"]["features_kept"] + sum(w["features_kept"] for w in level["warps"])
    assert totals["keypoints"] == kept == len(extractor.extract_file(photo).features) > 100
    assert set(level["seconds"]) == {"plan", "warp and choose", "detect", "describe"}


def test_missing_depth_is_a_warning_as_in_extraction(photo: Path, tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    recipe = load_recipe("depth-planes-recommended", [f'depth.path="{tmp_path / "depth"}"'])
    (level,) = inspect(prepare(recipe.extraction), photo, tmp_path / "out")
    assert level["warning"].startswith("not rectified: ")
    assert "no depth map of photo.png" in level["warning"]
    assert level["totals"]["keypoints"] > 0


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
    inspect(extractor, photo.rename(tmp_path / "a $x^{$ ü 漢字.png"), tmp_path / "Ausgabe ä")
    assert (tmp_path / "Ausgabe ä" / "a $x^{$ ü 漢字-inspection.png").exists()


def test_region_is_tinted_where_it_lies() -> None:
    item = warp_of((150, 20, 120, 50), 2.0, 0.3)
    assert bounding_box(item, SIZE) == (150, 20, 120, 50)
    photograph = Photograph(np.full(SIZE[::-1], 100, np.uint8), "photo.png", None, np.eye(3))
    image = tinted(photograph, RectificationPlan(SIZE, (item,)))
    color = np.array([int(PALETTE[0][k : k + 2], 16) for k in (1, 3, 5)])
    is_tinted = np.zeros(SIZE[::-1], bool)
    is_tinted[20:70, 150:270] = True
    assert_allclose(image[is_tinted], np.tile(0.55 * 100 + 0.45 * color, (6000, 1)), atol=1)
    assert_array_equal(image[~is_tinted], 100)
