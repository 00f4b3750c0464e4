"""Depth maps of photographs: formats, kinds, and every error."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from planar_scenes import Room, rays, unit
from synthetic import write_image

from colmap_affrect.data import Photograph
from colmap_affrect.errors import DepthError, OptionError
from colmap_affrect.images.depth import DepthMaps, DepthOptions

FLOAT32_RTOL = 1e-6
"""Rounding to float32 after float64 arithmetic."""

CAMERA = np.array([[30.0, 0.0, 4.2], [0.0, 21.0, 2.9], [0.0, 0.0, 1.0]])
"""Of an image of 12 x 8 px: principal point off the middle, pixels not square."""


def photograph(name="a.jpg", size=(12, 8), camera_matrix=CAMERA, path=None):
    return Photograph(np.zeros(size[::-1], np.uint8), name, path, camera_matrix)


def slanted_plane(size, camera_matrix):
    """Depth along the axis and along the rays of the plane n . X = 3 seen by a camera."""
    normal = np.array([0.3, -0.5, 1.0])
    wall = Room(-unit(normal)[None], 3.0 / np.linalg.norm(normal), camera_matrix, size)
    z_depth, _ = wall.depth(size)
    directions = rays(camera_matrix, np.arange(size[0]), np.arange(size[1]))
    return z_depth, z_depth * np.linalg.norm(directions, axis=-1)


def asymmetric_map(size=(6, 4)):
    """(h, w) values of which no two are the same, nor any flip or transpose."""
    width, height = size
    return np.arange(1.0, 1.0 + width * height).reshape(height, width) ** 1.5


def write_map(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        write_image(path, values)
    return path


def source(path, **options):
    return DepthMaps(DepthOptions(path=str(path), **options))


# --- files: formats and places


@pytest.mark.parametrize("dtype", [np.float16, ">f4", np.int32])
def test_arrays_round_trip(tmp_path, dtype):
    values = np.asfortranarray(asymmetric_map().astype(dtype))
    write_map(tmp_path / "a.npy", values)
    depth = source(tmp_path).depth(photograph())
    assert depth.dtype == np.float32
    assert_allclose(depth, values, rtol=FLOAT32_RTOL)


def test_png_of_sixteen_bits_counts_steps_and_zero_is_unknown(tmp_path):
    steps = (1000 * asymmetric_map()).astype(np.uint16)
    steps[2, 1] = 0
    write_map(tmp_path / "a.png", steps)
    depth = source(tmp_path).depth(photograph())
    expected = np.where(steps == 0, np.nan, 0.001 * steps)
    assert_allclose(depth, expected, rtol=FLOAT32_RTOL)


def test_places_are_searched_in_the_documented_order(tmp_path):
    suffixes = (".npy", ".png", ".tif", ".tiff")
    places = [
        f"{stem}{suffix}"
        for stem in ("v1.2/č d.x.jpg", "v1.2/č d.x")
        for suffix in suffixes
    ]
    for number, place in enumerate(places, 1):
        write_map(tmp_path / place, np.full((4, 6), 1000 * number, np.uint16))
    for number, place in enumerate(places, 1):
        depth = source(tmp_path).depth(photograph("v1.2/č d.x.jpg"))
        assert np.isin(depth, (number, 1000 * number)).all(), place
        (tmp_path / place).unlink()


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


@pytest.mark.parametrize(("scale_x", "scale_y"), [(1, 1), (0.5, 0.5), (1.0, 25 / 24)])
def test_distances_along_rays_become_depths_along_the_axis(tmp_path, scale_x, scale_y):
    # Written out: pixel centres of a resized image, p' = s (p + 1/2) - 1/2.
    camera = np.array(
        [
            [scale_x * 300.0, 0.0, scale_x * (50.0 + 0.5) - 0.5],
            [0.0, scale_y * 210.0, scale_y * (30.0 + 0.5) - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    z_depth, ray_length = slanted_plane(
        (round(144 * scale_x), round(96 * scale_y)), camera
    )
    assert np.abs(ray_length / z_depth - 1).max() > 0.04, (
        "the test must tell the two apart"
    )
    write_map(tmp_path / "a.npy", ray_length)
    original = np.array([[300.0, 0.0, 50.0], [0.0, 210.0, 30.0], [0.0, 0.0, 1.0]])
    image = photograph(size=(144, 96), camera_matrix=original)
    assert_allclose(
        source(tmp_path, kind="ray").depth(image), z_depth, rtol=FLOAT32_RTOL
    )
    assert_allclose(source(tmp_path).depth(image), ray_length, rtol=FLOAT32_RTOL)


def test_inverse_depth_is_inverted_after_scaling_and_what_is_not_positive_is_unknown(
    tmp_path,
):
    steps = np.array([[0, 1, 2], [10, 50, 65535]], np.uint16)
    write_map(tmp_path / "a.png", steps)
    depth = source(tmp_path, kind="inverse").depth(photograph())
    assert_allclose(
        depth, [[np.nan, 1000, 500], [100, 20, 1000 / 65535]], rtol=FLOAT32_RTOL
    )


# --- files: errors


def test_missing_map_names_the_places_looked_at(tmp_path):
    with pytest.raises(DepthError) as error:
        source(tmp_path).depth(photograph("side/a.jpg"))
    message = str(error.value)
    assert message.startswith(f"{tmp_path}: no depth map of side/a.jpg; ")
    assert "side/a.jpg.* and side/a.* with * one of .npy, .png, .tif, .tiff" in message
    assert "\n" not in message
    with pytest.raises(DepthError, match="no depth map"):
        source(tmp_path).depth(photograph(""))


@pytest.mark.parametrize("suffix", [".npy", ".png", ".tif"])
def test_file_of_another_format_or_with_pickled_objects_is_unreadable(tmp_path, suffix):
    pickled = tmp_path / "pickled.npy"
    np.save(pickled, np.array([[{}, {}]]), allow_pickle=True)
    for content in (b"not what the name says" * 20, pickled.read_bytes()):
        (tmp_path / f"a{suffix}").write_bytes(content)
        with pytest.raises(DepthError, match="not what its suffix says"):
            source(tmp_path).depth(photograph())


@pytest.mark.parametrize(
    "values", [np.ones((1, 4, 6)), np.ones((0, 6)), np.ones((4, 6), complex)]
)
def test_array_that_is_no_map_of_numbers_is_refused(tmp_path, values):
    write_map(tmp_path / "a.npy", values)
    with pytest.raises(
        DepthError, match=r"expected numbers of shape \(height, width\), found"
    ):
        source(tmp_path).depth(photograph())


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_map_of_too_many_values_is_refused_by_its_header(tmp_path, suffix, monkeypatch):
    monkeypatch.setattr("colmap_affrect.images.depth.MAX_NUM_VALUES", 23)
    write_map(tmp_path / f"a{suffix}", np.ones((4, 6), np.uint16))
    with pytest.raises(DepthError, match="too large"):
        source(tmp_path).depth(photograph())


@pytest.mark.parametrize("size", [(4, 6), (12, 7)])
def test_map_of_another_aspect_is_refused_unless_networks_round_so(tmp_path, size):
    write_map(tmp_path / "a.npy", asymmetric_map(size))
    with pytest.raises(
        DepthError, match=rf"is {size[0]} x {size[1]} px, the photograph 12 x 8"
    ):
        source(tmp_path).depth(photograph())
    for rounded in ((6, 4), (120, 80), (352, 224), (64, 42)):
        write_map(tmp_path / "a.npy", asymmetric_map(rounded))
        assert source(tmp_path).depth(photograph()).shape == rounded[::-1]


def test_require_some_needs_a_map_of_one_image(tmp_path):
    with pytest.raises(OptionError, match="no such folder"):
        source(tmp_path / "nowhere").require_some(["a.jpg"])
    write_map(tmp_path / "side" / "č d.npy", asymmetric_map())
    with pytest.raises(
        OptionError, match=r"any of the 2 images; looked for a\.jpg\.\* and a\.\*"
    ):
        source(tmp_path).require_some(["a.jpg", "side/b.jpg"])
    source(tmp_path).require_some(["a.jpg", "side/č d.png"])
