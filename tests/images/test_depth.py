"""Depth maps of photographs: formats, kinds, every error, and real networks of a tiny size."""

from __future__ import annotations

import json
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import h5py
import numpy as np
import pytest
from contracts.depth_contract import DepthContract
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import write_image

from colmap_affrect.colmap.poses import read_poses
from colmap_affrect.conventions import pixel_from_colmap
from colmap_affrect.data import Photograph
from colmap_affrect.errors import DepthError, ImageError
from colmap_affrect.images.depth import (
    NETWORK_IMAGE_SIZE_PX,
    DepthContext,
    DepthFiles,
    DepthFilesOptions,
    MonocularDepth,
    MonocularOptions,
    predicts_inverse_depth,
)
from colmap_affrect.images.reading import read_gray

COURTYARD = Path(__file__).parents[2] / "sample_scenes" / "courtyard"
PNG_METRES = 0.002
"""One step of the courtyard's depth maps."""

MEGADEPTH = Path(__file__).parents[3] / "shared" / "pairs" / "svp_sample"

FLOAT32_RTOL = 1e-6
"""Rounding to float32 after float64 arithmetic."""

PAVING_TOLERANCE_M = 0.5 * PNG_METRES
"""Rounding of the courtyard's maps. It moves a point along its ray, which meets the paving at
less than 90 degrees: the height changes by less."""

CAMERA = np.array([[30.0, 0.0, 4.2], [0.0, 21.0, 2.9], [0.0, 0.0, 1.0]])
"""Of an image of 12 x 8 px: principal point off the middle, pixels not square."""


def photograph(name="a.jpg", size=(12, 8), camera_matrix=CAMERA, path=None):
    return Photograph(np.zeros(size[::-1], np.uint8), name, path, camera_matrix)


def asymmetric_map(size=(6, 4)):
    """(h, w) values of which no two are the same, nor any flip or transpose."""
    width, height = size
    return np.arange(1.0, 1.0 + width * height).reshape(height, width) ** 1.5


def write_map(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values)
    elif path.suffix == ".png":
        write_image(path, values)
    else:
        with h5py.File(path, "w") as file:
            file["depth"] = values
    return path


def source(path, **options):
    return DepthFiles(DepthFilesOptions(path=str(path), **options))


# --- files: formats and places


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4", np.int32, np.uint16])
@pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5", ".hdf5"])
def test_arrays_round_trip(tmp_path, suffix, dtype):
    values = np.asfortranarray(asymmetric_map().astype(dtype))
    write_map(tmp_path / f"a{suffix}", values)
    depth = source(tmp_path).depth(photograph())
    assert depth.dtype == np.float32
    assert_allclose(depth, values, rtol=FLOAT32_RTOL)


def test_png_of_sixteen_bits_counts_steps_and_zero_is_unknown(tmp_path):
    steps = (1000 * asymmetric_map()).astype(np.uint16)
    steps[2, 1] = 0
    write_map(tmp_path / "a.png", steps)
    depth = source(tmp_path, png_scale=0.002).depth(photograph())
    expected = np.where(steps == 0, np.nan, 0.002 * steps)
    assert_allclose(depth, expected, rtol=FLOAT32_RTOL)


def has_openexr():
    try:
        return cv2.haveImageWriter(".exr")
    except cv2.error:  # built with it, but OPENCV_IO_ENABLE_OPENEXR is not set
        return False


@pytest.mark.skipif(not has_openexr(), reason="this OpenCV has no OpenEXR")
def test_exr_round_trips(tmp_path):
    values = asymmetric_map().astype(np.float32)
    write_image(tmp_path / "a.exr", values)
    assert_array_equal(source(tmp_path).depth(photograph()), values)


def test_exr_that_opencv_cannot_read_says_what_to_do(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(range(200)))
    with pytest.raises(
        DepthError, match=r"a\.exr: .* a\.jpg: OpenCV .* cannot read it; save .*npy"
    ):
        source(tmp_path).depth(photograph())


def test_the_only_map_of_a_file_is_taken_or_the_one_named_depth(tmp_path):
    values = asymmetric_map()
    contents = {
        "a": {"inner": values},
        "b": {"confidence": 2 * values, "depth": values},
        "c": {"left": values, "right": 2 * values},
    }
    for name, arrays in contents.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
        with h5py.File(tmp_path / f"{name}{name}.h5", "w") as file:
            file["intrinsics"] = np.arange(4.0)  # not of two dimensions
            for key, array in arrays.items():
                file[key] = array
    depths = source(tmp_path)
    for name in ("a", "aa", "b", "bb"):
        assert_allclose(depths.depth(photograph(f"{name}.jpg")), values, rtol=FLOAT32_RTOL)
    for name, expected in (("c", "one array"), ("cc", "one dataset of two dimensions")):
        message = f"expected {expected}, or one named 'depth', found left, right"
        with pytest.raises(DepthError, match=message):
            depths.depth(photograph(f"{name}.jpg"))


def test_places_are_searched_in_the_documented_order(tmp_path):
    suffixes = (".npy", ".npz", ".png", ".h5", ".hdf5")
    places = [f"{stem}{suffix}" for stem in ("sub/a.jpg", "sub/a") for suffix in suffixes]
    for number, place in enumerate(places, 1):
        write_map(tmp_path / place, np.full((4, 6), number, np.uint16))
    for number, place in enumerate(places, 1):
        depth = source(tmp_path, png_scale=1.0).depth(photograph("sub/a.jpg"))
        assert (depth == number).all(), place
        (tmp_path / place).unlink()


@pytest.mark.parametrize("name", ["a b/c d.jpg", "dům/Žižkův dům #1.JPG", "v1.2/x.y.tif"])
@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png", ".h5"])
def test_nested_names_with_spaces_dots_and_letters_of_all_kinds(tmp_path, name, suffix):
    values = (100 * asymmetric_map()).astype(np.uint16)
    stem = name.rpartition(".")[0]
    write_map(tmp_path / f"{stem}{suffix}", values)
    depth = source(tmp_path, png_scale=1.0).depth(photograph(name))
    assert_array_equal(depth, values)


def test_values_that_are_no_depth_are_unknown_and_raise_no_warning(tmp_path):
    values = asymmetric_map()
    values[0, :4] = [np.nan, np.inf, -np.inf, -1.0]
    values[1, :3] = [0.0, 1e300, 1e-300]
    write_map(tmp_path / "a.npy", values)
    unknown = np.zeros(values.shape, bool)
    unknown[0, :4] = unknown[1, :3] = True
    for kind in ("z", "ray"):
        depth = source(tmp_path, kind=kind).depth(photograph())
        assert_array_equal(np.isnan(depth), unknown)
        assert (depth[~unknown] > 0).all()


# --- files: kinds


def slanted_plane(size, camera_matrix):
    """Depth along the axis and along the rays of the plane n . X = 3 seen by a camera."""
    normal = np.array([0.3, -0.5, 1.0])
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack(
        [
            (columns - camera_matrix[0, 2]) / camera_matrix[0, 0],
            (rows - camera_matrix[1, 2]) / camera_matrix[1, 1],
            np.ones(size[::-1]),
        ],
        axis=-1,
    )
    z_depth = 3.0 / (rays @ normal)
    return z_depth, z_depth * np.linalg.norm(rays, axis=-1)


@pytest.mark.parametrize(("scale_x", "scale_y"), [(1, 1), (0.5, 0.5), (2.0, 2.0), (1.0, 25 / 24)])
def test_distances_along_rays_become_depths_along_the_axis(tmp_path, scale_x, scale_y):
    # Written out: pixel centres of a resized image, p' = s (p + 1/2) - 1/2.
    camera = np.array(
        [
            [scale_x * 300.0, 0.0, scale_x * (50.0 + 0.5) - 0.5],
            [0.0, scale_y * 210.0, scale_y * (30.0 + 0.5) - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    z_depth, ray_length = slanted_plane((round(144 * scale_x), round(96 * scale_y)), camera)
    assert np.abs(ray_length / z_depth - 1).max() > 0.04, "the test must tell the two apart"
    write_map(tmp_path / "a.npy", ray_length)
    original = np.array([[300.0, 0.0, 50.0], [0.0, 210.0, 30.0], [0.0, 0.0, 1.0]])
    image = photograph(size=(144, 96), camera_matrix=original)
    assert_allclose(source(tmp_path, kind="ray").depth(image), z_depth, rtol=FLOAT32_RTOL)
    assert_allclose(source(tmp_path).depth(image), ray_length, rtol=FLOAT32_RTOL)


def test_inverse_depth_is_inverted_after_scaling_and_what_is_not_positive_is_unknown(tmp_path):
    steps = np.array([[0, 1, 2], [10, 50, 65535]], np.uint16)
    write_map(tmp_path / "a.png", steps)
    depth = source(tmp_path, kind="inverse", png_scale=0.5).depth(photograph())
    assert_allclose(depth, [[np.nan, 2.0, 1.0], [0.2, 0.04, 2 / 65535]], rtol=FLOAT32_RTOL)


# --- files: errors


def test_missing_map_names_the_places_looked_at(tmp_path):
    with pytest.raises(DepthError) as error:
        source(tmp_path).depth(photograph("side/a.jpg"))
    message = str(error.value)
    assert message.startswith(f"{tmp_path}: no depth map of side/a.jpg; ")
    assert "side/a.jpg.* and side/a.* with * one of .npy, .npz, .png, .exr, .h5, .hdf5" in message
    assert "\n" not in message
    with pytest.raises(DepthError, match="no depth map"):
        source(tmp_path).depth(photograph(""))


def test_png_of_eight_bits_is_refused_as_a_preview(tmp_path):
    write_map(tmp_path / "a.png", np.full((4, 6), 9, np.uint8))
    with pytest.raises(DepthError, match=r"a\.png: depth map of a\.jpg: an 8-bit PNG is a preview"):
        source(tmp_path).depth(photograph())


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png", ".h5"])
def test_file_of_another_format_or_with_pickled_objects_is_unreadable(tmp_path, suffix):
    pickled = tmp_path / "pickled.npy"
    np.save(pickled, np.array([[{}, {}]]), allow_pickle=True)
    for content in (b"not what the name says" * 20, pickled.read_bytes()):
        (tmp_path / f"a{suffix}").write_bytes(content)
        with pytest.raises(DepthError, match=r"not what its suffix says|found object"):
            source(tmp_path).depth(photograph())


@pytest.mark.parametrize(
    "values",
    [
        np.ones((1, 4, 6)),
        np.float64(2.0),
        np.ones((0, 6)),
        np.ones((4, 6), complex),
        np.full((4, 6), "1.0"),
    ],
)
def test_array_that_is_no_map_of_numbers_is_refused(tmp_path, values):
    write_map(tmp_path / "a.npy", values)
    with pytest.raises(DepthError, match=r"expected numbers of shape \(height, width\), found"):
        source(tmp_path).depth(photograph())


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png", ".h5"])
def test_map_far_larger_than_the_photograph_is_refused_by_its_header(tmp_path, suffix):
    large = np.ones((1800, 2700), np.uint16)
    write_map(tmp_path / f"a{suffix}", large)
    with pytest.raises(DepthError, match=r"is of shape .*1800.*, too large for a depth map"):
        source(tmp_path).depth(photograph())
    stored = write_image(tmp_path / "photo.png", np.zeros((1200, 1800), np.uint8))
    assert source(tmp_path).depth(photograph(path=stored)).shape == (1800, 2700)


def test_values_in_other_files_are_not_read(tmp_path):
    np.ones((4, 6), "f4").tofile(tmp_path / "elsewhere.raw")
    path = write_map(tmp_path / "inner.h5", asymmetric_map())
    layout = h5py.VirtualLayout((4, 6), "f8")
    layout[:] = h5py.VirtualSource(path, "depth", (4, 6))
    for make in (
        lambda file: file.create_dataset(
            "depth", (4, 6), "f4", external=[(str(tmp_path / "elsewhere.raw"), 0, 96)]
        ),
        lambda file: file.create_virtual_dataset("depth", layout),
    ):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            make(file)
        with pytest.raises(DepthError, match="its values are in other files"):
            source(tmp_path).depth(photograph())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["depth"] = h5py.ExternalLink(str(path), "depth")
    with pytest.raises(DepthError, match="expected one dataset of two dimensions"):
        source(tmp_path).depth(photograph())


@pytest.mark.parametrize("size", [(4, 6), (6, 6), (12, 7)])
def test_map_of_another_aspect_is_refused_unless_networks_round_so(tmp_path, size):
    write_map(tmp_path / "a.npy", asymmetric_map(size))
    with pytest.raises(DepthError, match=rf"is {size[0]} x {size[1]} px, the photograph 12 x 8"):
        source(tmp_path).depth(photograph())
    for rounded in ((6, 4), (120, 80), (352, 224), (64, 42)):
        write_map(tmp_path / "a.npy", asymmetric_map(rounded))
        assert source(tmp_path).depth(photograph()).shape == rounded[::-1]


@pytest.mark.parametrize("value", [0.0, np.nan])
@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_map_without_depths_is_refused(tmp_path, kind, value):
    write_map(tmp_path / "a.npy", np.full((4, 6), value))
    with pytest.raises(DepthError, match=r"a\.npy: depth map of a\.jpg: 0 % of the values are dep"):
        source(tmp_path, kind=kind).depth(photograph())


def test_one_percent_of_the_map_must_be_known(tmp_path):
    values, image = np.zeros((30, 50)), photograph(size=(100, 60))
    values.ravel()[:15] = 2.0
    write_map(tmp_path / "a.npy", values)
    assert np.isfinite(source(tmp_path).depth(image)).sum() == 15
    values[0, 0] = 0.0
    write_map(tmp_path / "a.npy", values)
    with pytest.raises(DepthError, match=r"0\.93 % of the values"):
        source(tmp_path).depth(image)


def test_require_some_needs_a_map_of_one_image(tmp_path):
    with pytest.raises(DepthError, match="no such folder"):
        source(tmp_path / "nowhere").require_some(["a.jpg"])
    write_map(tmp_path / "side" / "č d.npy", asymmetric_map())
    with pytest.raises(DepthError, match=r"any of the 2 images; looked for a\.jpg\.\* and a\.\*"):
        source(tmp_path).require_some(["a.jpg", "side/b.jpg"])
    source(tmp_path).require_some(["a.jpg", "side/č d.png"])


# --- files: real and rendered maps


def courtyard_photograph(name):
    camera = np.diag([1080.0, 1080.0, 1.0])
    camera[:2, 2] = pixel_from_colmap(np.array([360.0, 270.0]))
    path = COURTYARD / "images" / name
    return Photograph(read_gray(path), name, path, camera)


def world_points(depth, camera_matrix, pose):
    """(h, w, 3) points of a depth map at the resolution of its photograph."""
    columns, rows = np.meshgrid(np.arange(depth.shape[1]), np.arange(depth.shape[0]))
    pixels = np.stack([columns, rows, np.ones(depth.shape)], axis=-1)
    points = depth[..., None] * (pixels @ np.linalg.inv(camera_matrix).T)
    rotation, translation = pose
    return (points - translation) @ rotation


@pytest.mark.parametrize("number", range(1, 10))
def test_paving_of_the_courtyard_is_the_plane_z_0_of_the_world(number):
    name = f"court_{number}.jpg"
    image = courtyard_photograph(name)
    pose = read_poses(COURTYARD / "ground_truth")[name]
    options = {"path": COURTYARD / "depth", "png_scale": PNG_METRES}
    depth = source(**options).depth(image)
    assert depth.shape == (540, 720)
    assert 2.0 < np.nanmin(depth) < np.nanmax(depth) < 60.0

    def share_on_paving(depth):
        heights = world_points(depth, image.camera_matrix, pose)[-20:, :, 2]
        return np.mean(np.abs(heights) < PAVING_TOLERANCE_M)

    # The rest of the lowest rows shows steps and the trough.
    assert share_on_paving(depth) > 0.3
    # Read as distances along rays the same map is bent.
    assert share_on_paving(source(**options, kind="ray").depth(image)) < 0.02


@pytest.mark.shared
@pytest.mark.skipif(not MEGADEPTH.is_dir(), reason="the photographs of ../shared are not here")
@pytest.mark.parametrize("name", ["frame_0000000305_1.jpg", "frame_0000001535_4.jpg"])
@pytest.mark.parametrize("kind", ["z", "ray"])
def test_megadepth_maps_of_the_paper_are_read(name, kind):
    path = MEGADEPTH / "scene1" / "images" / name
    camera = np.array([[1530.0, 0.0, 539.5], [0.0, 1530.0, 959.5], [0.0, 0.0, 1.0]])
    image = Photograph(read_gray(path), name, path, camera)
    # The folder also holds previews, scene1/<name>.jpg: they are not taken for maps.
    folder = MEGADEPTH / "depth" / "mega_depth" / "scene1"
    depths = source(folder, kind=kind)
    depths.require_some([name])
    depth = depths.depth(image)
    stored = np.load(folder / name.replace(".jpg", ".npy"))
    assert depth.shape == (512, 288)
    assert np.isfinite(depth).all()
    ratio = stored / depth
    if kind == "z":
        assert_array_equal(ratio, 1.0)
    else:
        # At the corner x = 540 / 1530 and y = 960 / 1530, less half a px of the map.
        corner = np.sqrt(1 + (540 / 1530) ** 2 + (960 / 1530) ** 2)
        assert_allclose(ratio[[0, 0, -1, -1], [0, -1, 0, -1]], corner, rtol=2e-3)
        assert_allclose(ratio[255:257, 143:145], 1.0, atol=1e-5)


# --- the factory


def monocular(model, cache, kind="z"):
    return MonocularDepth(MonocularOptions(model=model, kind=kind), DepthContext(cache))


# --- networks: tiny ones of random weights, through the real loading code


@pytest.fixture(scope="module")
def transformers():
    """The package, told before it is imported that there is no network."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_OFFLINE", "1")
        reason = "transformers (the extra 'depth') is not installed"
        transformers = pytest.importorskip("transformers", reason=reason)
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        yield transformers


def save_network(model, folder, processor, dtype="float32"):
    """Save a model of random weights that are the same in all versions of torch."""
    import torch

    rng = np.random.default_rng(3)
    with torch.no_grad():
        for name, values in model.named_parameters():
            if values.ndim > 1:
                weights = rng.normal(0.0, values[0].numel() ** -0.5, tuple(values.shape))
                values.copy_(torch.from_numpy(weights))
            if name == "head.conv3.bias":  # the last one of Depth Anything: away from 0
                values.fill_(3.0)
    model.to(getattr(torch, dtype)).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return str(folder)


def relative_network(transformers, folder, **options):
    """Save a Depth Anything of two layers, which predicts inverse depth; return its folder."""
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, mlp_ratio=2, image_size=56,
        out_features=["stage1", "stage2"], reshape_hidden_states=False,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, reassemble_factors=[1, 0.5],
        neck_hidden_sizes=[8, 8], fusion_hidden_size=8, head_hidden_size=8,
    )  # fmt: skip
    processor = {
        "image_processor_type": "DPTImageProcessor", "size": {"height": 112, "width": 112},
        "keep_aspect_ratio": True, "ensure_multiple_of": 14,
    }  # fmt: skip
    model = transformers.DepthAnythingForDepthEstimation(config)
    return save_network(model, folder, processor, **options)


@pytest.fixture(scope="module")
def model(transformers, tmp_path_factory):
    return relative_network(transformers, tmp_path_factory.mktemp("relative"))


COURT_1 = courtyard_photograph("court_1.jpg")


@pytest.mark.long
class TestMonocularDepth(DepthContract):
    """The contract that every depth source keeps."""

    @pytest.fixture(autouse=True)
    def _model(self, model):
        self.model = model

    def make(self):
        return monocular(self.model, None)

    def photograph(self):
        return COURT_1


@pytest.mark.long
def test_network_of_relative_inverse_depth(transformers, model):
    depth = monocular(model, None).depth(COURT_1)
    assert depth.shape == (540, 720)
    assert depth.dtype == np.float32
    assert np.nanmin(depth) == 1.0, "the largest disparity is the unit"
    assert 1.01 < np.nanmax(depth) <= 100.0
    network = transformers.pipeline("depth-estimation", model=model, device="cpu")
    from PIL import Image

    disparity = network(Image.open(COURT_1.path))["predicted_depth"].numpy()
    assert disparity.shape == depth.shape
    assert_allclose(depth, disparity.max() / disparity, rtol=1e-5)


@pytest.mark.long
def test_network_stored_in_half_precision_computes_in_float32(transformers, model, tmp_path):
    half = relative_network(transformers, tmp_path, dtype="float16")
    depth = monocular(half, None).depth(COURT_1)
    assert len(np.unique(depth)) > 10_000  # float16 has 1024 steps from 1 to 2
    assert_allclose(depth, monocular(model, None).depth(COURT_1), rtol=0.05)


@pytest.mark.long
def test_image_without_a_file_goes_to_the_network_in_gray(model, tmp_path):
    path = write_image(tmp_path / "gray.png", COURT_1.gray)
    network = monocular(model, None)
    in_memory = network.depth(replace(COURT_1, path=None))
    assert_array_equal(in_memory, network.depth(replace(COURT_1, path=path)))


@pytest.mark.long
def test_what_a_model_predicts_is_read_from_its_configuration(transformers):
    inverse = [
        transformers.DPTConfig(),
        transformers.DepthAnythingConfig(),
        transformers.DepthAnythingConfig(depth_estimation_type="relative"),
    ]
    metric = [
        transformers.DPTConfig(add_projection=True),
        transformers.DepthAnythingConfig(depth_estimation_type="metric"),
        transformers.GLPNConfig(),
        transformers.ZoeDepthConfig(),
    ]
    assert all(predicts_inverse_depth(config) for config in inverse)
    assert not any(predicts_inverse_depth(config) for config in metric)


@pytest.mark.long
def test_model_that_is_no_depth_network_or_not_there_is_one_clear_error(transformers, tmp_path):
    config = transformers.Dinov2Config(hidden_size=16, num_hidden_layers=1, num_attention_heads=1)
    transformers.Dinov2Model(config).save_pretrained(tmp_path / "backbone")
    cache = tmp_path / "cache"
    for name in ("nobody/no-such-model", str(tmp_path), str(tmp_path / "backbone")):
        network = monocular(name, cache)
        for call in (lambda n=network: n.depth(COURT_1), lambda n=network: n.require_some(["a"])):
            with pytest.raises(DepthError) as error:
                call()
            assert str(error.value).startswith(f"{name}: cannot be loaded as a depth network (")
            assert "local folder" in str(error.value)
            assert "\n" not in str(error.value)
    assert not cache.exists()


@pytest.mark.parametrize("package", ["transformers", "PIL"])
def test_missing_package_is_named_with_the_command_that_installs_it(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    message = 'depth from a network needs transformers: pip install "colmap-affrect[depth]"'
    network = monocular("some/model", None)
    for call in (lambda: network.depth(COURT_1), lambda: network.require_some(["a.jpg"])):
        with pytest.raises(DepthError) as error:
            call()
        assert str(error.value) == message


# --- networks: kinds, cache and threads, with a pipeline whose prediction is known


class FakePipelines:
    """Stands for ``transformers.pipeline``; counts what is loaded and what is predicted."""

    def __init__(self, prediction, **config):
        self.prediction = prediction
        self.config = SimpleNamespace(**config)
        self.model = SimpleNamespace(config=self.config, float=lambda: None)
        self.loaded, self.sizes = [], []
        self.busy = threading.Lock()

    def load(self, task, model, device, trust_remote_code):
        assert (task, trust_remote_code) == ("depth-estimation", False)
        self.loaded.append((model, device))
        return self

    def __call__(self, image):
        import torch

        assert self.busy.acquire(blocking=False), "two threads at one network"
        self.sizes.append(image.size)
        time.sleep(0.01)
        self.busy.release()
        return {"predicted_depth": torch.tensor(self.prediction)}


@pytest.fixture
def fake(monkeypatch):
    def install(prediction, **config):
        pipelines = FakePipelines(prediction, **config)
        package = SimpleNamespace(pipeline=pipelines.load)
        monkeypatch.setitem(sys.modules, "transformers", package)
        return pipelines

    return install


RELATIVE = dict(model_type="depth_anything", depth_estimation_type="relative")
METRIC = dict(model_type="zoedepth")

NAN = np.nan
PLANE, PLANE_RAYS = slanted_plane((12, 8), CAMERA)


@pytest.mark.parametrize(
    ("config", "kind", "predicted", "expected"),
    [
        # Inverse depth: 1 at its largest, unknown below a hundredth of it.
        (
            RELATIVE,
            "z",
            [[50.0, 25.0, 5.0], [0.51, 0.49, -0.1]],
            [[1, 2, 10], [50 / 0.51, NAN, NAN]],
        ),
        (METRIC, "z", [[[5.0, 2.5, 0.5], [0.0, -0.1, NAN]]], [[5, 2.5, 0.5], [NAN] * 3]),
        (METRIC, "inverse", [[4.0, 2.0]], [[1.0, 2.0]]),
        (METRIC, "ray", PLANE_RAYS, PLANE),
    ],
)
def test_prediction_becomes_depth_by_its_kind(fake, config, kind, predicted, expected):
    fake(predicted, **config)
    network = monocular("m", None, kind)
    assert_allclose(network.depth(photograph()), expected, rtol=FLOAT32_RTOL)


@pytest.mark.parametrize("config", [RELATIVE, METRIC])
@pytest.mark.parametrize("value", [-2.0, np.nan])
def test_prediction_without_depths_is_an_error(fake, config, value):
    fake(np.full((4, 6), value), **config)
    with pytest.raises(DepthError, match=r"a\.jpg: depth by some/model: 0 % of the values"):
        monocular("some/model", None).depth(photograph())


def test_photographs_reach_the_network_shrunk_and_as_rgb(fake, tmp_path, monkeypatch):
    fake([[1.0, 2.0]], **METRIC)
    seen = []
    monkeypatch.setattr("PIL.Image.fromarray", lambda pixels: seen.append(pixels) or MagicMock())
    bgr = np.full((300, 2000, 3), (10, 60, 200), np.uint8)
    path = write_image(tmp_path / "large.png", bgr)
    monocular("m", None).depth(photograph(path=path))
    assert seen[0].shape == (154, NETWORK_IMAGE_SIZE_PX, 3)
    assert seen[0][0, 0].tolist() == [200, 60, 10]


@pytest.mark.usefixtures("transformers")
def test_photograph_that_is_gone_or_damaged_is_an_image_error(tmp_path):
    network = monocular("m", None)
    for name, content in (("gone.jpg", None), ("empty.jpg", b""), ("broken.jpg", b"no image")):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ImageError, match=name):
            network.depth(photograph(path=tmp_path / name))


PREDICTION = [[5.0, 2.5, 0.5], [0.3, 0.2, 0.125]]


@pytest.mark.parametrize("config", [RELATIVE, METRIC])
def test_prediction_is_kept_and_used_again_without_loading_the_network(fake, tmp_path, config):
    pipelines = fake(PREDICTION, **config)
    image = replace(COURT_1, name="side ž/court 1.jpg")
    depth = monocular("m", tmp_path).depth(image)
    again = monocular("m", tmp_path)
    again.require_some([image.name])
    assert_array_equal(again.depth(image), depth)
    inverse = monocular("m", tmp_path, "inverse").depth(image)
    assert_allclose(inverse, 5.0 / np.array(PREDICTION), rtol=FLOAT32_RTOL)
    assert (pipelines.loaded, len(pipelines.sizes)) == ([("m", "cpu")], 1)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files == [tmp_path / "side ž" / "court 1.jpg.npz"]


def test_prediction_is_made_again_for_another_model_or_other_pixels(fake, tmp_path):
    pipelines = fake(PREDICTION, **METRIC)
    monocular("m", tmp_path).depth(COURT_1)
    other = monocular("other", tmp_path)
    other.depth(COURT_1)
    assert [model for model, _ in pipelines.loaded] == ["m", "other"]
    other.depth(replace(COURT_1, path=COURTYARD / "images" / "court_2.jpg"))
    other.depth(replace(COURT_1, path=COURTYARD / "images" / "court_2.jpg"))
    assert len(pipelines.sizes) == 3


@pytest.mark.parametrize("damage", ["cut", "text", "empty", "foreign"])
def test_damaged_cache_is_written_again(fake, tmp_path, damage):
    pipelines = fake(PREDICTION, **METRIC)
    depth = monocular("m", tmp_path).depth(COURT_1)
    file = tmp_path / "court_1.jpg.npz"
    good = file.read_bytes()
    if damage == "foreign":
        np.savez(file, other=np.ones(3))
    else:
        file.write_bytes({"cut": good[: len(good) // 2], "text": b"text", "empty": b""}[damage])
    assert_array_equal(monocular("m", tmp_path).depth(COURT_1), depth)
    assert len(pipelines.sizes) == 2
    assert monocular("m", tmp_path).depth(COURT_1) is not None
    assert len(pipelines.sizes) == 2


def test_run_killed_while_writing_leaves_no_prediction(fake, tmp_path, monkeypatch):
    pipelines = fake(PREDICTION, **METRIC)

    def half(stream, **_):
        stream.write(b"PK half of a file")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", half)
        with pytest.raises(KeyboardInterrupt):
            monocular("m", tmp_path).depth(COURT_1)
    assert not (tmp_path / "court_1.jpg.npz").exists()
    monocular("m", tmp_path).depth(COURT_1)
    assert len(pipelines.sizes) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["court_1.jpg.npz"]


def test_cache_that_cannot_be_written_is_a_depth_error(fake, tmp_path):
    fake(PREDICTION, **METRIC)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DepthError, match=r"court_1\.jpg\.npz: depth cannot be kept there"):
        monocular("m", tmp_path / "file").depth(COURT_1)


def test_require_some_loads_the_network_once_if_any_prediction_is_missing(fake, tmp_path):
    pipelines = fake(PREDICTION, **METRIC)
    monocular("m", tmp_path).depth(COURT_1)
    network = monocular("m", tmp_path)
    network.require_some(["court_1.jpg", "court_2.jpg"])
    network.require_some(["court_1.jpg", "court_2.jpg"])
    assert pipelines.loaded == [("m", "cpu")] * 2


def test_threads_share_one_network_and_take_turns(fake, tmp_path):
    pipelines = fake(PREDICTION, **METRIC)
    network = monocular("m", tmp_path)
    images = [photograph(f"{number}.jpg") for number in range(8)]
    with ThreadPoolExecutor(4) as pool:
        depths = list(pool.map(network.depth, images))
    assert pipelines.loaded == [("m", "cpu")]
    assert len(pipelines.sizes) == len(depths) == 8
