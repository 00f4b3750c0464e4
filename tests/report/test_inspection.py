"""What inspection writes: the plan as data, and sheets that show it at the right place."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from synthetic import texture, write_image

from colmap_affrect.data import (
    GrayImage,
    LocalFeatures,
    Photograph,
    Rectification,
    RectificationPlan,
    View,
)
from colmap_affrect.errors import DepthError, ImageError
from colmap_affrect.features.second_moment import SecondMoment, SecondMomentOptions
from colmap_affrect.geometry.affine import (
    fit_canvas,
    image_corners,
    lafs_from_keypoints,
    rectifying_affine,
)
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    RectifierInputs,
    RectifierOptions,
)
from colmap_affrect.rectifiers.dense import DenseShapesOptions
from colmap_affrect.rectifiers.depth_planes import DepthPlanesOptions
from colmap_affrect.rectifiers.whole_image import (
    AsiftOptions,
    IdentityOptions,
)
from colmap_affrect.report.inspection import inspect_image
from colmap_affrect.report.sheet import DPI, PALETTE, WIDTH_INCHES, printable, tinted
from colmap_affrect.stages.one_image import ImageExtractor

SIZE = (300, 200)
SHAPES = RectifierInputs(SecondMoment(SecondMomentOptions()))


class GridFeatures:
    """A feature extractor that finds a feature every 20 px, wherever the mask is set."""

    descriptor_size = 3

    def detect(self, view: View) -> LocalFeatures:
        image, mask = view
        is_found = np.ones(image.shape, bool) if mask is None else mask > 0
        grid = np.zeros_like(is_found)
        grid[10::20, 10::20] = True
        points = np.argwhere(grid & is_found)[:, ::-1].astype(float)
        count = len(points)
        lafs = lafs_from_keypoints(points, np.full(count, 12.0), np.zeros(count))
        responses = np.linspace(1, 2, count).astype(np.float32)
        return LocalFeatures(lafs, responses, np.zeros((count, 3), np.float32))

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        assert len(images) == len(detected)
        return list(detected)


class Planned:
    """A rectifier with a plan made beforehand; without one its depth map is missing."""

    def __init__(self, plan: RectificationPlan | None = None) -> None:
        self._plan = plan

    def plan(self, photograph: Photograph) -> RectificationPlan:
        if self._plan is None:
            raise DepthError(f"{photograph.name}: no depth map below {'/very/long/folder' * 20}")
        assert photograph.size == self._plan.image_size
        return self._plan


def affine_warp(
    tilt: float, angle: float, box: tuple[int, int, int, int], segment: int = 0
) -> Rectification:
    """Warp of a box (left, top, width, height)."""
    (left, top), size = box[:2], box[2:]
    corners = image_corners(size) + np.array([left, top])
    matrix, canvas = fit_canvas(rectifying_affine(tilt, angle), corners, 8.0)
    region = np.ones(size[::-1], bool)
    return Rectification(matrix, canvas, region, tilt, angle, (left, top), segment)


def homography_warp(segment: int) -> Rectification:
    homography = np.array([[1.3, 0.1, -150.0], [0.1, 1.2, -40.0], [1e-3, 2e-4, 1.0]])
    region = np.zeros((70, 50), bool)
    region[5:70, 10:45] = True
    return Rectification(homography, (180, 160), region, 1.4, 0.25, (180, 90), segment)


def extractor_with(options: RectifierOptions, rectifier: Any) -> ImageExtractor:
    return ImageExtractor(ExtractionOptions(rectifier=options), (GridFeatures(),), (rectifier,))


def extractor_of(plan: RectificationPlan) -> ImageExtractor:
    options = AsiftOptions() if plan.items else IdentityOptions()
    return extractor_with(options, Planned(plan))


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return write_image(tmp_path / "photo.png", texture(SIZE, 3))


Inspected = tuple[list[dict[str, Any]], NDArray[np.int_]]
"""The levels as in the JSON file, and the (H, W, 3) RGB of the first sheet."""


def inspect(extractor: ImageExtractor, path: Path, output_path: Path) -> Inspected:
    """Inspect an image; the sheet must be of sane size and not blank."""
    inspect_image(extractor, path, output_path)
    data = np.fromfile(output_path / f"{path.stem}-inspection.png", np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1]
    assert picture.shape[1] == WIDTH_INCHES * DPI
    assert 300 < picture.shape[0] < 6000
    assert picture.std() > 20.0
    plan = json.loads((output_path / f"{path.stem}-plan.json").read_text(encoding="utf-8"))
    assert plan["image"] == path.name
    return plan["levels"], picture.astype(int)


# --- The plan as data


@pytest.mark.long
def test_json_describes_a_known_plan(tmp_path: Path, photo: Path) -> None:
    first, second = affine_warp(2.5, 0.6, (30, 20, 60, 45), 4), homography_warp(7)
    third = affine_warp(1.9, 1.1, (30, 20, 60, 45), 4)
    extractor = extractor_of(RectificationPlan(SIZE, (first, second, third)))
    shown = inspect_image(extractor, photo, tmp_path / "new" / "out")
    plan_path = tmp_path / "new" / "out" / "photo-plan.json"
    data = json.loads(plan_path.read_text(encoding="utf-8"))
    assert data["levels"][0]["size"] == data["stored_size"] == [300, 200]
    assert data["options"]["rectifier"]["name"] == "asift"
    (level,) = data["levels"]
    warp1, warp2, warp3 = level["warps"]
    assert (warp1["id"], warp1["segment"], warp1["tilt"]) == (1, 4, 2.5)
    assert warp1["angle_deg"] == pytest.approx(np.rad2deg(0.6))
    assert_allclose(warp1["rectified_from_image"], first.rectified_from_image)
    assert warp1["canvas_size"] == list(first.canvas_size)
    assert warp1["region"] == {
        "bounding_box": [30, 20, 60, 45],
        "area_px": 60 * 45,
        "share": 60 * 45 / 60_000,
    }
    assert warp2["region"]["bounding_box"] == [190, 95, 35, 65]
    assert warp2["region"]["area_px"] == 35 * 65
    assert_allclose(warp2["rectified_from_image"], second.rectified_from_image)
    assert warp3["id"] == 3
    totals = level["totals"]
    area = sum(item.canvas_area_px for item in (first, second, third))
    assert totals["warped_area_mpx"] == pytest.approx(area / 1e6)
    assert totals["warped_share"] == pytest.approx(area / 60_000)
    assert (totals["warps"], totals["regions"], totals["warps_per_region"]) == (3, 2, 1.5)
    kept = [warp["features_kept"] for warp in level["warps"]]
    assert all(0 < kept[k] <= level["warps"][k]["features_found"] for k in range(3))
    assert totals["keypoints"] == level["original"]["features_kept"] + sum(kept)
    assert level["original"]["features_found"] == 15 * 10
    assert set(level["seconds"]) == {"plan", "warp and choose", "detect", "describe"}
    assert "3 warps" in shown
    assert str(plan_path) in shown


def test_missing_depth_is_a_warning_as_in_extraction(tmp_path: Path, photo: Path) -> None:
    (level,), _ = inspect(extractor_with(DepthPlanesOptions(), Planned()), photo, tmp_path / "out")
    assert level["warning"].startswith("not rectified: photo.png: no depth map")
    assert level["totals"]["keypoints"] == 150


def test_unreadable_image_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "broken.png").write_bytes(b"no image")
    extractor = extractor_of(RectificationPlan(SIZE))
    with pytest.raises(ImageError, match=r"broken\.png"):
        inspect_image(extractor, tmp_path / "broken.png", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- Sheets


@pytest.mark.parametrize("size", [(1, 1), (600, 33)])
def test_sheet_of_small_and_flat_images(size: tuple[int, int], tmp_path: Path) -> None:
    path = write_image(tmp_path / "flat.png", np.full(size[::-1], 90, np.uint8))
    options = DenseShapesOptions()
    inspect(extractor_with(options, RECTIFIERS.make(options, SHAPES)), path, tmp_path / "out")


def test_names_of_every_kind_are_written_and_drawn(tmp_path: Path) -> None:
    path = tmp_path / "a $x^{$ ü 漢字.png"
    write_image(path, texture(SIZE, 3))
    inspect(extractor_of(RectificationPlan(SIZE)), path, tmp_path / "Ausgabe ä")
    assert (tmp_path / "Ausgabe ä" / "a $x^{$ ü 漢字-inspection.png").exists()
    assert printable("a ü Ж 漢") == "a ü Ж \N{REPLACEMENT CHARACTER}"


# --- Parts


def test_region_is_tinted_where_it_lies(tmp_path: Path) -> None:
    path = write_image(tmp_path / "photo.png", np.full(SIZE[::-1], 100, np.uint8))
    plan = RectificationPlan(SIZE, (affine_warp(2.0, 0.3, (150, 20, 120, 50)),))
    photograph, _ = extractor_of(plan).photograph(path)
    image = tinted(photograph, plan)
    color = np.array([int(PALETTE[0][k : k + 2], 16) for k in (1, 3, 5)])
    is_tinted = np.zeros(SIZE[::-1], bool)
    is_tinted[20:70, 150:270] = True
    assert_allclose(image[is_tinted], np.tile(0.55 * 100 + 0.45 * color, (6000, 1)), atol=1)
    assert_array_equal(image[~is_tinted], 100)
