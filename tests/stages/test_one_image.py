"""From a file to the database: where features end up, at several sizes of processing."""

from __future__ import annotations

import pickle
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from synthetic import blobs, write_image

from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.initial_cameras import InitialCameras
from colmap_affrect.data import LocalFeatures
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.features.base import FeatureOptions
from colmap_affrect.geometry.conventions import camera_matrix
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.images.warping import warp
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import ExtractionOptions, Recipe, load_recipe
from colmap_affrect.session.context import Context, Inputs, Resources
from colmap_affrect.stages import match, one_image
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.one_image import num_images_at_once, prepare

WIDTH = 480
HEIGHT = 360
GRID = np.stack(
    np.meshgrid(np.arange(30, WIDTH - 20, 45), np.arange(30, HEIGHT - 20, 45)), -1
)
BLOBS = GRID.reshape(-1, 2) + np.random.default_rng(5).uniform(
    -2, 2, (GRID.size // 2, 2)
)
BLOB_SIGMA_PX = 5.2
MAX_BIAS_PX = 0.06
"""Half a pixel too much or too little at any step would be a bias of 0.17 px or more."""
MAX_ERROR_PX = 0.3


def write_blobs(path: Path) -> None:
    image = blobs(
        (WIDTH, HEIGHT), BLOBS, BLOB_SIGMA_PX * np.eye(2), amplitude=120, background=100
    )
    path.parent.mkdir(exist_ok=True)
    write_image(path, image)


def extracted(
    tmp_path: Path, photos: Path, recipe: Recipe, **given: object
) -> tuple[Workspace, StageReport]:
    workspace = Workspace(tmp_path / "out")
    with workspace.locked():
        return workspace, extract(
            Context(workspace), Inputs.of(photos, **given), recipe
        )


@pytest.mark.parametrize("max_size", [WIDTH, 360, 240])
def test_blob_is_half_a_pixel_further_in_the_database_at_every_size(tmp_path, max_size):
    write_blobs(tmp_path / "photos" / "blobs.png")
    recipe = load_recipe("default", [f"max_image_size_px={max_size}"])
    workspace, _ = extracted(tmp_path, tmp_path / "photos", recipe)
    with open_database(workspace.database) as database:
        keypoints = database.read_keypoints(image_ids(workspace.database)["blobs.png"])
    assert keypoints.shape[1] == 6
    centers = keypoints[:, None, :2] - (BLOBS + 0.5)[None]
    nearest = np.linalg.norm(centers, axis=2).argmin(axis=0)
    offsets = keypoints[nearest, :2] - (BLOBS + 0.5)
    found = np.linalg.norm(offsets, axis=1) < 2.0
    assert found.mean() > 0.5  # DoG misses round blobs of some sizes
    assert np.abs(offsets[found]).max() < MAX_ERROR_PX
    assert np.abs(offsets[found].mean(axis=0)).max() < MAX_BIAS_PX


@pytest.mark.parametrize("stretch", [True, False])
def test_faded_photograph_is_stretched_and_said_to_be(tmp_path, stretch):
    photos = tmp_path / "photos"
    write_blobs(photos / "good.png")
    good = cv2.imread(str(photos / "good.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(
        str(photos / "good.png"), cv2.normalize(good, None, 0, 255, cv2.NORM_MINMAX)
    )
    cv2.imwrite(str(photos / "faded.png"), 90 + good // 5)
    recipe = load_recipe("default", [f"stretch_contrast={str(stretch).lower()}"])
    workspace, report = extracted(tmp_path, photos, recipe)
    counts = FeatureStore(workspace.features).num_keypoints()
    assert (counts["faded.png"] > 0.9 * counts["good.png"]) == stretch
    values = {"num": 1, "example": "faded.png", "num_images": 2}
    warning = StageWarning("low_contrast", "contrast", values)
    assert report.warned == (warning,) * stretch


COURTYARD = Path(__file__).parents[2] / "sample_scenes" / "courtyard"
COURTYARD_CAMERA = CameraOptions(
    mode="single", model="PINHOLE", params="1080,1080,360,270"
)
DEPTH = ["depth.kind=z", "max_image_size_px=360"]


def courtyard(tmp_path: Path, num_maps: int) -> tuple[Path, Path]:
    """Two photographs and the depth maps of some of them."""
    photos = tmp_path / "photos"
    depth = tmp_path / "depth"
    photos.mkdir()
    depth.mkdir()
    for name in ["court_3", "court_4"]:
        shutil.copy(COURTYARD / "images" / f"{name}.jpg", photos)
    for name in ["court_3", "court_4"][:num_maps]:
        shutil.copy(COURTYARD / "depth" / f"{name}.png", depth)
    return photos, depth


@pytest.mark.parametrize(
    "recipe", ["depth-planes-recommended", "depth-affnet-recommended"]
)
def test_image_without_its_depth_map_is_extracted_unrectified_with_a_warning(
    tmp_path, recipe
):
    photos, depth = courtyard(tmp_path, 1)
    options = load_recipe(recipe, [*DEPTH, f"depth.path='{depth}'"])
    workspace, report = extracted(tmp_path, photos, options, cameras=COURTYARD_CAMERA)
    assert report.failures == {}
    assert report.num_done == 2
    (warning,) = report.warned
    assert (warning.code, warning.about) == ("not_rectified", "court_4.jpg")
    assert report.warnings == {"court_4.jpg": warning.text()}
    store = FeatureStore(workspace.features)
    assert (store.read("court_3.jpg").rectification_ids > 0).sum() > 50
    plain = prepare(load_recipe("unrectified-rootsift", DEPTH[1:]).extraction)
    expected = plain.extract_file(photos / "court_4.jpg").features
    assert (store.read("court_4.jpg").rectification_ids == 0).all()
    assert len(store.read("court_4.jpg")) == len(expected)


def test_depth_is_asked_for_before_any_image_is_read(tmp_path):
    photos, depth = courtyard(tmp_path, 0)
    for settings, error, message in [
        ([], OptionError, "rectifier depth-planes needs depth maps: give --depth-path"),
        ([f"depth.path='{depth}'"], OptionError, str(depth)),
        ([f"depth.path='{tmp_path / 'nowhere'}'"], OptionError, "nowhere"),
    ]:
        recipe = load_recipe("depth-planes-recommended", [*DEPTH, *settings])
        with pytest.raises(error, match=re.escape(message)):
            extracted(tmp_path, photos, recipe, cameras=COURTYARD_CAMERA)
        assert not (tmp_path / "out" / "features.h5").exists()


def test_device_that_is_not_there_is_one_clear_line(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(
        AffrectError, match=r"--device cuda: .*use --device cpu or auto"
    ) as error:
        prepare(load_recipe("default").extraction, Resources(device="cuda"))
    assert "\n" not in str(error.value)


def test_intrinsics_are_those_of_the_user_else_colmaps_guess(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((30, 50), np.uint8))
    options = CameraOptions(model="PINHOLE", params="61,62,24.5,16")
    given = InitialCameras(tmp_path, options).matrix("a.png", ["a.png"])
    np.testing.assert_allclose(given, [[61, 0, 24.0], [0, 62, 15.5], [0, 0, 1]])
    initial = InitialCameras(tmp_path, CameraOptions())
    guessed = initial.matrix("a.png", ["a.png", "b.png"])
    np.testing.assert_allclose(guessed, camera_matrix((50, 30)))
    (tmp_path / "b.png").write_bytes(b"no image")
    assert initial.matrix("b.png", ["a.png", "b.png"]) is None


def test_images_at_once_are_as_many_as_there_are_cores_and_memory_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    levels = ExtractionOptions().levels  # 2400 px: 1.4 GiB an image
    monkeypatch.setattr(one_image, "available_cores", lambda: 8)
    counts = []
    for gibibytes in (1, 9, 100):
        monkeypatch.setattr(
            one_image, "available_memory_bytes", lambda g=gibibytes: g << 30
        )
        counts.append(num_images_at_once(levels))
    assert counts == [1, 3, 8]
    shrunk = {"max_image_size_px": 1024, "features": "aliked"}
    learned = ExtractionOptions.from_mapping(shrunk, "test").levels
    for gibibytes, expected in (
        (1, 1),
        (9, 2),
        (100, 2),
    ):  # 1.6 GiB an image, and two at most
        monkeypatch.setattr(
            one_image, "available_memory_bytes", lambda g=gibibytes: g << 30
        )
        assert num_images_at_once(learned) == expected


def test_work_in_another_process_refuses_other_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"affnet": tmp_path / "AffNet.pth"}
    found["affnet"].write_bytes(b"published")
    pickled = pickle.dumps(replace(prepare(ExtractionOptions()), weights=found))
    for module in (one_image, match):
        monkeypatch.setattr(module, "resolve", lambda *_, **__: found)
    store = FeatureStore(tmp_path / "features.h5")
    matcher = pickle.dumps(match.CachedMatcher(match.Matching(store, NearestOptions())))
    assert pickle.loads(pickled).options == ExtractionOptions()
    pickle.loads(matcher)
    found["affnet"].write_bytes(b"of another release")
    for content in (pickled, matcher):
        with pytest.raises(
            AffrectError, match=r"AffNet\.pth: is not the file affnet of"
        ):
            pickle.loads(content)


def test_extraction_builds_no_networks_that_only_escalation_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here and in another process; files that are not the published ones are tried at once.

    So is level 1, which takes no files.
    """
    keys = ("affnet", "aliked-n16")
    files = {key: tmp_path / key for key in keys}
    for path in files.values():
        path.write_bytes(b"weights")
    monkeypatch.setattr(one_image, "resolve", lambda *_, **__: files)
    monkeypatch.setattr(Resources, "usable_levels", lambda *_: [0, 1, 2])
    monkeypatch.setattr(one_image, "is_published", lambda *_: True)
    monkeypatch.setitem(sys.modules, "colmap_affrect.features.networks", None)
    extraction = load_recipe("default").extraction
    prepared = prepare(extraction, only_first=True)
    elsewhere = pickle.loads(pickle.dumps(prepared))
    for extractor in (prepared, elsewhere):
        assert [*extractor.extractors] == [*extractor.rectifiers] == [0, 1]
        assert extractor.weights == files
    with pytest.raises(ImportError):
        prepare(extraction)
    monkeypatch.setattr(one_image, "is_published", lambda key, _: key == "affnet")
    with pytest.raises(ImportError):
        prepare(extraction, only_first=True)


class ColorOptions(FeatureOptions):
    """Asks for colour."""

    name: str = "color"
    in_color: ClassVar[bool] = True
    uses_network: ClassVar[bool] = False


class KeepsViews:
    """An extractor that keeps what it is shown and finds nothing."""

    descriptor_size = 8

    def __init__(self):
        self.views = []

    def detect(self, view):
        self.views.append(view[0])
        return LocalFeatures.empty(8)

    def describe(self, _, detected):
        return list(detected)


def test_extractors_that_ask_for_colour_see_the_warps_in_colour(tmp_path):
    image = cv2.imread(str(COURTYARD / "images" / "court_4.jpg"))
    image[:, :, 2] = 255 - image[:, :, 0] // 2  # OpenCV's order: blue, green, red
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), image)
    keeps = KeepsViews()
    gray = prepare(ExtractionOptions(max_image_size_px=360))
    options = gray.options.changed(features=ColorOptions())
    color = replace(gray, options=options, extractors=(keeps,))
    assert len(color.extract_file(path).features) == 0
    whole, *warps = keeps.views
    assert whole.shape == (270, 360, 3)
    assert whole[5, 7, 0] > 120  # red comes first
    assert warps
    photograph, _ = gray.photograph(path)
    for view, item in zip(warps, gray.plan(photograph)[0].items, strict=True):
        assert view.shape == (*item.canvas_size[::-1], 3)
        channel = warp(np.ascontiguousarray(whole[:, :, 1]), item)
        assert_array_equal(view[:, :, 1], channel)
